"""What a simulator is: a differentiable map from surface pressure to true sensor readings."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

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
