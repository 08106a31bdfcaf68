"""The interface of sensor layouts, and checks of sensor positions."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt
from pydantic import PositiveFloat

from skin.body.base import AbstractBody
from skin.body.sensors import Sensors
from skin.core.settings import checked
from skin.errors import InputError

# Positions and normals of sensors on a regular grid.


Tilt = Annotated[float, Ge(0), Lt(math.pi / 2)]
"""Angle between the normals of a sensor and of the surface, rad."""

_WAYS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def tile_centres(rows: int, columns: int) -> np.ndarray:
    """Return the centres (S, 2) of rows x columns equal tiles of the unit square, row by row."""
    y, x = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])


def rosette(rows: int, columns: int, tilt: float) -> np.ndarray:
    """Return the normals (S, 3) of a grid's sensors, row by row, tilted along +x, +y, -x and -y in turn.

    Each row is shifted by two directions against the row above. A sensor then differs from its eight
    neighbours, and each block of two by two sensors has all four directions, so that shear along any
    direction is sensed everywhere.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        tilt: angle between the sensors' normals and the surface's, rad, from 0 to below pi / 2.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    lean = math.sin(tilt) * _WAYS[(column + 2 * row) % 4]
    # -0.0 and 0.0 would give different keys of stored operators.
    return np.column_stack([lean + 0.0, np.full(len(lean), math.cos(tilt))])


Footprint = tuple[PositiveFloat, PositiveFloat]
"""Extent (x, y) of the sensitive area of a sensor, m."""

# Two sensors closer than this in the plane are at one place, m.
_APART = 1e-6


class AbstractLayout(ABC):
    """Places sensors in a body."""

    @abstractmethod
    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors of this layout in ``body``.

        Raises:
            InputError: a sensor lies outside the body, or two lie at one place.
        """


def place_sensors(
    body: AbstractBody,
    x: np.ndarray,
    y: np.ndarray,
    depth: np.ndarray | float | None,
    footprint: Footprint,
    normals: np.ndarray | None = None,
) -> Sensors:
    """Return sensors at x and y, each (S,), m.

    Args:
        body: the body.
        x, y: (S,), m.
        depth: of all sensors or of each (S,), m; None: ``body.sensor_depth``.
        footprint: extent (x, y) of the sensitive area, m.
        normals: (S, 3), unit vectors; None: those of the surface.

    Raises:
        InputError: a depth that is not a number, a sensor outside the body, or two sensors with the same x
            and y, because images and graphs are flat.
    """
    depths = np.asarray(body.sensor_depth if depth is None else depth)
    if depths.dtype.kind not in "if":
        raise InputError(f"layout.depth must be a length in m or null, got {depth!r}: as in 0.004")
    positions = np.column_stack([x, y, np.broadcast_to(depths, x.shape)])
    _check_inside(body, positions)
    _check_distances(positions)
    extent = float(footprint[0]), float(footprint[1])
    return Sensors(positions, extent) if normals is None else Sensors(positions, extent, normals)


def _check_inside(body: AbstractBody, positions: np.ndarray) -> None:
    extent = np.array([*body.size, body.thickness])
    outside = ((positions < 0) | (positions > extent + 1e-9)).any(axis=1)
    if outside.any():
        number = int(outside.argmax())
        x, y, depth = positions[number]
        raise InputError(
            f"{outside.sum()} of {len(positions)} sensors lie outside the body; the first is "
            f"sensor {number + 1} at x = {x:g} m, y = {y:g} m, depth = {depth:g} m, on a surface of "
            f"{extent[0]:g} x {extent[1]:g} m, {extent[2]:g} m thick: positions are in metres from the "
            "upper left corner; correct the layout, set a larger body or layout=grid"
        )


def _check_distances(positions: np.ndarray) -> None:
    # Not all pairs, which would take gigabytes for the most sensors that a file may have.
    from scipy.spatial import cKDTree  # a mistake in the settings must not wait for it

    distance, nearest = cKDTree(positions[:, :2]).query(positions[:, :2], k=2)
    close = np.flatnonzero(distance[:, 1] < _APART)
    if len(close):
        first = int(close[0])
        second = next(int(index) for index in nearest[first] if index != first)
        x, y, _ = positions[first]
        raise InputError(
            f"sensors {first + 1} and {second + 1} are at one place, x = {x:g} m, y = {y:g} m: "
            "move one or remove it from the layout"
        )


# Sensors whose positions are settings: those of a layout that was built in Python.


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
        return place_sensors(body, x, y, depth, self.footprint, self.normals)
