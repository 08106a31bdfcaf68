"""An upper bound of the information of sensors at any sites."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh, eigvalsh

from skin.design.placement import Sites, given, mutual_information

_ITERATIONS = 200
_INSIDE = 0.95  # share of the way to the nearest constraint that a step may take
_SHORTEST = 1e-9  # share of a step


def upper_bound(signal: np.ndarray, count: int, fixed: Sites = (), gap: float = 5e-3) -> float:
    """Return an upper bound of the information of any ``count`` sites, nats.

    A concave relaxation gives each site a weight from 0 to 1, of the sum ``count`` (:class:`_Relaxation`).
    A Newton method with logarithmic barriers searches the best weights. Every step gives a bound that is
    valid however far the weights are from the best ones. The bound ignores the distance between sensors.

    Args:
        signal: A, (C, C).
        count: number of sites, with the fixed ones.
        fixed: sites that every choice has.
        gap: between the bound and the value of the relaxation, relative, at which the search stops.
    """
    known, rest = mutual_information(signal, fixed), given(signal, fixed)
    number = count - len(fixed)
    if number in (0, len(rest)):
        return known + mutual_information(rest, range(len(rest))[:number])
    relaxation = _Relaxation(rest, number)
    weights = np.full(len(rest), number / len(rest))
    state = relaxation.at(weights)
    barrier, bound = 0.1 * state.value / len(rest), state.bound
    for _ in range(_ITERATIONS):
        if bound - state.value <= gap * (known + state.value):
            break
        weights, centred = _step(relaxation, weights, state, barrier)
        state = relaxation.at(weights)
        bound = min(bound, state.bound)
        barrier *= 0.2 if centred else 1.0
    return known + bound


class _State(NamedTuple):
    """The relaxation at weights z.

    Attributes:
        value: f(z), nats.
        bound: of the information of any sites, nats.
        gradient: of f, (C,).
        curvature: (C, C), at least the negative Hessian of f.
    """

    value: float
    bound: float
    gradient: np.ndarray
    curvature: np.ndarray


class _Relaxation:
    """The augmented factorisation bound (Li, arXiv 2410.10078) of the information of k sites, with A = B B'.

    For the weights 1 of k sites and 0 of all others, X = B' Z B has at most the rank k, and the information
    is f(z) = 1/2 log det(I + X). For other weights f replaces the smallest eigenvalues of X by fewer equal
    ones of the same sum, so that only k remain. Without this (Joshi and Boyd, 2009) the relaxation spreads
    the weights over more sites and gains far more information than k sensors can have.

    The bound does not depend on the concavity of f. For a positive matrix T with the eigenvalues t in
    ascending order, log(1 + x) <= t x + h(t) with h(t) = t - 1 - log t (0 above t = 1) gives
    log det(I + X) <= tr(T X) + h(t_1) + ... + h(t_k) for every X of at most the rank k, and tr(T X) =
    z . diag(B T B') is at most the sum of the k largest entries of this diagonal. T is the gradient of
    2 f with respect to X.
    """

    def __init__(self, signal: np.ndarray, count: int) -> None:
        values, vectors = eigh(signal)
        self._rows = vectors * np.sqrt(np.clip(values, 0, None))
        self._count = count

    def at(self, weights: np.ndarray) -> _State:
        """Return value, bound and derivatives at weights (C,)."""
        values, vectors = eigh((self._rows.T * weights) @ self._rows)
        level, large = self._split(values)
        merged = len(values) - large
        slopes = 1 / (1 + np.maximum(values, level))
        turned = self._rows @ vectors
        inner = (turned * slopes) @ turned.T
        gradient = np.diag(inner) / 2
        least = slopes[::-1][: self._count]
        above = float((least - 1 - np.log(least)).sum() / 2)
        bound = float(np.sort(gradient)[-self._count :].sum()) + above
        small = (turned[:, :merged] ** 2).sum(axis=1)
        curvature = inner**2 + np.outer(small, small) / ((1 + level) ** 2 * (self._count - large))
        return _State(self._value(values), bound, gradient, curvature / 2)

    def value(self, weights: np.ndarray) -> float:
        """Return f(z), nats, of weights (C,)."""
        return self._value(eigvalsh((self._rows.T * weights) @ self._rows))

    def _value(self, values: np.ndarray) -> float:
        level, _ = self._split(values)
        return float(np.log1p(np.maximum(values, level)[-self._count :]).sum() / 2)

    def _split(self, values: np.ndarray) -> tuple[float, int]:
        """Return the level that replaces the small eigenvalues (C,), ascending, and how many are large."""
        small = np.clip(values, 0, None)
        for large in range(self._count):
            level = float(small.sum()) / (self._count - large)
            if small[-1] <= level:  # at the latest when one level takes the place of all small ones
                break
            small = small[:-1]
        return level, large


def _step(
    relaxation: _Relaxation,
    weights: np.ndarray,
    state: _State,
    barrier: float,
) -> tuple[np.ndarray, bool]:
    """Return the weights after a Newton step with constant sum, and whether they hardly changed.

    The function is f(z) + barrier * sum(log z + log(1 - z)).
    """
    slope = state.gradient + barrier * (1 / weights - 1 / (1 - weights))
    curved = state.curvature + np.diag(barrier * (1 / weights**2 + 1 / (1 - weights) ** 2))
    solved = cho_solve(cho_factor(curved), np.column_stack([slope, np.ones_like(slope)]))
    step = solved[:, 0] - solved[:, 1] * (solved[:, 0].sum() / solved[:, 1].sum())
    rise = float(step @ slope)
    room = np.where(
        step > 0, (1 - weights) / np.where(step > 0, step, 1), -weights / np.where(step < 0, step, -1)
    )
    length = min(1.0, _INSIDE * float(room[step != 0].min(initial=np.inf)))

    def total(z: np.ndarray) -> float:
        return relaxation.value(z) + barrier * float(np.log(z).sum() + np.log1p(-z).sum())

    start = total(weights)
    while total(weights + length * step) < start + 0.01 * length * rise and length > _SHORTEST:
        length /= 2
    return weights + length * step, rise < barrier
