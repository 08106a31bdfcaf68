"""The interface of simulators: maps from surface pressure to true sensor readings.

Readings are differentiable with respect to pressure and shear, not to moduli, thicknesses or positions.
"""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor, nn

from skin.body.base import Sensors
from skin.core.settings import option_name
from skin.errors import InputError
from skin.touch.movie import Movie

# The factorisation of a stiffness.


def factorised(stiffness: sp.csc_matrix) -> SuperLU:
    """Return the factors of a matrix that is symmetric and positive definite.

    That needs no pivoting, and has an ordering of its own kind.
    """
    return splu(stiffness, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class Response(NamedTuple):
    """Response of the skin to a pressure, before imperfections of a device.

    Attributes:
        readings: (..., S), N.
        displacement: (..., S, 2), m: D_s at each sensor's depth and D_t at the surface above it, positive
            into the skin; None if the simulator has none, or computes them only where asked.
    """

    readings: Tensor
    displacement: Tensor | None


class AbstractSimulator(nn.Module, ABC):
    """Maps pressure (..., H, W) in Pa on the surface cells to a :class:`Response`.

    Every simulator is positively homogeneous: ``k`` times the pressure gives ``k`` times the response, for
    k >= 0. A static touch with any time profile therefore needs one frame.

    Attributes:
        feels_shear: whether readings depend on tangential forces too.
        mechanical: whether readings depend on the thickness and stiffness of the layers.
        axes: sensors of a site: 3 if they measure along the surface too.
        smooth: whether the loads of movies are moments of the pressure (:mod:`skin.touch.shapes`) instead of
            mean pressures of cells.
    """

    feels_shear: ClassVar[bool] = False
    mechanical: ClassVar[bool] = True
    smooth: ClassVar[bool] = False
    axes = 1

    @abstractmethod
    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa.

        Args:
            pressure: on the surface cells, into the skin.
            shear: (..., 2), tangential traction along x and y of each frame divided by its pressure: the
                coefficient of friction times the direction of motion. None: no friction.

        Raises:
            InputError: shear, if the simulator does not support it.
        """

    def loads(self, pressure: Tensor) -> Tensor:
        """Return mean pressures of cells (..., H, W), Pa, as loads, Pa."""
        return pressure

    def press(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Response:
        """Return the response to loads (..., H, W), Pa.

        Args:
            loads: of :meth:`loads`.
            shear: (..., 2), that of :meth:`forward`.
            displacement: whether to compute the displacement.
        """
        return self(loads, shear)

    def linear(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Tensor:
        """Return the quantities (..., R) that are linear in the loads, the input of :meth:`read`.

        Raises:
            InputError: the simulator has no mechanics.
        """
        raise InputError(
            f"relaxation of materials needs a simulator with mechanics, got simulator={self._name}: set "
            "simulator=fem or simulator=solid, or remove the relaxation from the materials"
        )

    def read(self, linear: Tensor) -> Response:
        """Return the response for the linear quantities (..., R)."""
        raise NotImplementedError

    def play(
        self,
        frames: Tensor,
        index: Tensor,
        scale: Tensor,
        shear: Tensor | None = None,
        displacement: bool = False,
    ) -> Response:
        """Return the response to movies, (B, T, ...); each distinct frame is solved once.

        Args:
            frames: (U, H, W), loads, Pa.
            index: (B, T), the frame at each time.
            scale: (B, T), factor of the frame.
            shear: (U, 2), as in :meth:`forward`.
            displacement: whether to compute the displacement.
        """
        readings, moves = self.press(frames, shear, displacement)
        scaled = readings[index] * scale[..., None]
        if moves is None or not displacement:
            return Response(scaled, None)
        return Response(scaled, moves[index] * scale[..., None, None])

    def respond(self, movie: Movie, displacement: bool = False) -> Response:
        """Return the readings (B, T, S), N, of gestures, and the displacement (B, T, S, 2), m, if asked for.

        It is None if the simulator does not compute it.
        """
        home = next(self.buffers(), movie.frames).device
        shear = None if movie.shear is None else movie.shear.to(home)
        index, scale = movie.index.to(home), movie.scale.to(home)
        return self.play(movie.frames.to(home), index, scale, shear, displacement)

    def refuse_shear(self) -> None:
        """Raise InputError if this simulator does not support friction."""
        if not self.feels_shear:
            raise InputError(
                "friction needs a simulator with tangential forces, got "
                f"simulator={self._name}: set simulator=solid, or touch.shear=0"
            )

    def refuse_tilted(self, sensors: Sensors) -> None:
        """Raise InputError for a tilted sensor, or one of three axes, if this simulator has none."""
        along = (sensors.measured[:, :2] != 0).any(axis=1)
        if not self.feels_shear and along.any():
            raise InputError(
                f"sensor {int(along.argmax()) + 1} is tilted or measures along the surface, but "
                f"simulator={self._name} has normal forces only: set simulator=solid, or layout.tilt=0 "
                "layout.axes=normal, or directions (0, 0, 1)"
            )

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the displacement of each sensor along x, along y and into the skin, (..., S, 3), m.

        Positively homogeneous like the response; ``shear`` (..., 2) is that of :meth:`forward`.

        Raises:
            InputError: this simulator has no displacements along the sheet, or does not support shear.
        """
        raise InputError(
            f"displacements of sensors along the sheet are not known for simulator={self._name}: "
            "set simulator=fem simulator.constraint=free"
        )

    def compliance(self) -> Tensor:
        """Return C (cells, cells), m/Pa: inward displacement of each cell's surface under 1 Pa on each cell.

        Raises:
            InputError: this simulator has no compliance.
        """
        raise InputError(
            "a rigid object needs a simulator with a compliant surface, got "
            f"simulator={self._name}: set simulator=solid, or contact=prescribed"
        )

    def surface(self, loads: Tensor) -> Tensor | None:
        """Return how far the corners of the cells move into the skin, (F, H + 1, W + 1), m, under loads.

        None if this simulator does not compute it.
        """
        return None

    def pressure_rows(self, sensors: Sensors) -> np.ndarray | None:
        """Return the readings of other sensors under a load of 1 Pa of each cell, (S, cells), N/Pa.

        None if that is not faster than a simulator of these sensors, or if readings are not linear.
        """
        return None

    def strain(self, loads: Tensor, shear: Tensor | None = None) -> Tensor | None:
        """Return the largest principal strain of the top layer under loads (U, H, W), (U,), 1.

        From the linear solution, which is valid up to about 0.3. None if the simulator has no mechanics.
        """
        return None

    @property
    def _name(self) -> str:
        return option_name(self)


def flatten(pressure: Tensor, shape: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Return pressure (..., H, W), Pa, as (..., H*W) of the simulator's own dtype.

    Raises:
        ValueError: the frames do not have the shape of the sheet's cells, or are not floating point.
    """
    if pressure.ndim < 2 or tuple(pressure.shape[-2:]) != shape:
        raise ValueError(f"pressure must be (..., H, W) with H, W = {shape}, got {tuple(pressure.shape)}")
    if not pressure.is_floating_point():
        raise ValueError(f"pressure must be floating point, in Pa, got {pressure.dtype}")
    return pressure.to(dtype).flatten(-2)


# The largest strain of the top layer, which shows whether the linear solution is valid.


# Components xx, yy, zz, yz, xz, xy, and how often each stands in the tensor.
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
_TIMES = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


def largest_strain(cells: Tensor, rows: Tensor, at_once: int = 2**24) -> Tensor:
    """Return the largest principal strain by size, (F,), under pressures on the cells (F, cells), Pa.

    Where the strain tensor is largest by its norm; a single component is its own principal strain.

    Args:
        cells: (F, cells), Pa.
        rows: (C, places, cells), 1/Pa, with C = 1, or 6 for xx, yy, zz, yz, xz, xy.
        at_once: numbers that are computed at a time.
    """
    components, positions, _ = rows.shape
    strains = []
    for part in cells.split(max(1, at_once // (components * positions))):
        strain = (part @ rows.flatten(0, 1).T).unflatten(-1, (components, positions))
        if components == 1:
            strains.append(strain.abs().amax((1, 2)))
            continue
        at = (strain.square() * _TIMES[:, None]).sum(1).argmax(1)
        worst = strain[torch.arange(len(part)), :, at]
        tensor = worst.new_zeros(len(part), 3, 3)
        for value, (i, j) in zip(worst.T, _PAIRS, strict=True):
            tensor[:, i, j] = tensor[:, j, i] = value
        strains.append(torch.linalg.eigvalsh(tensor).abs().amax(1))
    return torch.cat(strains)
