"""Choose the sites of sensors whose readings tell most.

All functions take the covariance of the readings at C sites divided by the variance of the noise, A (C, C).
The information of the sites S is that between noisy Gaussian readings and true ones, 1/2 log det(I + A_SS),
in nats.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve

from skin.errors import InputError

Sites = Sequence[int] | np.ndarray
"""Indices of sites."""

_TIE = 1e-9  # relative difference below which two sites are equally good


def mutual_information(signal: np.ndarray, sites: Sites) -> float:
    """Return 1/2 log det(I + A_SS) of some sites, nats.

    Args:
        signal: A, (C, C).
        sites: S.
    """
    chosen = np.asarray(sites, dtype=int)
    return float(np.linalg.slogdet(np.eye(len(chosen)) + signal[np.ix_(chosen, chosen)])[1] / 2)


def too_near(places: np.ndarray, distance: float) -> np.ndarray:
    """Return which sites cannot both carry a sensor, (C, C), bool; a site is too near to itself.

    Args:
        places: (C, 2), m.
        distance: least distance of two sensors, m; it is compared to within 1 micrometre.
    """
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return (apart < distance - 1e-6) | np.eye(len(places), dtype=bool)


def greedy(signal: np.ndarray, count: int, near: np.ndarray, fixed: Sites = ()) -> list[int]:
    """Choose sites one by one, each with the largest gain of information.

    The gain of a site is half the logarithm of its variance given the chosen ones. A pivoted Cholesky
    factorisation updates the variances of all sites in O(C k) per step, so a lazy evaluation of gains would
    save nothing. Of equally good sites, the first is chosen.

    Args:
        signal: A, (C, C).
        count: number of sites, with the fixed ones.
        near: as of :func:`too_near`, (C, C).
        fixed: sites that are chosen first; they may be near each other.

    Returns:
        the fixed sites, then the others in the order of their choice.

    Raises:
        InputError: no site is left that is not too near to a chosen one.
    """
    variance = 1 + np.diag(signal)
    factor = np.empty((count, len(signal)))
    allowed = np.ones(len(signal), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count:
        staying = len(chosen) < len(fixed)
        if not staying and not allowed.any():
            raise InputError(
                f"only {len(chosen)} of {count} sensors fit, because each other site is too near to one of "
                "them: lower design.count or design.distance, or set a finer design.raster"
            )
        site = int(fixed[len(chosen)]) if staying else _best(variance, allowed)
        above = factor[: len(chosen)]
        row = signal[site] - above[:, site] @ above
        row[site] += 1
        factor[len(chosen)] = row / np.sqrt(row[site])
        variance -= factor[len(chosen)] ** 2
        allowed &= ~near[site]
        chosen.append(site)
    return chosen


def exchange(signal: np.ndarray, sites: Sites, near: np.ndarray, fixed: int = 0) -> list[int]:
    """Move one sensor at a time to the best free site until no move gains information.

    Args:
        signal: A, (C, C).
        sites: as of :func:`greedy`.
        near: as of :func:`too_near`, (C, C).
        fixed: number of the first sites that stay.

    Returns:
        the sites, in the same order.
    """
    found, moved = list(sites), True
    while moved:
        moved = False
        for number in range(fixed, len(found)):
            others = found[:number] + found[number + 1 :]
            variance = _variance(signal, others)
            best = _best(variance, np.logical_not(near[others].any(axis=0)))
            if variance[best] > variance[found[number]] * (1 + _TIE):
                found[number], moved = best, True
    return found


def given(signal: np.ndarray, sites: Sites) -> np.ndarray:
    """Return A of all other sites, in their order, given the noisy readings of some.

    Args:
        signal: A, (C, C).
        sites: the k sites that are given.

    Returns:
        (C - k, C - k).
    """
    rest = np.setdiff1d(np.arange(len(signal)), sites)
    rows = signal[np.asarray(sites, dtype=int)]
    return signal[np.ix_(rest, rest)] - (rows.T @ _solved(rows, sites))[np.ix_(rest, rest)]


def _best(variance: np.ndarray, allowed: np.ndarray) -> int:
    """Return the first of the allowed sites with the largest variance (C,), to within rounding."""
    most = variance[allowed].max()
    return int(np.flatnonzero(allowed & (variance >= most * (1 - _TIE)))[0])


def _variance(signal: np.ndarray, given: Sites) -> np.ndarray:
    """Return the variance (C,) of each noisy reading given those of some other sites."""
    rows = signal[np.asarray(given, dtype=int)]
    return 1 + np.diag(signal) - (rows * _solved(rows, given)).sum(axis=0)


def _solved(rows: np.ndarray, sites: Sites) -> np.ndarray:
    """Return (I + A_SS)^-1 times the rows of A at S, (k, C)."""
    if not len(sites):
        return rows
    return solve(np.eye(len(sites)) + rows[:, np.asarray(sites)], rows, assume_a="pos")
