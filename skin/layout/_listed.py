"""Sensors whose positions are settings: those of a layout that was built in Python."""

from collections.abc import Sequence

import numpy as np

from skin.body.base import AbstractBody
from skin.layout.base import AbstractLayout, Footprint, place
from skin.sensors import Sensors
from skin.settings import checked


@checked("layout")
class Listed(AbstractLayout):
    """Sensors at given positions.

    Args:
        positions: of S sensors, (x, y, z) each, m: from the upper left corner, z the depth.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        normals: of the sensors, unit vectors (x, y, into the skin); None: those of the surface.

    Raises:
        InputError: two sensors at one place.
    """

    def __init__(
        self,
        positions: Sequence[tuple[float, float, float]],
        footprint: Footprint = (0.01, 0.01),
        normals: Sequence[tuple[float, float, float]] | None = None,
    ) -> None:
        self.positions, self.footprint = np.array(positions, dtype=float), footprint
        self.normals = None if normals is None else np.array(normals, dtype=float)

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in their order."""
        x, y, depth = self.positions.T
        return place(body, x, y, depth, self.footprint, self.normals)
