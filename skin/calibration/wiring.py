"""Find out which channel belongs to which sensor, from idle frames and the responses to presses.

A channel that responds at other presses than its sensor should is not dead. The session is compared with what
it would be if the positions of the presses were mirrored or turned, or the channels in another order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from scipy.stats import theilslopes

from skin.calibration.bench import BenchData, BenchSession, Gauge, build_bench_data, per_newton
from skin.core.settings import checked
from skin.device.calibration import Calibration
from skin.device.simulated import Simulated
from skin.errors import InputError

_BLOCKS = 200  # of the frames: Theil's line of a drift takes all pairs of their medians
MAD = 1.4826  # standard deviation over the median absolute deviation, of normal noise
_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_STEPS = 8  # means over the loading of a press
_BEFORE = 20  # idle frames before a press, from which its rest is taken
QUIET = 10  # idle frames of a channel that show its noise
_SURE, _VISIBLE, _STEP = 5.0, 1.0, 1.5  # standard errors, noise and steps above which a channel responds
_LIMITS = np.geomspace(0.9, 30.0, 40)  # largest prediction over the limit; at 300 any shape fits a step
_TINY = 1e-6  # of the largest prediction: less is 0
_INVERSE = 4.5  # factor on the residual of a channel whose polarity is not that of most
_STRONGER = 20.0  # response over its prediction, relative to the strongest: above, the channel is a wrong one


class Rest(NamedTuple):
    """Statistics of an untouched channel, in the session's unit.

    Attributes:
        offset: median, at time 0 where it drifts.
        drift: per s; 0 if its 95 % confidence interval contains 0.
        noise: 1.4826 times the median absolute deviation; with steps of similar size, the standard
            deviation without outliers.
        quantum: step of the converter; 0: continuous.
    """

    offset: float
    drift: float
    noise: float
    quantum: float


def measure_rests(session: BenchSession, idle: np.ndarray) -> pd.DataFrame:
    """Return the :class:`Rest` of each channel, (S, 4), of idle frames, (T,); still ones have no noise."""
    rests = []
    for values in session.raw.T:
        present = np.isfinite(values)
        quiet, quantum = values[present & idle], find_quantum(values[present])
        if len(quiet) < QUIET or np.ptp(quiet) == 0:
            spare = quiet if len(quiet) else values[present]
            rests.append(Rest(float(np.median(spare)) if len(spare) else 0.0, 0.0, 0.0, quantum))
        else:
            rests.append(measure_rest(session.time[present & idle], quiet, quantum))
    return pd.DataFrame(rests)


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


def measure_rest(time: np.ndarray, values: np.ndarray, step: float) -> Rest:
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
    spread = MAD * float(np.median(np.abs(steady - offset)))
    if step > 0.8 * spread:
        # The steps are too coarse for a median.
        spread = float(np.std(steady[np.abs(steady - offset) <= 3 * max(spread, step)]))
    # Rounding and spreading each add the variance of a step (Sheppard's correction).
    return Rest(offset, drift, math.sqrt(max(spread**2 - step**2 / 6, 0.0)), step)


def _spread(values: np.ndarray, step: float) -> np.ndarray:
    """Spread equal values evenly over their rounding step, so that medians resolve less than a step."""
    if step == 0:
        return values
    rank = pd.Series(values).groupby(values).cumcount().to_numpy()
    # Ranks follow time; a fixed shuffle keeps them from distorting a drift.
    position = (rank * 0.6180339887498949) % 1
    return values + step * (position - 0.5)


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
    raw, (force, press) = bench.session.raw, bench.applied
    idle = np.flatnonzero(bench.idle)
    steps, rests = [], []
    resting = find_medians(raw[idle])
    for number in range(len(bench.gauge)):
        frames = np.flatnonzero((press == number) & bench.loading)
        if not len(frames):
            continue
        before = idle[idle < frames[0]][-_BEFORE:]
        level = find_medians(raw[before]) if len(before) >= _BEFORE / 4 else resting
        level = np.where(np.isfinite(level), level, resting)
        rests.append(level)
        for step in np.array_split(frames, min(_STEPS, len(frames))):
            # Of the force as of the readings: a part may hold two levels.
            steps.append((find_medians(raw[step]) - level, np.median(force[step]), number, len(step)))
    rows, forces, numbers, counts = map(np.array, zip(*steps, strict=True))
    measured = np.nan_to_num(rows)
    noise, step = measure_rests(bench.session, bench.idle)[["noise", "quantum"]].to_numpy().T
    error = noise * _MEDIAN * math.sqrt(1 / float(np.median(counts)) + 1 / _BEFORE)
    if len(rests) > 2:  # slow noise, which no mean reduces
        error = np.maximum(error, MAD * np.nan_to_num(find_medians(np.abs(np.diff(rests, axis=0)))))
    floor = np.maximum(np.maximum(_SURE * error, _VISIBLE * noise), _STEP * step)
    responding = np.abs(measured).max(axis=0) > floor
    return Responses(measured, forces, numbers, error, responding)


def match_channels(responses: Responses, per_newton: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare every channel with the prediction for every sensor.

    A channel reads gain times the prediction up to a limit. Both are free, and the gain may be negative. But
    a channel that responds strongly is not explained by a sensor that no press reaches.

    Args:
        responses: of the session.
        per_newton: (P, S), true readings per N of every press.

    Returns:
        residual: (channels, sensors), fraction of a channel's energy that the prediction does not explain
            with any gain and limit, without that of the noise: 0 to 1.
        sign: (channels, sensors), 1 or -1: whether the channel rises or falls with force.
        expected: (sensors,), largest prediction, as a fraction of the largest of all.
    """
    prediction = responses.force[:, None] * per_newton[responses.press]  # N, (F, S)
    largest = np.abs(prediction).max(axis=0)
    reached = largest > _TINY * largest.max(initial=0.0)
    shape = prediction / np.where(reached, largest, 1.0)
    energy = (responses.measured**2).sum(axis=0)
    unit = responses.measured / np.sqrt(np.where(energy > 0, energy, 1.0))
    best = np.zeros((unit.shape[1], shape.shape[1]))
    for limit in _LIMITS:
        clipped = np.clip(limit * shape, -1.0, 1.0)
        size = np.sqrt((clipped**2).sum(axis=0))
        similarity = unit.T @ clipped / np.where(size > 0, size, 1.0)
        best = np.where(np.abs(similarity) > np.abs(best), similarity, best)
    noise = len(responses.measured) * responses.error**2 / np.where(energy > 0, energy, np.inf)
    residual = np.clip((1 - best**2 - noise[:, None]) / np.clip(1 - noise[:, None], 0.1, 1.0), 0.0, 1.0)
    strength = np.abs(responses.measured).max(axis=0)
    expected = largest / max(largest.max(initial=0.0), 1e-300)
    impossible = (strength / max(strength.max(initial=0.0), 1e-300))[:, None] > _STRONGER * expected
    residual = np.where(impossible | ~reached, 1.0, residual)
    sign = np.where(best < 0, -1.0, 1.0)
    # Beside a press the surface may rise: a channel that is inverse alone has to fit better.
    nearest = sign[np.arange(len(sign)), residual.argmin(axis=1)][responses.responding]
    maximum = -1.0 if nearest.sum() < 0 else 1.0
    residual = np.where(sign == maximum, residual, np.minimum(_INVERSE * residual, 1.0))
    return residual, sign, expected


def find_polarity(responses: Responses, per_newton: np.ndarray) -> np.ndarray:
    """Return 1 or -1 for every channel, (S,): -1 where it falls with force at its own sensor.

    A channel that does not respond has the polarity of most others.
    """
    signs = np.diagonal(match_channels(responses, per_newton)[1])
    maximum = -1.0 if signs[responses.responding].sum() < 0 else 1.0
    return np.where(responses.responding, signs, maximum)


def find_medians(values: np.ndarray) -> np.ndarray:
    """Return the median of each column, (S,); NaN where a column has no number."""
    return pd.DataFrame(values).median().to_numpy()


Turn = Literal[
    "as_given",
    "mirror_x",
    "mirror_y",
    "rotate_180",
    "transpose",
    "rotate_90",
    "rotate_270",
    "transpose_other",
]
TURNS: dict[Turn, tuple[np.ndarray, str]] = {
    "as_given": (np.array([[1, 0], [0, 1]]), "as given"),
    "mirror_x": (np.array([[-1, 0], [0, 1]]), "mirrored in x (the x axis counts to the left)"),
    "mirror_y": (np.array([[1, 0], [0, -1]]), "mirrored in y (the y axis counts upwards)"),
    "rotate_180": (np.array([[-1, 0], [0, -1]]), "turned by 180 degrees (both axes count backwards)"),
    "transpose": (np.array([[0, 1], [1, 0]]), "transposed (x and y are exchanged)"),
    "rotate_90": (np.array([[0, -1], [1, 0]]), "turned by 90 degrees"),
    "rotate_270": (np.array([[0, 1], [-1, 0]]), "turned by 270 degrees"),
    "transpose_other": (
        np.array([[0, -1], [-1, 0]]),
        "mirrored at the other diagonal (x and y are exchanged, and both count backwards)",
    ),
}
"""What ``calibrate.places`` takes, the simplest first: from the direction in the gauge's frame to that on the
sheet, x right and y down; and its words."""
_FITS = 0.45  # residual: sensors misplaced by 5 mm leave 0.25, another sensor 0.6 and more
_WELL = 0.15  # residual: a channel that is called exchanged has to fit its new place at least as well
_NO_FIT = 0.5  # residual of a channel that fits no better
_CLEARLY, _BETTER = 0.3, 0.2  # less residual of all channels, and of one, that another explanation leaves
_MOST = 0.25  # fraction of the responding channels that an explanation may leave, and of unusable sensors
_PRESSED = 0.2  # of the largest prediction: a sensor with less was not pressed, so it identifies no channel
_LISTED = 12  # channels in a message
_FEWEST = 3  # channels that a turn must explain, because two exchanged channels look like a mirrored axis


def turn_gauge(gauge: Gauge, turn: Turn, size: Sequence[float]) -> Gauge:
    """Return a gauge with its places and angles in the frame of the sheet.

    Args:
        gauge: with places in a frame of other axes.
        turn: from this frame to that of the sheet.
        size: of the sheet, x and y, m.
    """
    matrix, middle = TURNS[turn][0], np.array(size) / 2
    centred = gauge.position - np.abs(matrix).T @ middle
    direction = matrix @ np.stack([np.cos(gauge.angle), np.sin(gauge.angle)])
    angle = gauge.angle if turn == "as_given" else np.arctan2(direction[1], direction[0])
    return replace(gauge, position=centred @ matrix.T + middle, angle=angle)


def compose_turns(first: Turn, then: Turn) -> Turn:
    """Return the turn that is the same as one turn after another."""
    product = TURNS[then][0] @ TURNS[first][0]
    return next(turn for turn, (matrix, _) in TURNS.items() if (matrix == product).all())


@checked("calibrate")
@dataclass(frozen=True)
class Confirmed:
    """What the user confirms about a session.

    Attributes:
        places: how the positions of the presses are turned to be those of the sheet.
        channels: column of the session, from 0, of every sensor; None: the same order.
        broken: sensors, from 0, that count as dead.

    Raises:
        InputError: an unknown turn, or no lists of numbers.
    """

    places: Turn = "as_given"
    channels: Sequence[int] | None = None
    broken: Sequence[int] = ()

    def order(self, sensors: int) -> list[int]:
        """Return the column of the session of every sensor."""
        return list(range(sensors) if self.channels is None else self.channels)

    def ordered(self, session: BenchSession) -> BenchSession:
        """Return a session with its columns in the order of the layout, broken ones without values.

        Raises:
            InputError: channels or sensors that it does not have.
        """
        sensors = session.raw.shape[1]
        channels = self.order(sensors)
        if sorted(channels) != list(range(sensors)):
            raise InputError(f"calibrate.channels must hold each of 0 to {sensors - 1} once, got {channels}")
        if wrong := [number for number in self.broken if not 0 <= number < sensors]:
            raise InputError(f"calibrate.broken takes sensors from 0 to {sensors - 1}, got {wrong[0]}")
        ordered = session.raw[:, channels].astype(float)
        ordered[:, list(self.broken)] = np.nan
        return replace(session, raw=ordered)


@dataclass(frozen=True)
class _Explanation:
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

    @property
    def parts(self) -> int:
        """How much the explanation supposes."""
        return (self.turn != "as_given") + len(self.moved)

    def words(self, confirmed: Confirmed) -> str:
        """Return the explanation in words, with the settings that confirm it."""
        order, words, settings = np.array(confirmed.order(len(self.sensors))), list[str](), list[str]()
        if self.turn != "as_given":
            words.append(f"the places of the presses are {TURNS[self.turn][1]}")
            settings.append(f"calibrate.places={compose_turns(confirmed.places, self.turn)}")
        if len(self.moved):
            verb = "exchanged" if len(self.moved) == 2 else "in another order"
            words.append(f"channels {list_numbers(np.sort(order[self.moved]))} are {verb}")
            settings.append(f"'calibrate.channels=[{','.join(map(str, order[np.argsort(self.sensors)]))}]'")
        return f"{' and '.join(words)}; to confirm that, add {' '.join(settings)}"


def wired_bench(
    device: Simulated, session: BenchSession, rows: Gauge | None, confirmed: Confirmed
) -> BenchData:
    """Return the bench data of a session whose channels and places fit the layout.

    Every channel is compared with the prediction for every sensor, for eight turns of the places. The
    explanation that leaves the least is named, with those that leave about as little.

    Args:
        device: with the skin as designed.
        session: as recorded.
        rows: of the gauge; None: those in the session.
        confirmed: what the user says about channels and places.

    Raises:
        InputError: channels respond, but not to the presses near their sensors. The message names the
            explanation, where the session has a clear one, and the setting that confirms it.
    """
    rows = session.gauge if rows is None else rows
    if session.raw.shape[1] == len(device.sensors):
        session = confirmed.ordered(session)
    if rows is None:
        return build_bench_data(device, session, rows)
    gauge = turn_gauge(rows, confirmed.places, device.size)
    turned = {turn: turn_gauge(gauge, turn, device.size) for turn in TURNS}
    allowed = {turn: places for turn, places in turned.items() if places.lies_on(device.size)}
    # Where no turn brings all positions onto the sheet, they are refused here.
    bench = build_bench_data(device, session, next(iter(allowed.values()), gauge))
    responses, found = collect_responses(bench), list[_Explanation]()
    for turn, places in allowed.items():
        each = bench.each if places is bench.gauge else per_newton(device.model, device.body, places)
        found += _explain(turn, responses, each)
    straight = found[0] if "as_given" in allowed else None
    limit = min(entry.residual.sum() for entry in found) + _CLEARLY
    best = sorted((entry for entry in found if entry.residual.sum() <= limit), key=lambda entry: entry.parts)
    most = _MOST * responses.responding.sum()
    clear = [entry for entry in best if entry.parts and entry.sure and len(entry.unexplained) <= most]
    if straight is not None:  # a turn must improve more channels than an exchange of two does
        clear = [
            entry
            for entry in clear
            if {*entry.unexplained} <= {*straight.unexplained}
            and (entry.turn == "as_given" or (straight.residual > entry.residual + _BETTER).sum() >= _FEWEST)
        ]
        if not len(straight.unexplained) and (straight.residual.sum() <= limit or not clear):
            return bench
    raise InputError(_refusal(straight, best[0], clear, confirmed, responses.responding))


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
    sure = (cost.min(axis=1) > permuted + _BETTER) & (permuted <= _WELL)
    sure &= expected[sensors] >= _PRESSED
    # Of two silent channels, nothing says which is where.
    known = bool(sure[moved & settled].all()) and (moved & ~settled).sum() <= 1
    found = [_Explanation(turn, channels, straight), _Explanation(turn, sensors, permuted, known)]
    return found if moved.any() else found[:1]


def _refusal(
    straight: _Explanation | None,
    best: _Explanation,
    clear: Sequence[_Explanation],
    confirmed: Confirmed,
    responding: np.ndarray,
) -> str:
    """Return the sentence that refuses a session, with the settings that confirm its explanations."""
    order, wrong = np.array(confirmed.order(len(responding))), np.flatnonzero(responding)
    trouble = "the places of some presses are outside the sheet"
    if straight is not None:
        wrong = np.flatnonzero(straight.residual > np.minimum(best.residual + _BETTER, _FITS))
        listed = list_numbers(np.sort(order[wrong]))
        trouble = f"channel {listed} responds, but not to the presses near its sensor"
        if len(wrong) > 1:
            trouble = f"channels {listed} respond, but not to the presses near their sensors"
    if clear:
        # A turn that is made up for by another order says nothing new.
        others = [entry for entry in clear[1:] if entry.turn == "as_given" or not len(entry.moved)]
        sentences = [f"{trouble}: the session fits if {clear[0].words(confirmed)}"]
        sentences += [f"It fits as well if {entry.words(confirmed)}" for entry in others[:2]]
        if len(left := clear[0].unexplained):
            sentences.append(f"Channel {list_numbers(np.sort(order[left]))} fits nowhere: check the wiring")
        return ". ".join(sentences)
    if 2 * len(wrong) > responding.sum():
        return (
            f"{trouble}: neither another order of the channels nor other axes explain the session; check the "
            "wiring, the layout, the places of the presses and the clock (calibrate.delay)"
        )
    return (
        f"{trouble}: check the wiring, and the position of the sensor in the layout; "
        f"to leave it out, add 'calibrate.broken=[{','.join(map(str, wrong))}]'"
    )


def device_channels(session: BenchSession, confirmed: Confirmed) -> list[int]:
    """Return the device's channel of every sensor; empty if channels have the order of the layout."""
    order = confirmed.order(session.raw.shape[1])
    channels = [channel if session.channels is None else session.channels[channel] for channel in order]
    return [] if channels == sorted(channels) else channels


def check_usable(calibration: Calibration) -> None:
    """Raise InputError if a calibration leaves more than a quarter of its sensors unusable."""
    kinds = {kind: numbers for kind, numbers in calibration.broken.items() if numbers}
    count = len({number for numbers in kinds.values() for number in numbers})
    if count <= _MOST * len(calibration):
        return
    words = "; ".join(f"{kind}: {list_numbers(numbers)}" for kind, numbers in kinds.items())
    raise InputError(
        f"{count} of {len(calibration)} sensors would be unusable ({words}), and at most a quarter may be: "
        "press near every sensor, check the supply and the cables of these channels, and record again"
    )


def list_numbers(numbers: Sequence[int] | np.ndarray) -> str:
    """Return numbers in words, as ``2``, ``2 and 5`` or ``2, 5 and 7``; of many, the first ones."""
    words = [str(number) for number in numbers]
    if len(words) > _LISTED:
        words = [*words[: _LISTED - 1], f"{len(words) - _LISTED + 1} others"]
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
