"""A flat sheet of silicone layers on a rigid base."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skin.body.base import AbstractBody
from skin.core.settings import checked


@checked("body")
@dataclass(frozen=True)
class Sheet(AbstractBody):
    """A rectangular sheet of layers on a rigid base; its chart is the sheet seen from above.

    In space x and y are those of the chart, and z points up from the surface.
    """

    flat: ClassVar[bool] = True

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) of the chart, m, are in space: (x, y, -depth), m."""
        return np.asarray(points) * np.array([1.0, 1.0, -1.0])

    def frame(self, points: np.ndarray) -> np.ndarray:
        """Return the local axes at points (..., 3), (..., 3, 3): everywhere x, y and down."""
        return np.broadcast_to(np.diag([1.0, 1.0, -1.0]), (*np.shape(points)[:-1], 3, 3)).copy()
