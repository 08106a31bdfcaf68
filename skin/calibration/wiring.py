"""Find out which channel belongs to which sensor, from idle frames and the responses to presses.

A channel that responds at other presses than its sensor should is not dead. The session is compared with what
it would be if the positions of the presses were mirrored or turned, or the channels in another order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.stats import linregress, median_abs_deviation

from skin.calibration.bench import (
    TURNS,
    BenchData,
    BenchSession,
    BenchSettings,
    Turn,
    build_bench_data,
    per_newton,
)
from skin.device.calibration import Calibration
from skin.device.simulated import Simulated
from skin.errors import InputError

MAD = 1.4826  # standard deviation over the median absolute deviation, of normal noise
_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_INSIDE = 4.0  # standard deviations, or steps, from the median: values beyond are outliers
_STEPS = 8  # means over the loading of a press
QUIET = 10  # idle frames of a channel that show its noise
_SURE, _VISIBLE, _STEP = 5.0, 1.0, 1.5  # standard errors, noise and steps above which a channel responds
_LIMITS = np.geomspace(0.9, 30.0, 40)  # largest prediction over the limit; at 300 any shape fits a step
_TINY = 1e-6  # of the largest prediction: less is 0
_INVERSE = 4.5  # factor on the residual of a channel whose polarity is not that of most
_STRONGER = 20.0  # response over its prediction, relative to the strongest: above, the channel is a wrong one


def measure_rests(session: BenchSession, idle: np.ndarray) -> pd.DataFrame:
    """Return the statistics of :func:`measure_rest` of each channel as columns (S,), of idle frames, (T,).

    Of a channel with few idle frames, all frames are taken, and lost ones are 0.
    """
    rests = []
    for values in session.raw.T:
        valid = np.isfinite(values)
        quiet = valid & idle | ((valid & idle).sum() < QUIET)
        rests.append(
            measure_rest(session.time[quiet], np.nan_to_num(values[quiet]), find_quantum(values[valid]))
        )
    return pd.DataFrame(rests)


def find_quantum(values: np.ndarray) -> float:
    """Return the smallest step between values; 0 if they are continuous.

    Values are quantised if fewer than a fifth of them are distinct.
    """
    distinct = np.unique(values)
    # Single precision splits a step into two that differ in the last digit; it does not split counts.
    steps = np.diff(distinct)[
        np.diff(distinct) > (0.5 if (distinct % 1 == 0).all() else 1e-5 * np.abs(distinct).max(initial=0.0))
    ]
    return float(steps.min()) if len(steps) and len(distinct) <= 0.2 * len(values) else 0.0


def measure_rest(time: np.ndarray, values: np.ndarray, step: float) -> dict[str, float]:
    """Return the statistics of idle frames, in the session's unit.

    Args:
        time: s.
        values: steps of ``step`` apart (0: continuous).
        step: of the converter.

    Returns:
        ``offset``: mean, at time 0 where it drifts. ``drift``: per s; 0 if it is within two standard errors.
        ``noise``: standard deviation, without outliers and without the variance of the steps. ``quantum``:
        the step.
    """
    inside = np.abs(values - np.median(values)) <= _INSIDE * max(
        median_abs_deviation(values, scale="normal"), step
    )
    time, values = time[inside], values[inside]
    line = linregress(time, values)
    drift = float(line.slope) if abs(line.slope) > 2 * line.stderr else 0.0
    steady = values - drift * time
    return {
        "offset": float(steady.mean()),
        "drift": drift,
        # Rounding adds the variance of a step (Sheppard's correction).
        "noise": math.sqrt(max(steady.var() - step**2 / 12, 0.0)),
        "quantum": step,
    }


@dataclass(frozen=True)
class Responses:
    """Responses of all channels, medians over the steps of a press while its force rises.

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


def collect_responses(bench: BenchData) -> Responses:
    """Return the responses of all channels of a session, which do not depend on places or layout."""
    raw, (force, press) = pd.DataFrame(bench.session.raw), bench.applied
    # The rest of a press is that since the previous one; without any, that of the press before.
    rests = (
        raw[bench.idle]
        .groupby(bench.begun[bench.idle])
        .median()
        .reindex(range(len(bench.gauge)))
        .ffill()
        .bfill()
    )
    loading = raw.assign(force=force, press=press)[bench.loading]
    step = (
        loading.groupby("press").cumcount()
        * _STEPS
        // loading.groupby("press")["press"].transform("size").clip(lower=_STEPS)
    )
    # Of the force as of the readings: a part may hold two levels.
    steps = loading.groupby(["press", step]).median()
    numbers, count = steps.index.get_level_values(0).to_numpy(), len(loading) / len(steps)
    measured = np.nan_to_num(steps[raw.columns].to_numpy() - rests.loc[numbers].to_numpy())
    noise, quantum = measure_rests(bench.session, bench.idle)[["noise", "quantum"]].to_numpy().T
    # Slow noise, which no mean reduces, shows between rests.
    error = np.fmax(noise * _MEDIAN / math.sqrt(count), MAD * rests.diff().abs().median().to_numpy())
    floor = np.max([_SURE * error, _VISIBLE * noise, _STEP * quantum], axis=0)
    return Responses(
        measured, steps["force"].to_numpy(), numbers, error, np.abs(measured).max(axis=0) > floor
    )


def match_channels(responses: Responses, per_newton: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare every channel with the prediction for every sensor.

    A channel reads gain times the prediction up to a limit. Both are free, and the gain may be negative. But
    a channel that responds strongly is not explained by a sensor that no press reaches.

    Args:
        responses: of the session.
        per_newton: (P, S), true readings per N of every press.

    Returns:
        The residual, (channels, sensors): fraction of a channel's energy, without that of the noise, that the
        prediction does not explain with any gain and limit, 0 to 1. The sign, (channels, sensors), 1 or -1:
        whether the channel rises or falls with force. The largest prediction for each sensor, (sensors,), as
        a fraction of the largest of all.
    """
    prediction = responses.force[:, None] * per_newton[responses.press]  # N, (F, S)
    largest = np.abs(prediction).max(axis=0)
    shape = prediction / np.maximum(largest, _TINY * max(largest.max(), 1e-300))
    size = np.linalg.norm(responses.measured, axis=0)
    unit = responses.measured / np.where(size > 0, size, 1.0)
    best = np.zeros((len(size), len(largest)))
    for limit in _LIMITS:
        clipped = np.clip(limit * shape, -1.0, 1.0)
        similarity = unit.T @ clipped / np.maximum(np.linalg.norm(clipped, axis=0), 1e-300)
        best = np.where(np.abs(similarity) > np.abs(best), similarity, best)
    noise = (len(unit) * responses.error**2 / np.where(size > 0, size, np.inf) ** 2)[:, None]
    residual = np.clip((1 - best**2 - noise) / np.clip(1 - noise, 0.1, 1.0), 0.0, 1.0)
    strength, expected = np.abs(responses.measured).max(axis=0), largest / max(largest.max(), 1e-300)
    residual[strength[:, None] > _STRONGER * strength.max() * expected] = 1.0
    sign = np.where(best < 0, -1.0, 1.0)
    # Beside a press the surface may rise: a channel that is inverse alone has to fit better.
    usual = _sign_of_most(sign[np.arange(len(sign)), residual.argmin(axis=1)], responses)
    return np.where(sign == usual, residual, np.minimum(_INVERSE * residual, 1.0)), sign, expected


def _sign_of_most(signs: np.ndarray, responses: Responses) -> float:
    return -1.0 if signs[responses.responding].sum() < 0 else 1.0


def find_polarity(responses: Responses, per_newton: np.ndarray) -> np.ndarray:
    """Return 1 or -1 for every channel, (S,): -1 where it falls with force at its own sensor.

    A channel that does not respond has the polarity of most others.
    """
    signs = np.diagonal(match_channels(responses, per_newton)[1])
    return np.where(responses.responding, signs, _sign_of_most(signs, responses))


# Residuals. Sensors misplaced by 5 mm leave 0.25, another sensor 0.6 and more. A channel that is called
# exchanged has to fit its new place at least well. The last is that of a channel that fits no better.
_FITS, _WELL, _NO_FIT = 0.45, 0.15, 0.5
_CLEARLY, _BETTER = 0.3, 0.2  # less residual of all channels, and of one, that another explanation leaves
_MOST = 0.25  # fraction of the responding channels that an explanation may leave, and of unusable sensors
_PRESSED = 0.2  # of the largest prediction: a sensor with less was not pressed, so it identifies no channel
_FEWEST = 3  # channels that a turn must explain, because two exchanged channels look like a mirrored axis


class _Explanation(NamedTuple):
    """A turn of the positions and the sensor of every channel, with what they leave unexplained.

    Attributes:
        turn: of the positions.
        sensors: (S,), sensor of every channel.
        residual: (S,), of every channel at its sensor, up to 0.5, of no fit; 0 where it does not respond.
        sure: whether every channel away from its own sensor fits well, and nowhere else about as well.
    """

    turn: Turn
    sensors: np.ndarray
    residual: np.ndarray
    sure: bool = True

    @property
    def moved(self) -> np.ndarray:
        """Channels that are not at their own sensor."""
        return np.flatnonzero(self.sensors != np.arange(len(self.sensors)))

    @property
    def unexplained(self) -> np.ndarray:
        """Channels that respond, but not to the presses near their sensor."""
        return np.flatnonzero(self.residual > _FITS)

    def words(self, settings: BenchSettings, order: np.ndarray) -> str:
        """Return the explanation in words, with the settings that confirm it."""
        words, additions = list[str](), list[str]()
        if self.turn != settings.places:
            words.append(f"the places of the presses are {TURNS[self.turn][1]}")
            additions.append(f"calibrate.places={self.turn}")
        if len(self.moved):
            words.append(f"channels {list_numbers(np.sort(order[self.moved]))} are in another order")
            additions.append(f"'calibrate.channels=[{','.join(map(str, order[np.argsort(self.sensors)]))}]'")
        return f"the session fits if {' and '.join(words)}; to confirm that, add {' '.join(additions)}."


def ordered(session: BenchSession, settings: BenchSettings) -> BenchSession:
    """Return a session with its columns in the order of the layout, broken ones without values.

    Raises:
        InputError: channels or sensors that it does not have.
    """
    last, channels = session.raw.shape[1] - 1, list(settings.channels or range(session.raw.shape[1]))
    if sorted(channels) != list(range(last + 1)):
        raise InputError(f"calibrate.channels must hold each of 0 to {last} once, got {channels}")
    if max(settings.broken, default=0) > last:
        raise InputError(f"calibrate.broken takes sensors from 0 to {last}, got {max(settings.broken)}")
    raw, own = session.raw[:, channels].astype(float), session.channels
    raw[:, list(settings.broken)] = np.nan
    return replace(
        session,
        raw=raw,
        channels=channels if own is None else [own[n] for n in channels],
        saturated=None if session.saturated is None else session.saturated[:, channels],
    )


def wired_bench(device: Simulated, session: BenchSession, settings: BenchSettings) -> BenchData:
    """Return the bench data of a session whose channels and places fit the layout.

    Every channel is compared with the prediction for every sensor, for eight turns of the places. The
    explanation that leaves the least is named, with one that leaves about as little.

    Args:
        device: with the skin as designed.
        session: as recorded.
        settings: what the user confirms about channels and places.

    Raises:
        InputError: channels respond, but not to the presses near their sensors. The message names the
            explanation, where the session has a clear one, and the setting that confirms it.
    """
    gauge, order = session.gauge, np.array(settings.channels or range(session.raw.shape[1]))
    if gauge is None or session.raw.shape[1] != len(device.sensors):
        return build_bench_data(device, session)
    session, turns = ordered(session, settings), sorted(TURNS, key=lambda turn: turn != settings.places)
    turned = {turn: gauge.turned(turn, device.size) for turn in turns}
    allowed = [turn for turn in turns if not len(turned[turn].outside(device.size))]
    # Where no turn brings all positions onto the sheet, they are refused here.
    bench = build_bench_data(device, replace(session, gauge=turned[(allowed or turns)[0]]))
    responses, found = collect_responses(bench), list[_Explanation]()
    for turn in allowed:
        found += _explain(
            turn,
            responses,
            bench.each if turn == allowed[0] else per_newton(device.model, device.body, turned[turn]),
        )
    straight = found[0] if allowed[0] == settings.places else None
    limit = min(entry.residual.sum() for entry in found) + _CLEARLY
    # One change before two, and few channels before many.
    clear = [
        entry
        for entry in sorted(
            found, key=lambda one: (one.turn != settings.places and len(one.moved) > 0, len(one.moved))
        )
        if entry.residual.sum() <= limit and entry.sure and entry is not straight
        if len(entry.unexplained) <= _MOST * responses.responding.sum()
        # A turn must improve more than an exchange of two channels does.
        if straight is None
        or entry.turn == straight.turn
        or (straight.residual > entry.residual + _BETTER).sum() >= _FEWEST
    ]
    if straight and not len(straight.unexplained) and (straight.residual.sum() <= limit or not clear):
        return bench
    raise InputError(_describe_mismatch(straight, clear, responses, settings, order))


def _describe_mismatch(
    straight: _Explanation | None,
    clear: Sequence[_Explanation],
    responses: Responses,
    settings: BenchSettings,
    order: np.ndarray,
) -> str:
    """Return the sentence that refuses a session, with the settings that confirm its explanations."""
    wrong, trouble = np.flatnonzero(responses.responding), "the places of some presses are outside the sheet"
    if straight is not None:
        least = np.minimum(clear[0].residual + _BETTER, _FITS) if clear else _FITS
        wrong = np.flatnonzero(straight.residual > least)
        trouble = (
            "channels respond, but not to the presses near their sensors "
            f"({list_numbers(np.sort(order[wrong]))})"
        )
    if clear:
        return f"{trouble}: {' Or '.join(entry.words(settings, order) for entry in clear[:2])}"
    return (
        f"{trouble}: neither another order of the channels nor other axes explain that; check the wiring, "
        "the places of sensors and presses, and the clock (calibrate.delay), or leave sensors out by "
        f"'calibrate.broken=[{','.join(map(str, wrong))}]'"
    )


def _explain(turn: Turn, responses: Responses, per_newton: np.ndarray) -> list[_Explanation]:
    """Return the explanation that leaves channels at their sensors, and the one that permutes them best."""
    (residual, _, expected), responding = match_channels(responses, per_newton), responses.responding
    channels = np.arange(len(responding))
    # A channel that fits nowhere, or is silent, stays at its own sensor where that is free.
    cost = np.where(responding[:, None] & (residual <= _FITS), residual, _NO_FIT)
    _, sensors = linear_sum_assignment(cost - 1e-6 * np.eye(len(cost)))
    straight, permuted = (
        np.where(responding, cost[channels, position], 0.0) for position in (channels, sensors)
    )
    moved, settled = sensors != channels, cost[channels, sensors] < _NO_FIT
    cost[channels, sensors] = _NO_FIT
    sure = (cost.min(axis=1) > permuted + _BETTER) & (permuted <= _WELL) & (expected[sensors] >= _PRESSED)
    # Of two silent channels, nothing says which is where.
    known = bool(sure[moved & settled].all()) and (moved & ~settled).sum() <= 1
    found = [_Explanation(turn, channels, straight), _Explanation(turn, sensors, permuted, known)]
    return found[: 1 + moved.any()]


def check_usable(calibration: Calibration) -> None:
    """Raise InputError if a calibration leaves more than a quarter of its sensors unusable."""
    if (count := int(calibration.values()["dead"].sum())) > _MOST * len(calibration):
        raise InputError(
            f"{count} of {len(calibration)} sensors would be unusable ("
            + "; ".join(
                f"{kind}: {list_numbers(group)}" for kind, group in calibration.broken.items() if group
            )
            + "), and at most a quarter may be: press near every sensor, check the supply and the cables of "
            "these channels, and record again"
        )


def list_numbers(numbers: Sequence[int] | np.ndarray) -> str:
    """Return numbers in words, as ``2``, ``2 and 5`` or ``2, 5 and 7``."""
    words = [str(number) for number in numbers]
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
