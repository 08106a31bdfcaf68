"""Sensors on a regular grid."""

import numpy as np
from pydantic import PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Footprint, Tilt, place_sensors, rosette, tile_centres
from skin.body.sensors import Sensors
from skin.core.settings import checked


@checked("layout")
class Grid(AbstractLayout):
    """Sensors at the centres of equal tiles of the body's surface.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        tilt: angle between the normals of each sensor and of the surface, rad, along +x, +y, -x and -y in
            turn, so that neighbours respond to different directions of shear. Only ``simulator=solid``
            supports it.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column, or a tilt outside 0 to pi / 2.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        footprint: Footprint = (0.01, 0.01),
        tilt: Tilt = 0.0,
        depth: float | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt)
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        x, y = (self.centres * np.array(body.size)).T
        return place_sensors(body, x, y, self.depth, self.footprint, self.normals)
