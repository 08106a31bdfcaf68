"""Moments of a pressure with cubic B-splines, one centred at each cell.

The moment of a cell is the integral of the pressure times the spline, divided by the cell's area, Pa. Sums of
the splines represent a smooth influence far better than constants on the cells do, so that moments tell where
within a cell a small contact presses. At an edge of the sheet a spline beyond it is folded back. The splines
then add up to 1 everywhere: an even pressure is its own moment, and moments conserve force.
"""

from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import BSpline

REACH = 2
"""How far a spline reaches from the middle of its cell, in cells."""

_PIECE = BSpline.basis_element(np.arange(-REACH, REACH + 1.0), extrapolate=False)
_GAUSS, _WEIGHTS = np.polynomial.legendre.leggauss(4)  # exact for products of two cubics
_PIECES = 4  # in which a cell is integrated


def spline_values(points: np.ndarray, count: int) -> np.ndarray:
    """Return the splines of ``count`` cells at points (P,), in cells, (P, count)."""
    middles = np.arange(-REACH, count + REACH) + 0.5
    return fold_back(torch.from_numpy(np.nan_to_num(_PIECE(points[:, None] - middles)))).numpy()


def sampled(
    begin: np.ndarray, count: int, samples: int, minimum: np.ndarray, maximum: np.ndarray
) -> torch.Tensor:
    """Return the splines of cells -2 to ``count`` + 2 at even samples of ``count`` cells' lengths.

    Args:
        begin: (F,), of the first length, in cells, 0 to 1 unless it begins beyond an edge.
        count: of lengths.
        samples: of each length.
        minimum, maximum: (F,), the edges of the sheet, in cells; samples beyond them weigh 0.

    Returns:
        (F, count * samples, count + 5), float32, divided by ``samples``.
    """
    start, low, high = (torch.from_numpy(ends)[:, None].float() for ends in (begin, minimum, maximum))
    points = start + (torch.arange(count * samples) + 0.5) / samples
    inside = (points >= low) & (points <= high)
    middles = torch.arange(-REACH, count + 1 + REACH) + 0.5
    away = (points[:, :, None] - middles).abs()
    # The spline at a distance d is ((2 - d)+^3 - 4 (1 - d)+^3) / 6.
    wide, narrow = (2 - away).clamp_(min=0), (1 - away).clamp_(min=0)
    cubes = wide.square().mul_(wide).sub_(narrow.square().mul_(narrow), alpha=4)
    return cubes.mul_(inside[:, :, None] / (6 * samples))


def fold_back(wide: torch.Tensor) -> torch.Tensor:
    """Return values (B, H + 4, ...) of splines with those beyond the edges folded back, (B, H, ...)."""
    inner = wide[:, REACH:-REACH].clone()
    for beyond in range(REACH):
        inner[:, beyond] += wide[:, REACH - 1 - beyond]
        inner[:, inner.shape[1] - 1 - beyond] += wide[:, inner.shape[1] + REACH + beyond]
    return inner


def gauss_points(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points and weights between two points, in cells, by pieces of a quarter of a cell."""
    cuts = np.unique([low, *(np.arange(np.ceil(low * _PIECES), high * _PIECES) / _PIECES), high])
    middle, half = (cuts[1:] + cuts[:-1]) / 2, np.diff(cuts) / 2
    return (middle[:, None] + np.outer(half, _GAUSS)).ravel(), np.outer(half, _WEIGHTS).ravel()


@lru_cache
def of_cells(count: int) -> np.ndarray:
    """Return the moments (count, count) of 1 Pa on each cell (columns) along one axis."""
    points, weights = gauss_points(0, count)
    return (weights[:, None] * spline_values(points, count)).reshape(count, -1, count).sum(1).T
