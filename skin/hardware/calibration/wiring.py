"""Find out whether channels and places of a bench session are those of the layout, and name what is not.

A channel that responds at other presses than its sensor should is not dead. The session is compared with what
it would be if the places of the presses were mirrored or turned, or the channels in another order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.optimize import linear_sum_assignment

from skin.core.settings import checked
from skin.device.base import AbstractSimulated
from skin.device.calibration import Calibration
from skin.errors import InputError
from skin.hardware.calibration.bench import BenchSession, Gauge, per_newton
from skin.hardware.calibration.channels import (
    Match,
    Responses,
    collect_responses,
    match_channels,
)
from skin.hardware.calibration.presses import BenchData, build_bench_data

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
TURNS: tuple[Turn, ...] = get_args(Turn)
"""What ``calibrate.places`` takes, the simplest first."""
WORDS: dict[Turn, str] = {
    "as_given": "as given",
    "mirror_x": "mirrored in x (the x axis counts to the left)",
    "mirror_y": "mirrored in y (the y axis counts upwards)",
    "rotate_180": "turned by 180 degrees (both axes count backwards)",
    "transpose": "transposed (x and y are exchanged)",
    "rotate_90": "turned by 90 degrees",
    "rotate_270": "turned by 270 degrees",
    "transpose_other": "mirrored at the other diagonal (x and y are exchanged, and both count backwards)",
}
_MATRICES: dict[Turn, tuple[tuple[int, int], tuple[int, int]]] = {
    "as_given": ((1, 0), (0, 1)),
    "mirror_x": ((-1, 0), (0, 1)),
    "mirror_y": ((1, 0), (0, -1)),
    "rotate_180": ((-1, 0), (0, -1)),
    "transpose": ((0, 1), (1, 0)),
    "rotate_90": ((0, -1), (1, 0)),
    "rotate_270": ((0, 1), (-1, 0)),
    "transpose_other": ((0, -1), (-1, 0)),
}
"""From the direction in the gauge's frame to that on the sheet, x right and y down."""
_PLAIN = 0.05  # residual: channels that are explained at least as well need no turn to be tried
_FITS = 0.45  # residual: sensors misplaced by 5 mm leave 0.25, another sensor 0.6 and more
_WELL = 0.15  # residual: a channel that is called exchanged has to fit its new place at least as well
_CLEARER = 2.0, 0.1  # another explanation leaves less than half of the residual, less 0.1 of a channel's
_MOST = 0.25  # share of the responding channels that an explanation may leave, and of unusable sensors
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
    matrix = np.array(_MATRICES[turn], dtype=float)
    middle = np.array(size) / 2
    centred = gauge.place - np.abs(matrix).T @ middle
    direction = matrix @ np.stack([np.cos(gauge.angle), np.sin(gauge.angle)])
    angle = gauge.angle if turn == "as_given" else np.arctan2(direction[1], direction[0])
    return replace(gauge, place=centred @ matrix.T + middle, angle=angle)


def lies_on_sheet(gauge: Gauge, size: Sequence[float]) -> bool:
    """Return whether all places of a gauge are on a sheet of this size, x and y, m."""
    return bool((gauge.place >= 0).all() and (gauge.place <= np.array(size)).all())


def compose_turns(first: Turn, then: Turn) -> Turn:
    """Return the turn that is the same as one turn after another."""
    product = np.array(_MATRICES[then]) @ np.array(_MATRICES[first])
    return next(turn for turn in TURNS if (np.array(_MATRICES[turn]) == product).all())


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

    def clearly_worse(self, rival: "_Explanation") -> bool:
        """Return whether another explanation leaves clearly less."""
        differs = (self.sensors != rival.sensors) | (self.turn != rival.turn)
        factor, least = _CLEARER
        leaves_more = len(self.unexplained) > len(rival.unexplained)
        return leaves_more or self.residual[differs].sum() > factor * rival.residual[differs].sum() + least


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
        session = replace(session, raw=_order_channels(session.raw, confirmed))
    if rows is None:
        return build_bench_data(device, session, rows)
    gauge = turn_gauge(rows, confirmed.places, device.size)
    turned = {turn: turn_gauge(gauge, turn, device.size) for turn in TURNS}
    allowed = {turn: places for turn, places in turned.items() if lies_on_sheet(places, device.size)}
    # Where no turn brings all places onto the sheet, they are refused here.
    bench = build_bench_data(device, session, next(iter(allowed.values()), gauge))
    responses = collect_responses(bench)
    straight, best = _compare_turns(device, bench, responses, allowed)
    clear = [entry for entry in best if _is_conclusive(entry, straight, responses.responding)]
    explained = straight is not None and not len(straight.unexplained)
    if explained and (not clear or any(entry is straight for entry in best)):
        return bench
    raise InputError(_phrase_refusal(straight, best[0], clear, confirmed, responses.responding))


def _order_channels(raw: np.ndarray, confirmed: Confirmed) -> np.ndarray:
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


def _compare_turns(
    device: AbstractSimulated, bench: BenchData, responses: Responses, allowed: Mapping[Turn, Gauge]
) -> tuple[_Explanation | None, list[_Explanation]]:
    """Return the explanation by the layout as it is, and those about as good as the best, simplest first.

    The first is None where the places as given are not on the sheet.
    """
    explanations = list[_Explanation]()
    for turn, gauge in allowed.items():
        rows = bench.each if gauge is bench.gauge else per_newton(device.model, device.body, gauge)
        straight, permuted = _explain(match_channels(responses, rows), responses.responding, turn)
        plain = straight.residual.max(initial=0.0) < _PLAIN and not straight.clearly_worse(permuted)
        if turn == "as_given" and plain:
            return straight, [straight]
        explanations += [straight, permuted] if len(permuted.moved) else [straight]
    best = min(explanations, key=lambda entry: (len(entry.unexplained), entry.residual.sum()))
    good = [entry for entry in explanations if not entry.clearly_worse(best)]
    designed = explanations[0] if "as_given" in allowed else None
    return designed, sorted(good, key=lambda entry: entry.parts)


def _explain(match: Match, responding: np.ndarray, turn: Turn) -> tuple[_Explanation, _Explanation]:
    """Return the explanation that leaves channels at their sensors, and the one that permutes them best."""
    channels = np.arange(len(responding))
    cost = np.where(responding[:, None], match.residual, 0.5)
    # Among equal places a channel stays at its own.
    _, sensors = linear_sum_assignment(cost - 1e-6 * np.eye(len(cost)))
    settled = responding & (cost[channels, sensors] <= _FITS)
    sensors = _keep_unsettled(sensors, settled)
    straight, permuted = (np.where(responding, cost[channels, place], 0.0) for place in (channels, sensors))
    factor, least = _CLEARER
    moved = np.flatnonzero(settled & (sensors != channels))
    seconds = [
        np.delete(cost[channel], sensors[channel]).min(initial=1.0) > factor * permuted[channel] + least
        for channel in moved
    ]
    seconds += list((match.expected[sensors[moved]] >= _PRESSED) & (permuted[moved] <= _WELL))
    # Of two silent channels, nothing says which is where.
    seconds.append(int((~settled & (sensors != channels)).sum()) <= 1)
    return _Explanation(turn, channels, straight), _Explanation(turn, sensors, permuted, all(seconds))


def _keep_unsettled(sensors: np.ndarray, settled: np.ndarray) -> np.ndarray:
    """Return an assignment whose unsettled channels stay at their own sensors, where these are free."""
    sensors = np.where(settled, sensors, -1)
    for channel in np.flatnonzero(~settled):
        sensors[channel] = -1 if channel in sensors else channel
    sensors[sensors < 0] = np.setdiff1d(np.arange(len(sensors)), sensors)
    return sensors


def _phrase_refusal(
    straight: _Explanation | None,
    best: _Explanation,
    clear: Sequence[_Explanation],
    confirmed: Confirmed,
    responding: np.ndarray,
) -> str:
    """Return the sentence that refuses a session, with the settings that confirm its explanations."""
    order = np.array(confirmed.order(len(responding)))
    if straight is None:
        wrong = np.flatnonzero(responding)
        trouble = "the places of some presses are outside the sheet"
    else:
        wrong = np.flatnonzero(straight.residual > _CLEARER[0] * best.residual + _CLEARER[1])
        wrong = np.union1d(wrong, straight.unexplained).astype(int)
        noun, verb, place = ("channels", "respond", "their sensors") if len(wrong) > 1 else (
            "channel", "responds", "its sensor"
        )  # fmt: skip
        trouble = f"{noun} {list_numbers(sorted(order[wrong]))} {verb}, but not to the presses near {place}"
    if not clear:
        return f"{trouble}: {_phrase_advice(wrong, order, responding)}"
    sentences = [f"{trouble}: the session fits if {_phrase_explanation(clear[0], confirmed, order)}"]
    # A turn that is made up for by another order says nothing new.
    others = [entry for entry in clear[1:] if entry.turn == "as_given" or not len(entry.moved)]
    sentences += [
        f"it fits as well if {_phrase_explanation(entry, confirmed, order)}" for entry in others[:2]
    ]
    if len(left := clear[0].unexplained):
        sentences.append(f"channel {list_numbers(sorted(order[left]))} fits nowhere: check the wiring")
    return ". ".join(text[0].upper() * bool(n) + text[bool(n) :] for n, text in enumerate(sentences))


def _is_conclusive(explanation: _Explanation, straight: _Explanation | None, responding: np.ndarray) -> bool:
    """Return whether an explanation is sure and explains enough to be named."""
    if not explanation.parts or not explanation.sure:
        return False
    if len(explanation.unexplained) > _MOST * responding.sum():
        return False
    if straight is None:
        return True
    if len(np.setdiff1d(explanation.unexplained, straight.unexplained)):
        return False
    if explanation.turn == "as_given":
        return True
    return int((straight.residual > _CLEARER[0] * explanation.residual + _CLEARER[1]).sum()) >= _FEWEST


def _phrase_advice(wrong: np.ndarray, order: np.ndarray, responding: np.ndarray) -> str:
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


def _phrase_explanation(explanation: _Explanation, confirmed: Confirmed, order: np.ndarray) -> str:
    """Return an explanation in words, with its settings."""
    words, settings = list[str](), list[str]()
    if explanation.turn != "as_given":
        words.append(f"the places of the presses are {WORDS[explanation.turn]}")
        settings.append(f"calibrate.places={compose_turns(confirmed.places, explanation.turn)}")
    if len(explanation.moved):
        moved = sorted(order[explanation.moved])
        verb = "exchanged" if len(moved) == 2 else "in another order"
        words.append(f"channels {list_numbers(moved)} are {verb}")
        channels = ",".join(str(channel) for channel in order[np.argsort(explanation.sensors)])
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
