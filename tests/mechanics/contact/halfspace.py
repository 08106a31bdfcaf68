"""The elastic half-space, in closed form: an answer that owes nothing to the package."""

import numpy as np

__all__ = ["love"]


def love(shape: tuple[int, int], cell: tuple[float, float], modulus: float) -> np.ndarray:
    """Return how far the middle of each cell sinks under 1 Pa on each cell, (H * W, H * W), m/Pa.

    Love (1929): a rectangle of even pressure on a half-space; ``modulus`` is E / (1 - nu^2), Pa.
    """
    height, width = shape
    x = np.arange(1 - width, width) * cell[0]
    y = np.arange(1 - height, height)[:, None] * cell[1]

    def corner(east: float, south: float) -> np.ndarray:
        u, v = x + east * cell[0] / 2, y + south * cell[1] / 2
        distance = np.hypot(u, v)
        return u * np.log(v + distance) + v * np.log(u + distance)

    kernel = (corner(1, 1) - corner(1, -1) - corner(-1, 1) + corner(-1, -1)) / (np.pi * modulus)
    row, column = (positions.ravel() for positions in np.indices(shape))
    return kernel[row[:, None] - row[None] + height - 1, column[:, None] - column[None] + width - 1]
