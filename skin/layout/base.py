"""What a sensor layout is."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from skin.body.base import AbstractBody

__all__ = ["AbstractLayout", "Sensors"]


@dataclass(frozen=True)
class Sensors:
    """Sensors placed in a body.

    Attributes:
        positions: (S, 3), m: x to the right and y downwards from the sheet's upper left corner, z the depth
            below the surface. The order of the sensors is the order of the readings everywhere.
        footprint: extent (x, y) of the area over which one sensor feels, m.
    """

    positions: np.ndarray
    footprint: tuple[float, float]

    def __len__(self) -> int:
        return len(self.positions)


class AbstractLayout(ABC):
    """Places sensors in a body."""

    @abstractmethod
    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors of this layout in ``body``.

        Raises:
            InputError: a sensor lies outside the sheet or the skin, or two lie at one place.
        """
