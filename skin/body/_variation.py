"""A modulus that varies from cell to cell."""

import math

import numpy as np

from skin.rng import Stream, generator


def factors(variation: float, seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return independent log-normal numbers with mean 1 and standard deviation ``variation``.

    Without variation they are exactly 1.
    """
    spread = math.sqrt(math.log1p(variation**2))
    values = np.exp(spread * generator(Stream.MODULUS, seed).standard_normal(shape) - spread**2 / 2)
    values.setflags(write=False)
    return values


def along(field: np.ndarray, cell: tuple[float, float], first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the exact means (n,) of a field, constant in each cell, along straight lines.

    Args:
        field: (H, W).
        cell: extent (x, y) of a cell, m.
        first: start points of the lines, (n, 2), m.
        second: end points, (n, 2), m, different from the start points.
    """
    rows, columns = field.shape
    crossings = []
    for axis, count in ((0, columns), (1, rows)):
        start, way = first[:, axis, None], (second - first)[:, axis, None]
        level = way == 0
        share = (cell[axis] * np.arange(count + 1) - start) / np.where(level, 1, way)
        crossings.append(np.where(level, 0, share))
    ends = np.broadcast_to([0.0, 1.0], (len(first), 2))
    cuts = np.sort(np.clip(np.hstack([*crossings, ends]), 0, 1), axis=1)
    middle = (cuts[:, 1:] + cuts[:, :-1])[..., None] / 2
    place = (first[:, None] + middle * (second - first)[:, None]) / np.array(cell)
    column, row = np.clip(place, 0, [columns - 1, rows - 1]).astype(np.int64).transpose(2, 0, 1)
    return (np.diff(cuts, axis=1) * field[row, column]).sum(axis=1)
