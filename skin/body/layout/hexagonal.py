"""Sensors in staggered rows."""

import numpy as np
from pydantic import PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Footprint, place_sensors, tile_centres
from skin.body.sensors import Sensors
from skin.core.settings import checked


@checked("layout")
class Hexagonal(AbstractLayout):
    """Sensors in rows of which every other one is moved by half a pitch.

    Every sensor has six nearest neighbours at equal distances where the pitch of the rows is 0.87 of that of
    the sensors in a row.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        odd = np.repeat(np.arange(rows) % 2, columns)
        # A quarter of a pitch to either side keeps the rows within the surface.
        self.centres[:, 0] += (0.5 * odd - 0.25) / columns
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        x, y = (self.centres * np.array(body.size)).T
        return place_sensors(body, x, y, self.depth, self.footprint)
