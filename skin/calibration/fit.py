"""Fit the constants of a simulated device to a bench session, and test them on held-out presses."""

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.stats import theilslopes

from skin.calibration.bench import BenchData, BenchSession
from skin.calibration.channel import Channel, Loads, describe_channels, fit_channel
from skin.calibration.wiring import (
    MAD,
    QUIET,
    check_usable,
    collect_responses,
    find_polarity,
    measure_rests,
)
from skin.device.calibration import BROKEN, QUANTITIES, Calibration, Curves
from skin.device.imperfection import Imperfection
from skin.errors import InputError
from skin.mechanics.relaxation import first_order_lag

_PRESSED = 0.05  # of the largest true reading: less determines no gain
_LIMIT = 0.95  # of the largest reading of all: a channel that is always there is saturated
_RESPONDING = 0.05  # of the press's strongest reading: sensors that count
_LOADED = 0.2  # of a press's peak: frames in which its force is estimated
_CLIPPED = 0.95  # of the limit: a reading above may be cut off
_TOO_FAR = 0.25  # error of a held-out force; positions off by 2 mm cause less
_WEAK = 0.05  # of the median gain: such a channel has 20 times the noise of others
_GAUGES, _LIKE = {"kg": 9.80665, "g": 0.00980665}, 1.5  # N; factor within which a unit explains
_UNITS = {"gain": "", "hysteresis": "of peak", "time_constant": "s", "drift": "N/s"}


def fit_calibration(bench: BenchData, presses: Collection[int] | None = None) -> Calibration:
    """Fit every channel to the simulated true readings of presses, never to the gauge's force.

    Idle frames give offset, drift and noise; presses all else (:mod:`skin.calibration.channel`). A channel is
    dead if it never leaves its noise in the whole session, though its sensor was pressed. A channel whose
    values fall with force has polarity -1.

    Args:
        bench: the session.
        presses: numbers of the presses to use; None: all.

    Raises:
        InputError: no channel responds to a press.
    """
    used = range(len(bench.gauge)) if presses is None else presses
    raw, responses = bench.session.raw, collect_responses(bench)
    counts = (np.isfinite(raw) & bench.idle[:, None]).sum(axis=0)
    broken = _find_broken(bench.session, bench.true.max(axis=0), responses.responding)
    usable = ~np.isin(np.arange(raw.shape[1]), np.concatenate([*broken.values()]))
    if few := np.flatnonzero(usable & (counts < QUIET)).tolist():
        raise InputError(
            f"channel {few[0]} has {counts[few[0]]} idle frames: do not touch the skin for some seconds"
        )
    rests = measure_rests(bench.session, bench.idle)
    polarity, (offset, drift) = find_polarity(responses, bench.each), rests[["offset", "drift"]].to_numpy().T
    changes = polarity * (raw - offset - drift * bench.session.time[:, None])
    driven = bench.true[bench.frames_of(used)].max(axis=0, initial=0.0)
    loads, channels = Loads(bench, used), dict[int, Channel]()
    for number in np.flatnonzero(usable & (driven >= _PRESSED * driven.max())).tolist():
        noise = math.hypot(rests["noise"][number], rests["quantum"][number] / math.sqrt(12))
        channel = fit_channel(loads, bench.each[:, number], changes[:, number], noise)
        channels |= {} if channel is None else {number: channel}
    if not any(channel.known for channel in channels.values()):
        raise InputError(
            "no channel responds to a press below its limit: check layout, indenter, the forces and the "
            "session's clock"
        )
    return _describe(bench, rests, polarity, channels, changes, broken)


def _find_broken(session: BenchSession, pressed: np.ndarray, responding: np.ndarray) -> dict[str, list[int]]:
    """Return the broken channels by kind: those that never change, or are silent though ``pressed``, N."""
    largest, table = float(np.nanmax(session.raw, initial=-np.inf)), pd.DataFrame(session.raw)
    limit = min(2**session.bits - 1 if session.bits else np.inf, _LIMIT * largest)
    silent = (pressed >= _PRESSED * pressed.max()) & ~responding
    still, level = table.nunique().to_numpy() < 2, table.bfill().iloc[0].fillna(0.0).to_numpy()
    fixed, full = still & (level != 0), (level >= limit) & (limit > 0)
    kinds = {"dead": ~fixed & (still | silent), "stuck": fixed & ~full, "saturated": fixed & full}
    return {kind: np.flatnonzero(kinds[kind]).tolist() for kind in BROKEN}


def _curved_noise(bench: BenchData, curves: Curves, number: int, change: np.ndarray) -> float:
    """Return the noise under load of a curved channel, where its curve is the reference.

    Elsewhere it has other slopes. Differences are taken twice: the rising force is no noise.
    """
    true, every = bench.true[:, number], np.repeat(change[:, None], len(curves.exponent), axis=1)
    linear = curves.straighten(every)[:, number]
    loaded = linear[bench.loading & (true > _PRESSED * true.max()) & np.isfinite(change)]
    return MAD / math.sqrt(6) * float(np.median(np.abs(np.diff(loaded, 2)))) * float(curves.slopes[number])


def _curves(channels: Mapping[int, Channel], sensors: int) -> Curves | None:
    """Return the curves of all channels, in the session's unit; None: all are linear."""
    bent = {n: channel for n, channel in channels.items() if channel.kind != "linear"}
    if not bent:
        return None
    at, exponent = math.exp(float(np.median([one.middle[1] for one in bent.values()]))), np.ones(sensors)
    for number, channel in bent.items():
        exponent[number] = channel.slopes[0] if channel.kind == "power" else 1.0
    tables = {n: channel.table(at) for n, channel in bent.items() if channel.kind == "table"}
    return Curves(exponent, np.full(sensors, at), tables)


def _describe(
    bench: BenchData,
    rests: pd.DataFrame,
    polarity: np.ndarray,
    channels: Mapping[int, Channel],
    changes: np.ndarray,
    broken: Mapping[str, list[int]],
) -> Calibration:
    """Return the calibration that follows from the rest and the response of every channel."""
    known = {n: one for n, one in channels.items() if one.known}
    curves = _curves(known, len(rests))
    at, values = 1.0 if curves is None else float(curves.at[0]), rests.assign(drift=polarity * rests["drift"])
    values["clip"] = pd.Series({n: one.clip for n, one in channels.items()})
    values["gain"] = pd.Series({n: one.gain(at) for n, one in known.items()})
    for name in ("hysteresis", "time_constant"):
        values[name] = pd.Series({n: getattr(one, name) for n, one in known.items()})
    if curves is not None:
        values["exponent"] = pd.Series(curves.exponent)[list(known)]
        for n in (n for n, one in known.items() if one.kind != "linear"):
            values.loc[n, "noise"] = _curved_noise(bench, curves, n, changes[:, n])
    metadata = {"presses": len(bench.gauge), "frames": len(bench.session.time)}
    calibration = convert_to_newton(bench.session, values, polarity, broken, metadata)
    scale, (low, high) = calibration.scale, calibration.ranges["gain"]
    error = 2 * scale * float(np.median([channel.error * channel.gain(at) for channel in known.values()]))
    ranges = {**calibration.ranges, "gain": [max(low - error, 0.0), high + error]}
    if curves is None:
        return replace(calibration, ranges=ranges)
    about = {**calibration.about, "responses": describe_channels(known)}
    tables = {n: (scale * np.array(table)).tolist() for n, table in curves.tables.items()}
    return replace(calibration, ranges=ranges, about=about, exponent_at=at * scale, tables=tables)


def convert_to_newton(
    session: BenchSession,
    values: pd.DataFrame,
    polarity: np.ndarray,
    broken: Mapping[str, Sequence[int]],
    metadata: Mapping[str, Any],
) -> Calibration:
    """Return the calibration of a session, with ranges over the working channels.

    Args:
        session: of the channels.
        values: columns of quantities (S,), in the session's unit, gain per N, offset of the raw values; NaN
            if unknown.
        polarity: (S,), 1 or -1.
        broken: kind -> numbers of channels.
        metadata: origin of the calibration.
    """
    alive = ~np.isin(np.arange(len(polarity)), np.concatenate([*broken.values()]))
    # Counts have an unknown zero, common to all channels; readings in N do not.
    scale, zero = 1.0, 0.0
    if session.unit != "N":
        scale, zero = 1 / float(np.nanmedian(values["gain"])), float(np.median(values["offset"][alive]))
    sensors, ranges = dict[str, list[float | None]](), {"dead": [0.0, float((~alive).sum())]}
    for name, column in values.assign(offset=polarity * (values["offset"] - zero)).items():
        converted = column * (1.0 if name in ("hysteresis", "time_constant", "exponent") else scale)
        # No negative 0.
        sensors[name] = [float(f"{value:.6g}") + 0.0 if np.isfinite(value) else None for value in converted]
        working = [
            value for value, live in zip(sensors[name], alive, strict=True) if live and value is not None
        ]
        ranges |= {name: [min(working), max(working)]} if working else {}
    signs: Sequence[int] = polarity.astype(int).tolist() if polarity.min() < 0 else ()
    kinds = {kind: list(map(int, numbers)) for kind, numbers in broken.items()}
    about = {"unit": session.unit, **metadata}
    return Calibration(sensors, kinds, ranges, scale, zero, about, polarity=signs)


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on presses that were not used for the calibration.

    Attributes:
        rmse: N, of the ``simulated`` true readings (gain 1, no offset), of these ``tared``, with the offset
            of each sensor, and of the ``calibrated`` simulation.
        held_out: numbers of these presses.
        force: ratio of estimated force to the gauge's, median over the loading of each held-out press, (n,);
            empty if no sensor could be used.
    """

    rmse: dict[str, float]
    held_out: Sequence[int]
    force: np.ndarray

    @property
    def helps(self) -> bool:
        """Whether the calibrated simulation has a smaller error than taring alone."""
        # Less than a hundredth is chance.
        return self.rmse["calibrated"] < 0.99 * min(self.rmse["simulated"], self.rmse["tared"])


def evaluate_held_out(bench: BenchData, fraction: float) -> HeldOutErrors:
    """Calibrate without some presses, and compare their simulation with the measured readings.

    Args:
        bench: the session.
        fraction: of the presses that is held out.

    Raises:
        InputError: no sensor has two presses.
    """
    strongest = bench.each.argmax(axis=1)
    # Each has an earlier press at the same strongest sensor.
    spare = [n for n in range(len(strongest)) if (strongest[:n] == strongest[n]).any()]
    if not spare:
        raise InputError("no press can be held out: press near every sensor at least twice")
    count = min(len(spare), max(1, round(fraction * len(strongest))))
    held = [spare[n] for n in np.linspace(0, len(spare) - 1, count).round().astype(int)]
    calibration = fit_calibration(bench, [n for n in range(len(bench.gauge)) if n not in held])
    answers = bench.each[bench.applied[1]]
    responding = answers > _RESPONDING * answers.max(axis=1, keepdims=True)
    alive = ~calibration.values()["dead"] & np.isfinite(bench.session.raw)
    counted = bench.frames_of(held)[:, None] & responding & alive
    measured, tared = calibration.newtons(bench.session.raw), bench.true + calibration.values()["offset"]
    sides = {"simulated": bench.true, "tared": tared, "calibrated": predict_session(bench, calibration)}
    rmse = {name: float(np.sqrt(np.mean((side - measured)[counted] ** 2))) for name, side in sides.items()}
    return HeldOutErrors(rmse, held, _estimate_forces(bench, held, calibration))


def predict_session(bench: BenchData, calibration: Calibration) -> np.ndarray:
    """Return the simulated readings of a calibrated device without noise, (T, S), N."""
    imperfection = Imperfection(calibration=calibration)
    randomness = np.random.default_rng(0)
    constants = imperfection.constants(bench.each.shape[1], randomness)
    constants = constants._replace(noise=torch.zeros(()))
    time = torch.from_numpy(bench.session.time).float()
    true = torch.from_numpy(bench.true)[None].float()
    return imperfection.raw(true, constants, randomness, time)[0].double().numpy()


def estimate_force(raw: np.ndarray, each: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Estimate the force of a press from readings, (...), N, by least squares over usable sensors.

    Args:
        raw: (..., S), in the session's unit.
        each: (S,), true readings per N of that indenter at that position, as
            :func:`skin.calibration.bench.per_newton` gives them.
        calibration: of this skin.

    Returns:
        NaN if every sensor that responds to the press is broken or at its limit.
    """
    true, values = calibration.corrected(raw), calibration.values()
    below = calibration.newtons(raw) - values["offset"] < _CLIPPED * values["clip"]
    weights = np.where(below & np.isfinite(true) & (each > _RESPONDING * each.max()), each, 0.0)
    square = (weights**2).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (weights * np.nan_to_num(true)).sum(axis=-1) / np.where(square > 0, square, np.nan)


def _estimate_forces(bench: BenchData, presses: Sequence[int], calibration: Calibration) -> np.ndarray:
    """Return the ratio of estimated force to the lagged force of the gauge, of each press."""
    force, press = bench.applied
    lag = torch.tensor([float(np.median(calibration.known("time_constant")))]).double()
    late = first_order_lag(torch.from_numpy(force)[None, :, None], lag, torch.from_numpy(bench.session.time))
    late_force = late[0, :, 0].numpy()
    per_second = calibration.signs * calibration.known("drift") / calibration.scale
    drift = per_second * bench.session.time[:, None]
    raw, fractions = bench.session.raw - drift, []
    for number in presses:
        mine = bench.loading & (press == number)
        mine &= force > _LOADED * force[press == number].max()
        fractions.append(estimate_force(raw[mine], bench.each[number], calibration) / late_force[mine])
    finite = [ratios[np.isfinite(ratios)] for ratios in fractions]
    return np.array([np.median(ratios) for ratios in finite if len(ratios)])


def check_force(calibration: Calibration, clip: float) -> None:
    """Compare the unit of the gauge with what this skin can give.

    Args:
        calibration: fitted to the gauge.
        clip: largest force that a sensor of this skin measures, N.

    Raises:
        InputError: gains of sensors in N, or limits of sensors in counts, are those of a gauge in another
            unit.
    """
    if calibration.about.get("unit") == "N":
        ratio = float(np.median([gain for gain in calibration.sensors["gain"] if gain is not None]))
        words = f"the readings, in N, are {ratio:.3g} times what the gauge's force makes of them"
    else:
        limits = np.array([np.nan if value is None else value for value in calibration.sensors["clip"]])
        if not np.isfinite(limits).any():
            return
        if calibration.curves is not None:
            limits = calibration.curves.straighten(limits)
        limit = float(np.nanmedian(limits))
        ratio = clip / limit
        words = f"sensors reach their limit at {limit:.3g} N, and device.clip is {clip:g} N"
    fits = [name for name, unit in _GAUGES.items() if abs(math.log(ratio / unit)) < math.log(_LIKE)]
    if fits:
        raise InputError(
            f"{words}: the force of the gauge seems to be in {fits[0]}; add "
            f"calibrate.force_scale={_GAUGES[fits[0]]:g}, or calibrate.force_scale=1 if it is in N"
        )


# A force gauge that drifts during the session.


_LINEAR = 0.8  # of the channel's largest response: above, it may be at its limit
_STRONG = 0.5  # of the sensor's strongest press: weaker ones depend on where it lies
_LINE_STEPS = 2  # steps below the limit that determine a line: what the protocol asks for
_GAUGE_CHANGES = {"sensitivity": 0.2, "zero": 0.1}
"""Largest changes. Sensors misplaced by 2 mm look like a sensitivity that changes by 12 %, as the protocol
presses them first where the response should be highest."""
_PRESSED_AGAIN = 3  # that were pressed again: fewer may all be misplaced alike


def check_gauge(bench: BenchData) -> None:
    """Raise InputError if sensitivity or zero of the gauge change during a session.

    Each press gives a line of the gauge's force over the reading of a sensor, whose intercept is the zero of
    the gauge. Its slope, compared with that of other presses on the sensor, shows the sensitivity.

    Args:
        bench: the session.

    Raises:
        InputError: the sensitivity changes by more than 20 %, or the zero by 10 % of the peak force.
    """
    time, sensor, slope, zero = _gauge_lines(bench).T
    # Sensors have gains of their own, but the gauge has one zero.
    for what, group, values in (("sensitivity", sensor, slope), ("zero", 0 * sensor, zero)):
        if abs(change := _gauge_change(time, group, values)) > _GAUGE_CHANGES[what]:
            raise InputError(
                f"the {what} of the gauge, against the sensors, changes by {change:+.0%} during the session: "
                "let it warm up, zero it between presses, and record again"
            )


def _gauge_lines(bench: BenchData) -> np.ndarray:
    """Return rows of time (fraction of presses before), sensor, log slope, and intercept over the peak."""
    responses, rows = collect_responses(bench), []
    strength, largest = bench.each.max(axis=0), np.abs(responses.measured).max(axis=0)
    for press, each in enumerate(bench.each):
        steps = responses.press == press
        force = responses.force[steps]
        for sensor in np.flatnonzero(responses.responding & (each >= _STRONG * strength)):
            reading = np.abs(responses.measured[steps, sensor])
            linear = reading < _LINEAR * largest[sensor]
            if linear.sum() >= _LINE_STEPS and np.ptp(reading[linear]) > 0:
                slope, zero = np.polyfit(reading[linear], force[linear], 1)
                sensitivity = np.log(abs(slope) * each[sensor])
                rows.append((press / len(bench.each), sensor, sensitivity, zero / force.max()))
    return np.array(rows).reshape(-1, 4)


def _gauge_change(time: np.ndarray, group: np.ndarray, values: np.ndarray) -> float:
    """Return how values change from time 0 to 1 within groups; 0 if its interval of 95 % contains 0.

    By the slopes between pairs (Theil and Sen), so that some misplaced sensors do not bend the line.
    """
    frame = pd.DataFrame({"time": time, "values": values})
    # Rounded, because a slope between two times that differ in the last digit is none.
    within = (frame - frame.groupby(group).transform("mean")).round(6)
    moved = within[within["time"] != 0]
    if len(moved) - len(np.unique(group)) < _PRESSED_AGAIN:
        return 0.0
    change, _, low, high = theilslopes(moved["values"], moved["time"])
    return float(change) if low * high > 0 else 0.0


def fit_presses(bench: BenchData, fraction: float, clip: float | None) -> tuple[Calibration, HeldOutErrors]:
    """Return a calibration by presses of a gauge, and its errors on held-out ones.

    Args:
        bench: data of the session.
        fraction: of the presses that are held out.
        clip: of the designed device, N, with which the unit of the gauge is compared; None: it is known.

    Raises:
        InputError: the gauge drifts, its unit is wrong, or too few sensors can be used.
    """
    check_gauge(bench)
    calibration = fit_calibration(bench)
    check_usable(calibration)
    if clip is not None:
        check_force(calibration, clip)
    outcome = evaluate_held_out(bench, fraction)
    rmse = {name: round(value, 6) for name, value in outcome.rmse.items()}
    metadata = {**calibration.about, "held_out": list(outcome.held_out), "rmse": rmse}
    return replace(calibration, about=metadata), outcome


def print_calibration(calibration: Calibration, outcome: HeldOutErrors) -> None:
    """Print the constants of working sensors, the broken, inverse and weak ones, and held-out errors."""
    rows = {
        name: [np.median(calibration.known(name)), *calibration.ranges[name], _UNITS.get(name, "N")]
        for name in QUANTITIES
        if name in calibration.ranges
    }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["median", "least", "largest", ""])
    print(table.to_string(float_format="{:.4g}".format))
    for line in calibration.about.get("responses", []):
        print(line)
    gains = {n: gain for n, gain in enumerate(calibration.sensors["gain"]) if gain is not None}
    weak = [n for n, gain in gains.items() if gain < _WEAK * float(np.median(list(gains.values())))]
    broken = {number for group in calibration.broken.values() for number in group}
    unknown = [n for n in range(len(calibration)) if n not in gains and n not in broken]
    groups = [
        *((kind, numbers, " (from 0)") for kind, numbers in calibration.broken.items()),
        ("inverse, values fall with force", np.flatnonzero(calibration.signs < 0).tolist(), ""),
        (f"weak, less than {_WEAK:.0%} of the median gain", weak, ""),
        ("not pressed, or at the limit, so of median gain", unknown, ""),
    ]
    for words, numbers, note in groups:
        if numbers:
            print(f"{words}: sensors {', '.join(map(str, numbers))}{note}")
    errors = ", ".join(f"{name} {value:.4f} N" for name, value in outcome.rmse.items())
    print(f"RMSE on {len(outcome.held_out)} held-out presses: {errors}")
    if len(outcome.force):
        off = np.abs(outcome.force - 1)
        print(f"force of these presses from readings: off by {np.median(off):.1%}, at most {off.max():.1%}")
        if off.max() > _TOO_FAR:
            warnings.warn(
                f"the force of a held-out press is off by {off.max():.0%}: sensors are probably not where "
                "the layout says, and then their gains are wrong; measure their positions",
                UserWarning,
                stacklevel=2,
            )
