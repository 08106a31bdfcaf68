"""Positions and normals of sensors on a regular grid."""

import math
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt

Tilt = Annotated[float, Ge(0), Lt(math.pi / 2)]
"""Angle between the normals of a sensor and of the surface, rad."""

_WAYS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def grid(rows: int, columns: int) -> np.ndarray:
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
