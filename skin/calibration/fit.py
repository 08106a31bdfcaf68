"""Fit the constants of a simulated device to a bench session, and test them on held-out presses."""

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from skin.calibration.bench import BenchData
from skin.calibration.channel import MAD, Channel, Loads, describe_channels, fit_channel
from skin.calibration.gauge_drift import check_gauge
from skin.calibration.wiring import (
    Idle,
    check_usable,
    collect_responses,
    find_polarity,
    find_quantum,
    measure_idle,
)
from skin.device.calibration import BROKEN, QUANTITIES, Calibration
from skin.device.curves import Curves
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


@dataclass(frozen=True)
class _Rest:
    """An untouched channel, in the session's unit; why it is broken, or None."""

    idle: Idle
    quantum: float = 0.0
    broken: str | None = None


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
    rests = [_measure_rest(bench, number) for number in range(bench.each.shape[1])]
    responses = collect_responses(bench)
    polarity = find_polarity(responses, bench.each)
    largest = bench.true.max(axis=0)
    silent = (largest >= _PRESSED * largest.max()) & ~responses.responding
    rests = [
        replace(rest, broken=rest.broken or "dead") if dead else rest
        for rest, dead in zip(rests, silent, strict=True)
    ]
    driven = bench.true[bench.frames_of(used)].max(axis=0, initial=0.0)
    loads, channels = Loads(bench, used), dict[int, Channel]()
    for number in np.flatnonzero(driven >= _PRESSED * driven.max()).tolist():
        rest, change = rests[number], _subtract_rest(bench, number, rests[number], polarity[number])
        if rest.broken is None:
            noise = math.hypot(rest.idle.noise, rest.quantum / math.sqrt(12))
            channel = fit_channel(loads, bench.each[:, number], change, noise)
            channels |= {} if channel is None else {number: channel}
    if not any(channel.known for channel in channels.values()):
        raise InputError(
            "no channel responds to a press below its limit: check layout, indenter, the forces and the "
            "session's clock"
        )
    return _convert_to_newton(bench, rests, polarity, channels)


def _measure_rest(bench: BenchData, number: int) -> _Rest:
    """Return the idle statistics of a channel; one that never changes is broken."""
    raw = bench.session.raw
    measured = raw[:, number]
    present = np.isfinite(measured)
    if not present.any():
        return _Rest(Idle(0.0, 0.0, 0.0), broken="dead")
    if np.ptp(measured[present]) == 0:
        level = float(measured[present][0])
        full = 2**bench.session.bits - 1 if bench.session.bits else np.inf
        limit = level >= min(full, _LIMIT * float(np.nanmax(raw))) > 0
        return _Rest(
            Idle(level, 0.0, 0.0), broken="dead" if level == 0 else "saturated" if limit else "stuck"
        )
    quiet = present & bench.idle
    if quiet.sum() < 10:
        raise InputError(
            f"channel {number} has {quiet.sum()} idle frames: do not touch the skin for some seconds"
        )
    step = find_quantum(measured[present])
    return _Rest(measure_idle(bench.session.time[quiet], measured[quiet], step), step)


def _subtract_rest(bench: BenchData, number: int, rest: _Rest, polarity: float) -> np.ndarray:
    """Return the change of a channel against its rest, (T,), in the session's unit, above 0 under force."""
    return polarity * (bench.session.raw[:, number] - rest.idle.offset - rest.idle.drift * bench.session.time)


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
    bent = {n: channel for n, channel in channels.items() if channel.kind != "linear" and channel.known}
    if not bent:
        return None
    at = math.exp(float(np.median([channel.middle[1] for channel in bent.values()])))
    exponent = np.ones(sensors)
    for number, channel in bent.items():
        exponent[number] = channel.slopes[0] if channel.kind == "power" else 1.0
    tables = {n: channel.table(at) for n, channel in bent.items() if channel.kind == "table"}
    return Curves(exponent, np.full(sensors, at), tables)


def _convert_to_newton(
    bench: BenchData, rests: Sequence[_Rest], polarity: np.ndarray, channels: Mapping[int, Channel]
) -> Calibration:
    """Convert channels to N, and compute ranges over the working ones."""
    curves = _curves(channels, len(rests))
    at = 1.0 if curves is None else float(curves.at[0])
    known = {n: channel for n, channel in channels.items() if channel.known}
    gains = {n: channel.gain(at) for n, channel in known.items()}
    scale = 1.0 if bench.session.unit == "N" else 1 / float(np.median(list(gains.values())))
    # Counts have an unknown zero, common to all channels; readings in N do not.
    counts = [rest.idle.offset for rest in rests if rest.broken is None]
    zero = 0.0 if bench.session.unit == "N" else float(np.median(counts))
    noise = [rest.idle.noise for rest in rests]
    for number, channel in known.items():
        if curves is not None and channel.kind != "linear":
            change = _subtract_rest(bench, number, rests[number], polarity[number])
            noise[number] = _curved_noise(bench, curves, number, change)
    numbers = range(len(rests))
    offset = [sign * (rest.idle.offset - zero) for sign, rest in zip(polarity, rests, strict=True)]
    in_unit: dict[str, list[Any]] = {
        "offset": offset,
        "noise": noise,
        "drift": [sign * rest.idle.drift for sign, rest in zip(polarity, rests, strict=True)],
        "quantum": [rest.quantum for rest in rests],
        "clip": [channels[n].clip if n in channels else None for n in numbers],
        "gain": [gains.get(n) for n in numbers],
    }
    sensors = {name: [_round(value, scale) for value in values] for name, values in in_unit.items()}
    sensors["hysteresis"] = [_round(known[n].hysteresis) if n in known else None for n in numbers]
    sensors["time_constant"] = [_round(known[n].time_constant) if n in known else None for n in numbers]
    if curves is not None:
        sensors["exponent"] = [_round(float(curves.exponent[n])) if n in known else None for n in numbers]
    broken = {kind: [n for n in numbers if rests[n].broken == kind] for kind in BROKEN}
    ranges: dict[str, list[float]] = {"dead": [0, sum(map(len, broken.values()))]}
    for name, values in sensors.items():
        working = [value for n, value in enumerate(values) if rests[n].broken is None and value is not None]
        ranges |= {name: [min(working), max(working)]} if working else {}
    error = 2 * scale * float(np.median([channel.error * gains[n] for n, channel in known.items()]))
    ranges["gain"] = [max(ranges["gain"][0] - error, 0.0), ranges["gain"][1] + error]
    about: dict[str, Any] = {
        "unit": bench.session.unit,
        "presses": len(bench.gauge),
        "frames": len(bench.session.time),
    }
    signs = polarity.astype(int).tolist() if polarity.min() < 0 else ()
    calibration = Calibration(sensors, broken, ranges, scale, zero, about, polarity=signs)
    if curves is None:
        return calibration
    about["responses"] = describe_channels(known)
    tables = {n: (scale * np.array(table)).tolist() for n, table in curves.tables.items()}
    return replace(calibration, about=about, exponent_at=at * scale, tables=tables)


def _round(value: float | None, scale: float = 1.0) -> float | None:
    return None if value is None else float(f"{value * scale:.6g}") + 0.0  # no negative 0


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on presses that were not used for the calibration.

    Attributes:
        simulated: RMSE of the simulated true readings (gain 1, no offset), N.
        tared: RMSE with each sensor's offset added, N.
        calibrated: RMSE of the calibrated simulation, N.
        held_out: numbers of these presses.
        force: ratio of estimated force to the gauge's, median over the loading of each held-out press, (n,);
            empty if no sensor could be used.
    """

    simulated: float
    tared: float
    calibrated: float
    held_out: Sequence[int]
    force: np.ndarray

    @property
    def helps(self) -> bool:
        """Whether the calibrated simulation has a smaller error than taring alone."""
        return self.calibrated < min(self.simulated, self.tared)


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
    measured, true = calibration.newtons(bench.session.raw), bench.true

    def rmse(guess: np.ndarray) -> float:
        return float(np.sqrt(np.mean((guess[counted] - measured[counted]) ** 2)))

    offset = calibration.values()["offset"]
    return HeldOutErrors(
        rmse(true),
        rmse(true + offset),
        rmse(predict_session(bench, calibration)),
        held,
        _estimate_forces(bench, held, calibration),
    )


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
    rmse = {name: round(getattr(outcome, name), 6) for name in ("simulated", "tared", "calibrated")}
    metadata = {**calibration.about, "held_out": list(outcome.held_out), "rmse": rmse}
    return replace(calibration, about=metadata), outcome


def print_calibration(calibration: Calibration, outcome: HeldOutErrors) -> None:
    """Print the constants of working sensors, the broken, inverse and weak ones, and held-out errors."""
    table = Table("", "median", "least", "largest", "", box=None, pad_edge=False)
    for name in QUANTITIES:
        values = [value for value in calibration.sensors.get(name, []) if value is not None]
        if values and name in calibration.ranges:
            low, high = calibration.ranges[name]
            middle = f"{np.median(values):.4g}"
            table.add_row(name, middle, f"{low:.4g}", f"{high:.4g}", _UNITS.get(name, "N"))
    Console().print(table)
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
    print(
        f"RMSE on {len(outcome.held_out)} held-out presses: simulated {outcome.simulated:.4f} N, with tare "
        f"{outcome.tared:.4f} N, calibrated {outcome.calibrated:.4f} N"
    )
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
