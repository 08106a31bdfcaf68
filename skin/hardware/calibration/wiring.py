"""Find out whether channels and places of a bench session are those of the layout, and name what is not.

A channel that responds at other presses than its sensor should is not dead. The session is compared with what
it would be if the places of the presses were mirrored or turned, or the channels in another order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.hardware.calibration.bench import BenchSession, Gauge, per_newton
from skin.hardware.calibration.channels import (
    Match,
    Responses,
    collect_responses,
    match_channels,
)
from skin.hardware.calibration.places import TURNS, WORDS, Turn, composed, inside, turn_gauge
from skin.hardware.calibration.presses import BenchData, build_bench_data
from skin.settings import checked
from skin.signal.calibration import Calibration

_PLAIN = 0.05  # residual: channels that are explained at least as well need no turn to be tried
_FITS = 0.45  # residual: sensors misplaced by 5 mm leave 0.25, another sensor 0.6 and more
_WELL = 0.15  # residual: a channel that is called exchanged has to fit its new place at least as well
_CLEARER = 2.0, 0.1  # another explanation leaves less than half of the residual, less 0.1 of a channel's
_MOST = 0.25  # share of the responding channels that an explanation may leave, and of unusable sensors
_PRESSED = 0.2  # of the largest prediction: a sensor with less was not pressed, so it identifies no channel
_LISTED = 12  # channels in a message
_FEWEST = 3  # channels that a turn must explain, because two exchanged channels look like a mirrored axis


@checked("calibrate")
@dataclass(frozen=True)
class Confirmed:
    """What the user confirms about a session.

    Attributes:
        places: how the places of the presses are turned to be those of the sheet.
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


@dataclass(frozen=True)
class _Explanation:
    """A turn of the places and the sensor of every channel, with what they leave unexplained.

    Attributes:
        turn: of the places.
        sensors: (S,), sensor of every channel.
        residual: (S,), of every channel at its sensor, 0 to 1; 0 where it does not respond.
        sure: whether no other sensor explains a channel that is not at its own sensor about as well.
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

    def clearly_worse(self, other: "_Explanation") -> bool:
        """Return whether another explanation leaves clearly less."""
        differs = (self.sensors != other.sensors) | (self.turn != other.turn)
        factor, least = _CLEARER
        more = len(self.unexplained) > len(other.unexplained)
        return more or self.residual[differs].sum() > factor * other.residual[differs].sum() + least


def wired_bench(
    device: AbstractSimulated, session: BenchSession, rows: Gauge | None, confirmed: Confirmed
) -> BenchData:
    """Return the bench data of a session whose channels and places fit the layout.

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
        session = replace(session, raw=_confirmed_raw(session.raw, confirmed))
    if rows is None:
        return build_bench_data(device, session, rows)
    gauge = turn_gauge(rows, confirmed.places, device.size)
    turned = {turn: turn_gauge(gauge, turn, device.size) for turn in TURNS}
    allowed = {turn: places for turn, places in turned.items() if inside(places, device.size)}
    # Where no turn brings all places onto the sheet, they are refused here.
    bench = build_bench_data(device, session, next(iter(allowed.values()), gauge))
    responses = collect_responses(bench)
    own, best = _compared(device, bench, responses, allowed)
    clear = [each for each in best if _concluded(each, own, responses.responding)]
    if own is not None and not len(own.unexplained) and (not clear or any(each is own for each in best)):
        return bench
    raise InputError(_refusal(own, best[0], clear, confirmed, responses.responding))


def _confirmed_raw(raw: np.ndarray, confirmed: Confirmed) -> np.ndarray:
    """Return raw values in the order of the sensors; broken ones are NaN."""
    sensors = raw.shape[1]
    channels = confirmed.order(sensors)
    if sorted(channels) != list(range(sensors)):
        raise InputError(f"calibrate.channels must hold each of 0 to {sensors - 1} once, got {channels}")
    if wrong := [number for number in confirmed.broken if not 0 <= number < sensors]:
        raise InputError(f"calibrate.broken takes sensors from 0 to {sensors - 1}, got {wrong[0]}")
    ordered = raw[:, channels].astype(float)
    ordered[:, list(confirmed.broken)] = np.nan
    return ordered


def _compared(
    device: AbstractSimulated, bench: BenchData, responses: Responses, allowed: Mapping[Turn, Gauge]
) -> tuple[_Explanation | None, list[_Explanation]]:
    """Return the explanation by the layout as it is, and those about as good as the best, simplest first.

    The first is None where the places as given are not on the sheet.
    """
    explanations = list[_Explanation]()
    for turn, gauge in allowed.items():
        each = bench.each if gauge is bench.gauge else per_newton(device.model, device.body, gauge)
        straight, permuted = _explanations(match_channels(responses, each), responses.responding, turn)
        plain = straight.residual.max(initial=0.0) < _PLAIN and not straight.clearly_worse(permuted)
        if turn == "as_given" and plain:
            return straight, [straight]
        explanations += [straight, permuted] if len(permuted.moved) else [straight]
    best = min(explanations, key=lambda each: (len(each.unexplained), each.residual.sum()))
    good = [each for each in explanations if not each.clearly_worse(best)]
    own = explanations[0] if "as_given" in allowed else None
    return own, sorted(good, key=lambda each: each.parts)


def _explanations(match: Match, responding: np.ndarray, turn: Turn) -> tuple[_Explanation, _Explanation]:
    """Return the explanation that leaves channels at their sensors, and the one that permutes them best."""
    channels = np.arange(len(responding))
    cost = np.where(responding[:, None], match.residual, 0.5)
    # Among equal places a channel stays at its own.
    _, sensors = linear_sum_assignment(cost - 1e-6 * np.eye(len(cost)))
    settled = responding & (cost[channels, sensors] <= _FITS)
    sensors = _left_in_place(sensors, settled)
    own, there = (np.where(responding, cost[channels, place], 0.0) for place in (channels, sensors))
    factor, least = _CLEARER
    moved = np.flatnonzero(settled & (sensors != channels))
    seconds = [
        np.delete(cost[channel], sensors[channel]).min(initial=1.0) > factor * there[channel] + least
        for channel in moved
    ]
    seconds += list((match.expected[sensors[moved]] >= _PRESSED) & (there[moved] <= _WELL))
    # Of two silent channels, nothing says which is where.
    seconds.append(int((~settled & (sensors != channels)).sum()) <= 1)
    return _Explanation(turn, channels, own), _Explanation(turn, sensors, there, all(seconds))


def _left_in_place(sensors: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Return an assignment whose unsettled channels stay at their own sensors, where these are free."""
    sensors = np.where(settled, sensors, -1)
    for channel in np.flatnonzero(~settled):
        sensors[channel] = -1 if channel in sensors else channel
    sensors[sensors < 0] = np.setdiff1d(np.arange(len(sensors)), sensors)
    return sensors


def _refusal(
    own: _Explanation | None,
    best: _Explanation,
    clear: Sequence[_Explanation],
    confirmed: Confirmed,
    responding: np.ndarray,
) -> str:
    """Return the sentence that refuses a session, with the settings that confirm its explanations."""
    order = np.array(confirmed.order(len(responding)))
    if own is None:
        wrong = np.flatnonzero(responding)
        trouble = "the places of some presses are outside the sheet"
    else:
        wrong = np.flatnonzero(own.residual > _CLEARER[0] * best.residual + _CLEARER[1])
        wrong = np.union1d(wrong, own.unexplained).astype(int)
        noun, verb, place = ("channels", "respond", "their sensors") if len(wrong) > 1 else (
            "channel", "responds", "its sensor"
        )  # fmt: skip
        trouble = f"{noun} {listed(sorted(order[wrong]))} {verb}, but not to the presses near {place}"
    if not clear:
        return f"{trouble}: {_advice(wrong, order, responding)}"
    sentences = [f"{trouble}: the session fits if {_words(clear[0], confirmed, order)}"]
    # A turn that is made up for by another order says nothing new.
    others = [each for each in clear[1:] if each.turn == "as_given" or not len(each.moved)]
    sentences += [f"it fits as well if {_words(each, confirmed, order)}" for each in others[:2]]
    if len(left := clear[0].unexplained):
        sentences.append(f"channel {listed(sorted(order[left]))} fits nowhere: check the wiring")
    return ". ".join(text[0].upper() * bool(n) + text[bool(n) :] for n, text in enumerate(sentences))


def _concluded(each: _Explanation, own: _Explanation | None, responding: np.ndarray) -> bool:
    """Return whether an explanation is sure and explains enough to be named."""
    if not each.parts or not each.sure or len(each.unexplained) > _MOST * responding.sum():
        return False
    if own is None:
        return True
    if len(np.setdiff1d(each.unexplained, own.unexplained)):
        return False
    if each.turn == "as_given":
        return True
    return int((own.residual > _CLEARER[0] * each.residual + _CLEARER[1]).sum()) >= _FEWEST


def _advice(wrong: np.ndarray, order: np.ndarray, responding: np.ndarray) -> str:
    """Return what to check where no order of channels and no turn of the places explains a session."""
    if 2 * len(wrong) > responding.sum():
        return (
            "neither another order of the channels nor other axes explain the session; check the wiring, the "
            "layout, the places of the presses and the clock (calibrate.delay)"
        )
    numbers = ",".join(str(number) for number in wrong)
    return (
        "check the wiring, and the position of the sensor in the layout; "
        f"to leave it out, add 'calibrate.broken=[{numbers}]'"
    )


def _words(each: _Explanation, confirmed: Confirmed, order: np.ndarray) -> str:
    """Return an explanation in words, with its settings."""
    words, settings = list[str](), list[str]()
    if each.turn != "as_given":
        words.append(f"the places of the presses are {WORDS[each.turn]}")
        settings.append(f"calibrate.places={composed(confirmed.places, each.turn)}")
    if len(each.moved):
        moved = sorted(order[each.moved])
        verb = "exchanged" if len(moved) == 2 else "in another order"
        words.append(f"channels {listed(moved)} are {verb}")
        channels = ",".join(str(channel) for channel in order[np.argsort(each.sensors)])
        settings.append(f"'calibrate.channels=[{channels}]'")
    return f"{' and '.join(words)}; to confirm that, add {' '.join(settings)}"


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
    words = "; ".join(f"{kind}: {listed(numbers)}" for kind, numbers in kinds.items())
    raise InputError(
        f"{count} of {len(calibration)} sensors would be unusable ({words}), and at most a quarter may be: "
        "press near every sensor, check the supply and the cables of these channels, and record again"
    )


def listed(numbers: Sequence[int] | np.ndarray) -> str:
    """Return numbers in words, as ``2``, ``2 and 5`` or ``2, 5 and 7``; of many, the first ones."""
    words = [str(number) for number in numbers]
    if len(words) > _LISTED:
        words = [*words[: _LISTED - 1], f"{len(words) - _LISTED + 1} others"]
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
