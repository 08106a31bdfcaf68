"""One channel of a session: robust statistics of its idle frames and of its response to presses."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import theilslopes

_BLOCKS = 200
_MAD = 1.4826
_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean


@dataclass(frozen=True)
class Idle:
    """Statistics of an untouched channel, in the session's unit.

    Attributes:
        offset: median, at time 0 where it drifts.
        drift: per s; 0 if its 95 % confidence interval contains 0.
        noise: 1.4826 times the median absolute deviation; with steps of similar size, the standard
            deviation without outliers.
    """

    offset: float
    drift: float
    noise: float


def quantum(values: np.ndarray) -> float:
    """Return the smallest step between values; 0 if they are continuous.

    Values are quantised if fewer than a fifth of them are distinct.
    """
    distinct = np.unique(values)
    if len(distinct) < 2 or len(distinct) > 0.2 * len(values):
        return 0.0
    steps = np.diff(distinct)
    # Single precision splits a step into two that differ in the last digit.
    steps = steps[steps > 1e-5 * np.abs(distinct).max()]
    return float(steps.min(initial=np.inf)) if len(steps) else 0.0


def idle(time: np.ndarray, values: np.ndarray, step: float) -> Idle:
    """Return the statistics of idle frames.

    Args:
        time: s.
        values: in the session's unit, steps of ``step`` apart (0: continuous).
        step: of the converter.
    """
    values = _spread(values, step)
    blocks = np.array_split(np.arange(len(values)), min(_BLOCKS, max(2, len(values) // 10)))
    middles = np.array([[time[block].mean(), np.median(values[block])] for block in blocks])
    slope, _, low, high = theilslopes(middles[:, 1], middles[:, 0])
    drift = 0.0 if low <= 0 <= high else float(slope)
    rest = values - drift * time
    offset = float(np.median(rest))
    spread = _MAD * float(np.median(np.abs(rest - offset)))
    if step > 0.8 * spread:
        # The steps are too coarse for a median.
        spread = float(np.std(rest[np.abs(rest - offset) <= 3 * max(spread, step)]))
    # Rounding and spreading each add the variance of a step (Sheppard's correction).
    return Idle(offset, drift, math.sqrt(max(spread**2 - step**2 / 6, 0.0)))


def _spread(values: np.ndarray, step: float) -> np.ndarray:
    """Spread equal values evenly over their rounding step, so that medians resolve less than a step."""
    if step == 0:
        return values
    _, group, count = np.unique(values, return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(values))
    rank[order] = np.arange(len(values)) - np.repeat(np.cumsum(count) - count, count)
    # Ranks follow time; a fixed shuffle keeps them from distorting a drift.
    place = (rank * 0.6180339887498949) % 1
    return values + step * (place - 0.5)


def decay(time: np.ndarray, values: np.ndarray, floor: float) -> tuple[float, float]:
    """Return the time constant of a decay to 0, s, and its weight; (0, 0) with fewer than 3 frames.

    Args:
        time: s.
        values: after the release, without offset.
        floor: level of the noise.
    """
    below = np.flatnonzero(values <= floor)
    count = below[0] if len(below) else len(values)
    if count < 3:
        return 0.0, 0.0
    weights = values[:count]  # of the logarithm, whose error is noise / value
    slope = np.polyfit(time[:count], np.log(values[:count]), 1, w=weights)[0]
    if slope >= 0:
        return 0.0, 0.0
    return float(-1 / slope), float((weights**2).sum())


def clip_and_gain(true: np.ndarray, measured: np.ndarray, noise: float) -> tuple[float, float, float | None]:
    """Return the slope of measured over true readings, its standard error, and the plateau or None.

    The slope is NaN if fewer than three readings are below the plateau.

    Args:
        true: (n,), above 0, loading frames.
        measured: (n,), without offset.
        noise: of a frame.
    """
    top = true >= 0.9 * true.max()
    level = float(np.median(measured[top]))
    if level <= 5 * noise:  # it does not respond, which is no plateau
        return *_slope(true, measured), None
    low = measured < min(0.9 * level, level - 5 * noise)
    slope, error = _slope(true[low], measured[low])
    margin = max(2 * noise, 0.02 * level)
    if math.isnan(slope):
        return slope, error, level
    if slope * np.median(true[top]) <= level + margin:
        return *_slope(true, measured), None
    level = float(np.median(measured[slope * true > level + margin]))
    below = slope * true < level - margin
    return *_slope(true[below], measured[below]), level


def _slope(true: np.ndarray, measured: np.ndarray) -> tuple[float, float]:
    """Return the slope of the line through 0 with the least absolute error, and its standard error.

    It is the median of the ratios, weighted with ``true`` > 0. A line with an intercept would be fitted to
    the differences between presses with one force, which are due to their places. NaN and infinity with
    fewer than 3 readings.
    """
    if len(true) < 3:
        return math.nan, math.inf
    ratios = measured / true
    order = np.argsort(ratios)
    weight = np.cumsum(true[order])
    slope = float(ratios[order][np.searchsorted(weight, weight[-1] / 2)])
    spread = _MAD * float(np.median(np.abs(measured - slope * true)))
    return slope, _MEDIAN * spread / math.sqrt(float((true**2).sum()))
