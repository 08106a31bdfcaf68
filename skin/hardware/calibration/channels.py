"""Channels of a session: statistics of idle frames, the response to presses, and which sensor explains it."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import theilslopes

from skin.hardware.calibration.presses import BenchData

_BLOCKS = 200  # of the frames: Theil's line of a drift takes all pairs of their medians
_MAD = 1.4826  # standard deviation over the median absolute deviation, of normal noise
_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_STEPS = 8  # means over the loading of a press
_BEFORE = 20  # idle frames before a press, from which its rest is taken
_FEW = 5
_SURE, _VISIBLE, _STEP = 5.0, 1.0, 1.5  # standard errors, noise and steps above which a channel responds
_LIMITS = np.geomspace(0.9, 300.0, 40)  # largest prediction of a channel over its limit
_TINY = 1e-6  # of the largest prediction: less is 0
_INVERSE = 4.5  # factor on the residual of a channel whose polarity is not that of most
_STRONGER = 20.0  # times the predicted share of the strongest response: more has another cause


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


def find_quantum(values: np.ndarray) -> float:
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


def measure_idle(time: np.ndarray, values: np.ndarray, step: float) -> Idle:
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
    steady = values - drift * time
    offset = float(np.median(steady))
    spread = _MAD * float(np.median(np.abs(steady - offset)))
    if step > 0.8 * spread:
        # The steps are too coarse for a median.
        spread = float(np.std(steady[np.abs(steady - offset) <= 3 * max(spread, step)]))
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


def fit_decay(time: np.ndarray, values: np.ndarray, floor: float) -> tuple[float, float]:
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


def fit_clip_and_gain(
    true: np.ndarray, measured: np.ndarray, noise: float
) -> tuple[float, float, float | None]:
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


@dataclass(frozen=True)
class Responses:
    """Responses of all channels, mean over the steps of a press while its force rises.

    Attributes:
        measured: (F, S), change against the rest before the press, in the session's unit.
        force: (F,), of the gauge, N.
        press: (F,), number of the press.
        error: (S,), standard error of ``measured``.
        responding: (S,), bool: the channel leaves its noise in at least one press.
    """

    measured: np.ndarray
    force: np.ndarray
    press: np.ndarray
    error: np.ndarray
    responding: np.ndarray

    def predicted(self, per_newton: np.ndarray) -> np.ndarray:
        """Return true readings (F, S), N, of presses that give ``per_newton`` (P, S) per N."""
        return self.force[:, None] * per_newton[self.press]


@dataclass(frozen=True)
class Match:
    """How well every channel is explained by the prediction for every sensor.

    Attributes:
        residual: (channels, sensors), share of a channel's energy that the prediction does not explain with
            any gain and limit, without that of the noise: 0 to 1.
        sign: (channels, sensors), 1 or -1: whether the channel rises or falls with force.
        expected: (sensors,), largest prediction, share of the largest of all.
    """

    residual: np.ndarray
    sign: np.ndarray
    expected: np.ndarray


def collect_responses(bench: BenchData) -> Responses:
    """Return the responses of all channels of a session, which do not depend on places or layout."""
    raw, (force, press) = bench.session.raw, bench.applied
    idle = np.flatnonzero(bench.idle)
    rows, forces, numbers, counts, rests = [], [], [], [], []
    resting = _find_medians(raw[idle])
    for number in range(len(bench.gauge)):
        frames = np.flatnonzero((press == number) & bench.loading)
        if not len(frames):
            continue
        before = idle[idle < frames[0]][-_BEFORE:]
        level = _find_medians(raw[before]) if len(before) >= _FEW else resting
        level = np.where(np.isfinite(level), level, resting)
        rests.append(level)
        for step in np.array_split(frames, min(_STEPS, len(frames))):
            rows.append(_find_medians(raw[step]) - level)
            forces.append(force[step].mean())
            numbers.append(number)
            counts.append(len(step))
    measured = np.nan_to_num(np.array(rows))
    noise, step = _noise(bench, idle)
    error = noise * _MEDIAN * math.sqrt(1 / float(np.median(counts)) + 1 / _BEFORE)
    if len(rests) > 2:  # slow noise, which no mean reduces
        error = np.maximum(error, _MAD * np.nan_to_num(_find_medians(np.abs(np.diff(rests, axis=0)))))
    floor = np.maximum(np.maximum(_SURE * error, _VISIBLE * noise), _STEP * step)
    responding = np.abs(measured).max(axis=0) > floor
    return Responses(measured, np.array(forces), np.array(numbers), error, responding)


def match_channels(responses: Responses, per_newton: np.ndarray) -> Match:
    """Compare every channel with the prediction for every sensor.

    A channel reads gain times the prediction up to a limit. Both are free, and the gain may be negative. But
    a channel that responds strongly is not explained by a sensor that no press reaches.

    Args:
        responses: of the session.
        per_newton: (P, S), true readings per N of every press.
    """
    prediction = responses.predicted(per_newton)
    largest = np.abs(prediction).max(axis=0)
    reached = largest > _TINY * largest.max(initial=0.0)
    shape = prediction / np.where(reached, largest, 1.0)
    energy = (responses.measured**2).sum(axis=0)
    unit = responses.measured / np.sqrt(np.where(energy > 0, energy, 1.0))
    best = np.zeros((unit.shape[1], shape.shape[1]))
    for limit in _LIMITS:
        clipped = np.clip(limit * shape, -1.0, 1.0)
        size = np.sqrt((clipped**2).sum(axis=0))
        likeness = unit.T @ clipped / np.where(size > 0, size, 1.0)
        best = np.where(np.abs(likeness) > np.abs(best), likeness, best)
    noise = len(responses.measured) * responses.error**2 / np.where(energy > 0, energy, np.inf)
    residual = np.clip((1 - best**2 - noise[:, None]) / np.clip(1 - noise[:, None], 0.1, 1.0), 0.0, 1.0)
    strength = np.abs(responses.measured).max(axis=0)
    expected = largest / max(largest.max(initial=0.0), 1e-300)
    impossible = (strength / max(strength.max(initial=0.0), 1e-300))[:, None] > _STRONGER * expected
    residual = np.where(impossible | ~reached, 1.0, residual)
    sign = np.where(best < 0, -1.0, 1.0)
    # Beside a press the surface may rise: a channel that is inverse alone has to fit better.
    nearest = sign[np.arange(len(sign)), residual.argmin(axis=1)][responses.responding]
    most = -1.0 if nearest.sum() < 0 else 1.0
    residual = np.where(sign == most, residual, np.minimum(_INVERSE * residual, 1.0))
    return Match(residual, sign, expected)


def find_polarity(responses: Responses, per_newton: np.ndarray) -> np.ndarray:
    """Return 1 or -1 for every channel, (S,): -1 where it falls with force at its own sensor.

    A channel that does not respond has the polarity of most others.
    """
    signs = np.diagonal(match_channels(responses, per_newton).sign)
    most = -1.0 if signs[responses.responding].sum() < 0 else 1.0
    return np.where(responses.responding, signs, most)


def _find_medians(values: np.ndarray) -> np.ndarray:
    """Return the median of each column, (S,); NaN where a column has no number."""
    measured = np.isfinite(values).any(axis=0) if len(values) else np.zeros(values.shape[1], dtype=bool)
    middle = np.full(values.shape[1], np.nan)
    if measured.any():
        middle[measured] = np.nanmedian(values[:, measured], axis=0)
    return middle


def _noise(bench: BenchData, idle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise of a frame and the step of the converter, (S,) each; 0 where there is no number."""
    noise, step = np.zeros(bench.session.raw.shape[1]), np.zeros(bench.session.raw.shape[1])
    for channel, values in enumerate(bench.session.raw.T):
        quiet = idle[np.isfinite(values[idle])]
        if np.isfinite(values).any():
            step[channel] = find_quantum(values[np.isfinite(values)])
        if len(quiet) < 10 or np.ptp(values[quiet]) == 0:
            continue
        noise[channel] = measure_idle(bench.session.time[quiet], values[quiet], step[channel]).noise
    return noise, step
