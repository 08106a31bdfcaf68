"""A skin on a geom of a MuJoCo model: shape and force of each object, the pressure, and the readings.

MuJoCo gives the force of each touching geom, as its own contact parameters (``solref``, ``solimp``) let it
grow. This force holds. The skin distributes it: pressure and readings follow from the shape of the geom and
from the compliance of the skin. How deep bodies overlap in MuJoCo has no effect on them.
"""

import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import cached_property
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody, Sensors
from skin.body.layout import AbstractLayout
from skin.core.settings import option_name
from skin.errors import InputError
from skin.inference.noise import Noise
from skin.inference.posterior import FrameEstimate, Posterior
from skin.mechanics.contact.rigid import solve_contact, surface_compliance
from skin.mechanics.simulator.base import AbstractSimulator
from skin.mechanics.simulator.solid import Solid

# m: from the skin to the common origin of all rays, which are then parallel to 1 mrad; and of positions.
_FAR, _ROUNDING = 100.0, 1e-6
_SEEN = np.array([0, 1, 0, 0, 0, 0], np.uint8)  # the group of the geoms that rays see


# Objects that something else moves, such as a simulator of robots: their shape and force are given.


class Press(NamedTuple):
    """How a rigid object presses on a skin.

    Attributes:
        gap: (H * W,), m, from each cell to the object, up to a constant; infinite where there is none.
        force: (3,), N, along x and y of the chart, and into the skin.
    """

    gap: np.ndarray
    force: np.ndarray


class Pressing:
    """Pressure and readings of presses on a skin.

    Args:
        simulator: of the skin.
        body: the skin.

    Raises:
        InputError: the simulator has no compliance.
    """

    def __init__(self, simulator: AbstractSimulator, body: AbstractBody) -> None:
        self.simulator, self._body = simulator, body
        self.compliance = surface_compliance(simulator, body)
        if not simulator.feels_shear:
            warnings.warn(
                f"simulator={option_name(simulator)} has normal forces only: friction is left out",
                stacklevel=3,
            )

    def pressures(self, presses: Sequence[Press]) -> Tensor:
        """Return the pressure of each press alone, (P, H, W), Pa; its sum is the force into the skin."""
        pressure = torch.zeros(len(presses), len(self.compliance))
        if presses:
            gaps = np.stack([press.gap for press in presses])
            near = np.flatnonzero(np.isfinite(gaps).any(axis=0))
            totals = np.array([press.force[2] for press in presses]) / np.prod(self._body.cell)
            compliance = self.compliance[near[:, None], near]
            pressure[:, near] = solve_contact(
                compliance,
                torch.from_numpy(gaps[:, near]),
                torch.from_numpy(totals),
                torch.from_numpy(_sink(gaps[:, near], totals * float(compliance.diagonal().mean()))),
                iterations=1000,
            ).pressure
        return pressure.unflatten(1, self._body.shape)

    @torch.no_grad()
    def frames(self, presses: Sequence[tuple[Press, int]], count: int) -> tuple[Tensor, Tensor]:
        """Return the pressure (F, H, W), Pa, and the readings (F, S), N, of frames; presses add up.

        Friction is a shear in proportion to the pressure, if the simulator feels it.

        Args:
            presses: each with its frame.
            count: F, number of frames.
        """
        pressures = self.pressures([press for press, _ in presses])
        index = torch.tensor([frame for _, frame in presses], dtype=torch.long)
        forces = torch.from_numpy(np.array([press.force for press, _ in presses]).reshape(-1, 3))
        shear = forces[:, :2] / forces[:, 2:] if self.simulator.feels_shear else None
        readings = self.simulator(pressures, shear).readings
        total, read = (values.new_zeros(count, *values.shape[1:]) for values in (pressures, readings))
        return total.index_add(0, index, pressures), read.index_add(0, index, readings)


def _sink(gap: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Return the depths (P, N), m, to which cells sink that are springs of their own; they sum to ``total``.

    From this pressure, up to a factor, the solution of a round object is found in half the iterations.

    Args:
        gap: (P, N), m; infinite where there is no object.
        total: (P,), m.
    """
    rise = np.sort(gap, axis=1)
    level = (total[:, None] + np.cumsum(rise, axis=1)) / np.arange(1, gap.shape[1] + 1)
    count = ((level >= rise) & np.isfinite(rise)).sum(axis=1, keepdims=True)
    return np.clip(np.take_along_axis(level, count - 1, axis=1) - gap, 0, None)


# The skin in MuJoCo.


def load_package(name: str, extra: str) -> Any:
    """Return a package that comes with an extra of this one.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed: pip install 'tactile-skin[{extra}]'") from error


class MujocoSurface:
    """The surface of a skin in a MuJoCo model.

    Args:
        model: ``mujoco.MjModel``.
        site: name of the site in the middle of the skin's surface. Its x axis is that of the chart, its y
            axis the opposite of the chart's, z points out of the skin. The geom of the site's body that lies
            under it carries the skin.
        body: the skin.

    Attributes:
        geom: number of the geom that carries the skin.

    Raises:
        InputError: MuJoCo is not installed, there is no such site, or no geom of its body lies under it.
    """

    def __init__(self, model: Any, site: str, body: AbstractBody) -> None:
        self._mujoco, self._model, self._body = load_package("mujoco", "mujoco"), model, body
        try:
            self._site = model.site(site).id
        except KeyError as error:
            raise InputError(f"the model has no site {site!r}: {error.args[0]}") from error
        if model.opt.enableflags & self._mujoco.mjtEnableBit.mjENBL_SLEEP:
            raise InputError("objects that sleep have no contacts: leave out the model's flag sleep")
        x, y = ((np.arange(count) + 0.5) * cell for count, cell in zip(body.cells, body.cell, strict=True))
        self._cells = np.stack([*np.meshgrid(x, y), np.zeros(body.shape)], axis=-1).reshape(-1, 3)
        middle = np.array([*body.size, 0.0]) / 2
        # The chart is the skin seen from outside, with y downwards.
        self._axes = body.frame(middle) * np.array([[1.0], [-1.0], [-1.0]])
        # In the frame of the site.
        self._points = (body.locate(self._cells) - body.locate(middle)) @ self._axes.T
        self._frames = body.frame(self._cells) @ self._axes.T
        self.geom = self._find_carrier(site)

    def _find_carrier(self, site: str) -> int:
        """Return the number of the geom under the site; warn where it does not carry the whole skin."""
        model, data = self._model, self._mujoco.MjData(self._model)
        self._mujoco.mj_kinematics(model, data)
        points, axes = self._place(data)
        owner = model.site_bodyid[self._site]
        # Other geoms, such as those of a robot's looks, have no contacts.
        solid = ((model.geom_contype | model.geom_conaffinity) > 0) | np.isin(
            np.arange(model.ngeom), [model.pair_geom1, model.pair_geom2]
        )
        depth, numbers = self._cast(data, solid & (model.geom_bodyid == owner), points, axes[:, 2])
        carrier = int(numbers[(self._points**2).sum(1).argmin()])
        # An arm's surface lies below the plane of the site.
        beyond = (numbers != carrier) | (np.abs(depth) > self._body.thickness + np.ptp(self._points[:, 2]))
        if carrier < 0 or beyond.all():
            raise InputError(
                f"site {site} of body {self._model.body(owner).name or owner} lies on no geom that collides: "
                "put it on the surface of the geom that carries the skin, in the same body, with z outwards"
            )
        if beyond.any():
            warnings.warn(
                f"{beyond.sum()} of {len(beyond)} cells of the skin lie beyond geom "
                f"{self._model.geom(carrier).name or carrier}, where nothing can press it: lower body.size, "
                f"or move site {site}",
                UserWarning,
                stacklevel=4,
            )
        return carrier

    def presses(self, data: Any) -> list[Press]:
        """Return what each geom that touches the skin does; contacts beside the skin do not count.

        Args:
            data: ``mujoco.MjData`` after ``mj_step`` or ``mj_forward``.
        """
        contact, wrench = data.contact, np.zeros(6)
        mine = contact.geom == self.geom
        # A flex has no geom; an excluded contact has no force.
        rows = np.flatnonzero(mine.any(1) & (contact.geom >= 0).all(1) & (contact.efc_address >= 0))
        points, axes = self._place(data)
        touches = defaultdict[int, list[tuple[int, np.ndarray]]](list)
        for row in rows:
            self._mujoco.mj_contactForce(self._model, data, row, wrench)
            cell = int(((contact.pos[row] - points) ** 2).sum(1).argmin())
            off = self._frames[cell] @ axes.T @ (contact.pos[row] - points[cell]) * [1, 1, 0]
            # It acts on the second geom.
            push = mine[row] @ [-1, 1] * (contact.frame[row].reshape(3, 3).T @ wrench[:3])
            force = self._body.frame(self._cells[cell] + off) @ self._axes.T @ axes.T @ push
            geom = contact.geom[row].sum() - self.geom
            if (np.abs(off[:2]) > np.array(self._body.cell) / 2 + _ROUNDING).any():
                warnings.warn(
                    f"geom {self._model.geom(geom).name or geom} has contacts beside the skin, which do not "
                    "count: MuJoCo puts those of flat faces at their corners; the geom that carries the skin "
                    "should be no larger than the skin",
                    stacklevel=3,
                )
            elif force[2] > 0:
                touches[geom].append((cell, force))
        return [self._press(data, points, axes, *touch) for touch in touches.items()]

    def _press(
        self,
        data: Any,
        points: np.ndarray,
        axes: np.ndarray,
        geom: int,
        parts: list[tuple[int, np.ndarray]],
    ) -> Press:
        """Return the press of a geom from the cell and the force of each of its contacts."""
        normals = self._frames[:, 2] @ axes.T
        inward = sum(force[2] * normals[cell] for cell, force in parts)
        gap, _ = self._cast(data, [geom], points, inward / np.linalg.norm(inward))
        gap[normals @ inward <= 0] = np.inf  # on the far side of a curved skin
        if not np.isfinite(gap).any():  # it is between the middles of cells
            gap[parts[0][0]] = 0.0
        gap -= gap.min()
        # It does not sink in deeper than the skin is thick.
        gap[gap > self._body.thickness] = np.inf
        return Press(gap, np.sum([force for _, force in parts], axis=0))

    def _place(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the middles of the cells (N, 3), m, and the axes of the site as columns, in the world."""
        axes = data.site_xmat[self._site].reshape(3, 3)
        return data.site_xpos[self._site] + self._points @ axes.T, axes

    def _cast(self, data: Any, geoms: Any, points: np.ndarray, back: np.ndarray) -> tuple[Any, np.ndarray]:
        """Cast rays from behind points (N, 3), m, through them.

        Args:
            data: with the positions of all geoms.
            geoms: index of the geoms that rays see.
            points: m, in the world.
            back: unit vector to the origin of the rays.

        Returns:
            How far the first geom is from each point, (N,), m: negative where it is before the point,
            infinite where there is none; and its number, -1 where there is none.
        """
        model, origin = self._model, points.mean(axis=0) + _FAR * back
        lengths = np.linalg.norm(points - origin, axis=1)
        hits, numbers = np.empty(len(points)), np.empty(len(points), np.int32)
        settings = {name: getattr(model, name).copy() for name in ("geom_group", "geom_matid", "geom_rgba")}
        try:
            model.geom_group[:] = 0
            # Rays pass through what is invisible.
            model.geom_group[geoms], model.geom_matid[geoms], model.geom_rgba[geoms] = 1, -1, 1
            self._mujoco.mj_multiRay(
                model,
                data,
                origin,
                ((points - origin) / lengths[:, None]).ravel(),
                _SEEN,
                True,
                -1,
                numbers,
                hits,
                None,
                len(points),
                2 * _FAR,
            )
        finally:
            for name, values in settings.items():
                getattr(model, name)[:] = values
        return np.where(hits >= 0, hits - lengths, np.inf), numbers


class MujocoSkin:
    """A skin on a geom of a MuJoCo model.

    Each geom that touches is solved alone: its force, as MuJoCo computes it, is distributed as the shape of
    the geom and the compliance of the skin demand. Readings add up. That one geom lowers the surface under
    another is left out, which holds for objects farther apart than the skin is thick. Objects do not tilt:
    an eccentric force presses like a central one. Friction is a shear of each geom in proportion to its
    pressure. Objects are rigid; flexes of MuJoCo are not felt.

    Args:
        model: ``mujoco.MjModel``. It is changed and restored while rays are cast: threads need models of
            their own.
        site: name of the site in the middle of the skin's surface, as of :class:`MujocoSurface`.
        body: the skin.
        layout: of its sensors.
        simulator: ``simulator(body, sensors)``; it needs a compliant surface.
        noise: of the readings, which :meth:`contacts` expects; None: 0.05 N.

    Attributes:
        sensors: S sensors.
        surface: the skin's surface in the model.
        posterior: estimates contacts from readings.

    Raises:
        InputError: as of :class:`MujocoSurface`, or the simulator has no compliance.
    """

    def __init__(
        self,
        model: Any,
        site: str,
        body: AbstractBody,
        layout: AbstractLayout,
        simulator: Callable[[AbstractBody, Sensors], AbstractSimulator] = Solid,
        noise: Noise | None = None,
    ) -> None:
        self.surface = MujocoSurface(model, site, body)
        self.body, self.sensors, self.noise = body, layout.sensors(body), noise or Noise(0.05)
        self._pressing = Pressing(simulator(body, self.sensors), body)

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of this skin; to prepare it takes a second."""
        return Posterior(self._pressing.simulator, self.noise, self.body)

    def pressure(self, data: Any) -> np.ndarray:
        """Return the pressure on the cells, (H, W), Pa; ``data`` is that of :meth:`read`."""
        return self._pressing.pressures(self.surface.presses(data)).sum(0).numpy()

    def read(self, data: Any) -> np.ndarray:
        """Return the true readings (S,), N, without noise.

        Args:
            data: ``mujoco.MjData`` after ``mj_step`` or ``mj_forward``.
        """
        return (
            self._pressing.frames([(each, 0) for each in self.surface.presses(data)], 1)[1][0]
            .double()
            .numpy()
        )

    def contacts(self, data: Any) -> FrameEstimate:
        """Return where and how hard the skin is touched, as its readings tell; ``data`` as in ``read``."""
        return self.posterior.estimate_touch(self.read(data))
