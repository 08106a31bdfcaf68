"""Sensors at random positions."""

import numpy as np
from pydantic import NonNegativeInt, PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Footprint, place_sensors
from skin.body.sensors import Sensors
from skin.core.settings import checked
from skin.errors import InputError

_TRIES = 10_000


@checked("layout")
class Random(AbstractLayout):
    """Sensors at random positions whose footprints neither overlap nor leave the surface.

    Positions are drawn one by one, uniformly; one that is too near to an earlier one is drawn again (random
    sequential adsorption).

    Args:
        count: number of sensors.
        seed: of the positions.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no sensor, or more of them than fit.
    """

    def __init__(
        self,
        count: PositiveInt = 25,
        seed: NonNegativeInt = 0,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
    ) -> None:
        self.count, self.seed = count, seed
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors from the top down, to the micrometre."""
        draw, extent = np.random.default_rng(self.seed), np.array(self.footprint)
        if (extent > body.size).any():
            raise self._explain_no_room(body)
        places = np.empty((0, 2))
        for _ in range(_TRIES):
            candidate = np.round(extent / 2 + draw.random(2) * (np.array(body.size) - extent), 6)
            if (np.abs(places - candidate) >= extent).any(axis=1).all():
                places = np.vstack([places, candidate])
            if len(places) == self.count:
                x, y = places[np.argsort(places[:, 1], kind="stable")].T
                return place_sensors(body, x, y, self.depth, self.footprint)
        raise self._explain_no_room(body)

    def _explain_no_room(self, body: AbstractBody) -> InputError:
        width, height = self.footprint
        return InputError(
            f"{self.count} sensors of {width:g} x {height:g} m do not fit at random on {body.size[0]:g} x "
            f"{body.size[1]:g} m: lower layout.count or layout.footprint, or set layout=grid"
        )
