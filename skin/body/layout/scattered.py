"""Sensors scattered at random around a grid."""

from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt
from pydantic import NonNegativeInt, PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Footprint, Tilt, place_sensors, rosette, tile_centres
from skin.body.sensors import Sensors
from skin.core.settings import checked


@checked("layout")
class Scattered(AbstractLayout):
    """A grid of sensors with random displacements, as in a hand-made skin.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        jitter: largest displacement along x and y, as a share of the pitch, 0 to 0.5.
        seed: of the displacements.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        tilt: angle between the normals of each sensor and of the surface, rad, as in ``layout=grid``.
        normals: (S, 3), direction of each sensor; None: from ``tilt``.
        depth: of all sensors or of each (S,), m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column, a jitter at which two sensors could meet, or a tilt outside 0 to pi / 2.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        jitter: Annotated[float, Ge(0), Lt(0.5)] = 0.25,
        seed: NonNegativeInt = 0,
        footprint: Footprint = (0.01, 0.01),
        tilt: Tilt = 0.0,
        depth: float | np.ndarray | None = None,
        normals: np.ndarray | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt) if normals is None else normals
        self.pitch = np.array([1 / columns, 1 / rows])
        self.jitter, self.seed = jitter, seed
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down, to the micrometre."""
        moves = np.random.default_rng(self.seed).uniform(-self.jitter, self.jitter, self.centres.shape)
        x, y = np.round((self.centres + moves * self.pitch) * body.size, 6).T
        return place_sensors(body, x, y, self.depth, self.footprint, self.normals)
