"""What a simulator is: a differentiable map from surface pressure to true sensor readings."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from skin.errors import InputError
from skin.option import option_name
from skin.sensors import Sensors
from skin.touch.movie import Movie


class Response(NamedTuple):
    """What the skin answers to a pressure, before any imperfection of a device.

    Attributes:
        readings: (..., S), N.
        displacement: (..., S, 2), m: D_s at each sensor's depth and D_t at the surface above it, positive
            into the skin; or None where the simulator knows no displacement.
    """

    readings: Tensor
    displacement: Tensor | None


class AbstractSimulator(nn.Module, ABC):
    """Maps pressure (..., H, W) in Pa on the surface cells to a :class:`Response`.

    Every simulator is positively homogeneous: ``k`` times the pressure gives ``k`` times the response, for
    k >= 0. So a static touch needs one image, whatever its time profile.

    Attributes:
        feels_shear: readings depend on forces along the surface too.
        mechanical: readings depend on the layers' thickness and stiffness.
    """

    feels_shear: ClassVar[bool] = False
    mechanical: ClassVar[bool] = True

    @abstractmethod
    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa.

        Args:
            pressure: on the surface cells, into the skin.
            shear: (..., 2), the traction along x and y that goes with each frame, over its pressure: the
                coefficient of friction times the direction in which the object moves. None: no friction.

        Raises:
            InputError: shear, where the simulator feels none.
        """

    def linear(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return what is linear in the pressure, (..., R): that of which :meth:`read` makes the response.

        Raises:
            InputError: the simulator has no mechanics.
        """
        raise InputError(
            f"materials relax where there are mechanics, got simulator={self._name}: set simulator=fem or "
            "simulator=solid, or leave out the materials' relaxation"
        )

    def read(self, linear: Tensor) -> Response:
        """Return the response that has these linear parts (..., R)."""
        raise NotImplementedError

    def play(
        self,
        frames: Tensor,
        index: Tensor,
        scale: Tensor,
        shear: Tensor | None = None,
        displacement: bool = True,
    ) -> Response:
        """Return the response to movies, (B, T, ...); each distinct frame is solved for once.

        Args:
            frames: (U, H, W), Pa.
            index: (B, T), which frame is shown.
            scale: (B, T), by what it is multiplied.
            shear: (U, 2), as of :meth:`forward`.
            displacement: False leaves it out.
        """
        readings, moves = self(frames, shear)
        shown = readings[index] * scale[..., None]
        if moves is None or not displacement:
            return Response(shown, None)
        return Response(shown, moves[index] * scale[..., None, None])

    def respond(self, movie: Movie, displacement: bool = True) -> Response:
        """Return the readings (B, T, S), N, of gestures, and the displacement (B, T, S, 2), m.

        The displacement is None if the simulator knows none, or if it is not asked for.
        """
        home = next(self.buffers(), movie.frames).device
        shear = None if movie.shear is None else movie.shear.to(home)
        index, scale = movie.index.to(home), movie.scale.to(home)
        return self.play(movie.frames.to(home), index, scale, shear, displacement)

    def refuse_shear(self) -> None:
        """Raise an InputError that says which simulator feels friction, unless this one does."""
        if not self.feels_shear:
            raise InputError(
                "friction needs a simulator that feels forces along the surface, got "
                f"simulator={self._name}: set simulator=solid, or touch.shear=0"
            )

    def refuse_tilted(self, sensors: Sensors) -> None:
        """Raise an InputError that names a sensor that leans, unless this simulator feels that."""
        if not self.feels_shear and sensors.tilted.any():
            raise InputError(
                f"sensor {int(sensors.tilted.argmax()) + 1} is tilted, but simulator={self._name} knows only "
                "forces across the surface: set simulator=solid, or give normals (0, 0, 1)"
            )

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return how far each sensor moves along x, along y and into the skin, (..., S, 3), m.

        Positively homogeneous like the response, and with ``shear`` (..., 2) as :meth:`forward` takes it.

        Raises:
            InputError: in this simulator sensors do not move along the sheet, or it feels no shear.
        """
        raise InputError(
            f"sensors that move need a simulator in which they can, got simulator={self._name}: "
            "set simulator=fem simulator.constraint=free"
        )

    def compliance(self) -> Tensor:
        """Return C (cells, cells), m/Pa: how far each cell's surface moves inwards under 1 Pa on each cell.

        Raises:
            InputError: in this simulator the surface does not move as a whole.
        """
        raise InputError(
            "a rigid object needs a simulator whose surface gives way, got "
            f"simulator={self._name}: set simulator=solid, or contact=prescribed"
        )

    def strain(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor | None:
        """Return the largest principal strain of the top layer under pressures (U, H, W), (U,), 1.

        By the linear solution, which holds to about 0.3. None where the simulator has no mechanics.
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
