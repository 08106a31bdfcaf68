"""A skin on a geom of a MuJoCo model: shape and force of each object, the pressure, and the readings.

MuJoCo gives the force of each touching geom, as its own contact parameters (``solref``, ``solimp``) let it
grow. This force holds. The skin distributes it: pressure and readings follow from the shape of the geom and
from the compliance of the skin. How deep bodies overlap in MuJoCo has no effect on them.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

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

if TYPE_CHECKING:
    from mujoco import MjData, MjModel

_FAR = 100.0  # m, from the skin to the common origin of all rays, which are then parallel to 1 mrad
_SEEN = np.array([0, 1, 0, 0, 0, 0], np.uint8)  # the group of the geom that rays see
_ROUNDING = 1e-6  # m


def load_mujoco() -> Any:
    """Return the package ``mujoco``.

    Raises:
        InputError: it is not installed.
    """
    try:
        import mujoco
    except ModuleNotFoundError as error:
        raise InputError("MuJoCo is not installed: pip install 'tactile-skin[mujoco]'") from error
    return mujoco


class Press(NamedTuple):
    """How a geom presses on a skin.

    Attributes:
        geom: its number in the model.
        gap: (H * W,), m, from each cell to the geom along the normal at the contact, up to a constant;
            infinite where the geom is not above the cell, or higher than the skin is thick.
        force: (3,), N, along x and y of the chart, and into the skin.
    """

    geom: int
    gap: np.ndarray
    force: np.ndarray


class MujocoSurface:
    """The surface of a skin in a MuJoCo model.

    Args:
        model: the model.
        site: name of the site in the middle of the skin's surface. Its x and y axes are those of the chart, z
            points out of the skin.
        body: the skin.
        geom: name of the geom that carries the skin; None: the geom of the site's body that is nearest to the
            site.

    Raises:
        InputError: MuJoCo is not installed, there is no such site or geom, or the site's body has no geom
            there.
    """

    def __init__(self, model: "MjModel", site: str, body: AbstractBody, geom: str | None = None) -> None:
        self._mujoco, self._model, self._body = load_mujoco(), model, body
        self._site = _number(model, "site", site)
        x, y = ((np.arange(count) + 0.5) * cell for count, cell in zip(body.cells, body.cell, strict=True))
        cells = np.stack([*np.meshgrid(x, y), np.zeros(body.shape)], axis=-1).reshape(-1, 3)
        middle = np.array([*body.size, 0.0]) / 2
        axes = body.frame(middle) * np.array([[1.0], [1.0], [-1.0]])
        # In the frame of the site.
        self._points = (body.locate(cells) - body.locate(middle)) @ axes.T
        self._frames = body.frame(cells) @ axes.T
        self.geom = self._carrier(site, geom)

    def _carrier(self, site: str, geom: str | None) -> int:
        """Return the number of the geom under the site; warn where it does not carry the whole skin."""
        model, data = self._model, self._mujoco.MjData(self._model)
        self._mujoco.mj_kinematics(model, data)
        points, axes = self._place(data)
        position, inward = data.site_xpos[self._site], -axes[:, 2]
        owner = model.site_bodyid[self._site]
        choice = [number for number in range(model.ngeom) if model.geom_bodyid[number] == owner]
        if geom is not None:
            choice = [_number(model, "geom", geom)]
        depths = [abs(self._distances(data, each, position[None], -inward)[0]) for each in choice]
        if not np.isfinite(depths).any():
            raise InputError(
                f"site {site} of body {model.body(owner).name or owner} lies on "
                f"{'no geom' if geom is None else f'another geom than {geom}'}: put it on the surface of the "
                "geom that carries the skin, in the same body, with z outwards"
            )
        carrier = choice[int(np.argmin(depths))]
        depth = self._distances(data, carrier, points, -inward)
        beyond = int((~(np.abs(depth) <= max(self._body.thickness, np.ptp(self._points[:, 2])))).sum())
        if beyond:
            warnings.warn(
                f"{beyond} of {len(depth)} cells of the skin lie beyond geom "
                f"{model.geom(carrier).name or carrier}, where nothing can press it: lower body.size, or "
                f"move site {site}",
                UserWarning,
                stacklevel=4,
            )
        return carrier

    def presses(self, data: "MjData") -> list[Press]:
        """Return what each geom that touches the skin does; contacts beside the skin do not count.

        Args:
            data: after ``mj_step`` or ``mj_forward``.
        """
        contact, groups = data.contact, dict[int, list[tuple[int, np.ndarray, np.ndarray]]]()
        mine = contact.geom == self.geom
        rows = np.flatnonzero(mine.any(1) & (contact.geom >= 0).all(1) & (contact.efc_address >= 0))
        if not len(rows):
            return []
        (points, axes), wrench = self._place(data), np.zeros(6)
        for row in rows:
            self._mujoco.mj_contactForce(self._model, data, row, wrench)
            # The force acts on the second geom.
            sign = 1 if mine[row, 1] else -1
            away = contact.pos[row] - points
            cell = int((away**2).sum(1).argmin())
            frame = self._frames[cell] @ axes.T
            beside = np.abs(frame[:2] @ away[cell]) > np.array(self._body.cell) / 2 + _ROUNDING
            force = sign * frame @ contact.frame[row].reshape(3, 3).T @ wrench[:3]
            if force[2] > 0 and not beside.any():
                other = int(contact.geom[row, 0 if mine[row, 1] else 1])
                groups.setdefault(other, []).append((cell, force, frame[2]))
        return [self._press(data, points, axes, geom, parts) for geom, parts in groups.items()]

    def _press(
        self,
        data: "MjData",
        points: np.ndarray,
        axes: np.ndarray,
        geom: int,
        parts: Sequence[tuple[int, np.ndarray, np.ndarray]],
    ) -> Press:
        """Return the press of a geom from cell, force and inward normal of each of its contacts."""
        force = np.sum([part[1] for part in parts], axis=0)
        inward = np.sum([part[1][2] * part[2] for part in parts], axis=0)
        inward /= np.linalg.norm(inward)
        gap = self._distances(data, geom, points, inward)
        gap[self._frames[:, 2] @ axes.T @ inward <= 0] = np.inf  # cells of the far side of a curved skin
        if not np.isfinite(gap).any():  # it is between the middles of cells
            gap[parts[0][0]] = 0.0
        gap -= gap.min()
        return Press(geom, np.where(gap <= self._body.thickness, gap, np.inf), force)

    def _place(self, data: "MjData") -> tuple[np.ndarray, np.ndarray]:
        """Return the middles of the cells (N, 3), m, and the axes of the site as columns, in the world."""
        axes = data.site_xmat[self._site].reshape(3, 3)
        return data.site_xpos[self._site] + self._points @ axes.T, axes

    def _distances(self, data: "MjData", geom: int, points: np.ndarray, inward: np.ndarray) -> np.ndarray:
        """Return how far a geom is from points (N, 3), m, against ``inward``; infinite where it is not.

        Rays begin behind the points, so that it may overlap with the skin. They see nothing else.
        """
        model = self._model
        origin = points.mean(axis=0) + _FAR * inward
        rays = points - origin
        lengths = np.linalg.norm(rays, axis=1)
        hits, numbers = np.empty(len(points)), np.empty(len(points), np.int32)
        settings = {name: getattr(model, name).copy() for name in ("geom_group", "geom_matid", "geom_rgba")}
        try:
            model.geom_group[:] = 0
            # Rays pass through what is invisible.
            model.geom_group[geom], model.geom_matid[geom], model.geom_rgba[geom] = 1, -1, 1
            vectors = (rays / lengths[:, None]).ravel()
            self._mujoco.mj_multiRay(
                model, data, origin, vectors, _SEEN, True, -1, numbers, hits, None, len(points), 2 * _FAR
            )
        finally:
            for name, values in settings.items():
                getattr(model, name)[:] = values
        return np.where(hits >= 0, hits - lengths, np.inf)


def _number(model: "MjModel", kind: str, name: str) -> int:
    """Return the number of a named site or geom."""
    count, get = getattr(model, f"n{kind}"), getattr(model, kind)
    names = [get(number).name for number in range(count)]
    if name not in names or not name:
        known = ", ".join(filter(None, names)) or "none with a name"
        raise InputError(f"the model has no {kind} {name!r}: give one of its {kind}s ({known})")
    return names.index(name)


class Pressing:
    """Pressure and readings of presses on a skin.

    Args:
        simulator: of the skin; its surface must be compliant.
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
                UserWarning,
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
            solved = solve_contact(
                compliance, torch.from_numpy(gaps[:, near]), torch.from_numpy(totals), iterations=1000
            )
            pressure[:, near] = solved.pressure
        return pressure.unflatten(1, self._body.shape)

    @torch.no_grad()
    def readings(self, presses: Sequence[Press], pressures: Tensor) -> Tensor:
        """Return the readings (P, S), N, of presses with pressures (P, H, W), Pa."""
        shear = None
        if self.simulator.feels_shear:
            forces = np.array([press.force for press in presses]).reshape(-1, 3)
            shear = torch.from_numpy(forces[:, :2] / forces[:, 2:])
        return self.simulator(pressures, shear).readings


class MujocoSkin:
    """A skin on a geom of a MuJoCo model.

    Each geom that touches is solved alone: its force, as MuJoCo computes it, is distributed as the shape of
    the geom and the compliance of the skin demand. Readings add up. That one geom lowers the surface under
    another is left out, which holds for objects farther apart than the skin is thick. Friction is a shear of
    each geom in proportion to its pressure. Objects are rigid; flexes of MuJoCo are not felt.

    Args:
        model: the model; it is changed and restored while rays are cast: threads need models of their own.
        site: name of the site in the middle of the skin's surface, with the chart's axes, and z outwards.
        body: the skin.
        layout: of its sensors.
        simulator: ``simulator(body, sensors)``; it needs a compliant surface.
        noise: of the readings, which :meth:`contacts` expects.
        geom: name of the geom that carries the skin; None: that of the site's body under the site.

    Attributes:
        sensors: S sensors.
        surface: the skin's surface in the model.
        posterior: estimates contacts from readings.

    Raises:
        InputError: as of :class:`MujocoSurface` and :class:`Pressing`.
    """

    def __init__(
        self,
        model: "MjModel",
        site: str,
        body: AbstractBody,
        layout: AbstractLayout,
        simulator: Callable[[AbstractBody, Sensors], AbstractSimulator] = Solid,
        noise: Noise | None = None,
        geom: str | None = None,
    ) -> None:
        self.surface = MujocoSurface(model, site, body, geom)
        self.body, self.sensors, self.noise = body, layout.sensors(body), noise or Noise(0.05)
        self._pressing = Pressing(simulator(body, self.sensors), body)

    @cached_property
    def posterior(self) -> Posterior:
        """The posterior of this skin; to prepare it takes a second."""
        return Posterior(self._pressing.simulator, self.noise, self.body)

    def pressure(self, data: "MjData") -> np.ndarray:
        """Return the pressure on the cells, (H, W), Pa."""
        return self._pressing.pressures(self.surface.presses(data)).sum(0).numpy()

    def read(self, data: "MjData") -> np.ndarray:
        """Return the true readings (S,), N, after ``mj_step`` or ``mj_forward``: no noise is added."""
        presses = self.surface.presses(data)
        return self._pressing.readings(presses, self._pressing.pressures(presses)).sum(0).double().numpy()

    def contacts(self, data: "MjData") -> FrameEstimate:
        """Return where and how hard the skin is touched, as its readings tell (:class:`Posterior`)."""
        estimate = self.posterior.estimate(self.read(data))
        assert isinstance(estimate, FrameEstimate)
        return estimate
