"""What a simulator is: a differentiable map from surface pressure to true sensor readings."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

from skin.errors import InputError

__all__ = ["AbstractSimulator", "Response"]


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
    """

    @abstractmethod
    def forward(self, pressure: Tensor) -> Response:
        """Return the response to pressure (..., H, W), Pa."""

    def motion(self, pressure: Tensor) -> Tensor:
        """Return how far each sensor moves along x, along y and into the skin, (..., S, 3), m.

        Positively homogeneous like the response.

        Raises:
            InputError: in this simulator sensors do not move along the sheet.
        """
        name = type(self).__module__.rpartition(".")[2]
        raise InputError(
            f"sensors that move need a simulator in which they can, got simulator={name}: "
            "set simulator=fem simulator.constraint=free"
        )
