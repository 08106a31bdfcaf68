"""Fit the constants of a simulated device to a bench session, and test them on held-out presses."""

import math
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from skin.calibration.bench import BenchData
from skin.calibration.gauge_drift import check_gauge
from skin.calibration.response_fit import Shape, curves_of, describe_shapes, fit_shape
from skin.calibration.wiring import (
    _MAD,
    _MEDIAN,
    Idle,
    check_usable,
    collect_responses,
    find_polarity,
    find_quantum,
    measure_idle,
)
from skin.device.calibration import QUANTITIES, Calibration, Curves
from skin.device.imperfection import Imperfection
from skin.errors import InputError
from skin.mechanics.relaxation import first_order_lag, running_peak

_PRESSED = 0.05  # of the largest true reading: less determines no gain
_SURE = 6.0  # standard errors: a slope of noise alone exceeds them in 2 of 1e9 channels
_LIMIT = 0.95  # of the largest reading of all: a channel that is always there is saturated
_RESPONDING = 0.05  # of the press's strongest reading: sensors that count
_LOADED = 0.2  # of a press's peak: frames in which its force is estimated
_CLIPPED = 0.95  # of the limit: a reading above may be cut off
_TOO_FAR = 0.25  # error of a held-out force; positions off by 2 mm cause less
_NEAR = 0.2  # of the strongest press's reading: presses that show the shape of a response
_WEAK = 0.05  # of the median gain: such a channel has 20 times the noise of others
_GAUGES, _LIKE = {"kg": 9.80665, "g": 0.00980665}, 1.5  # N; factor within which a unit explains
_UNITS = {"gain": "", "hysteresis": "of peak", "time_constant": "s", "drift": "N/s"}


@dataclass
class _Channel:
    """Constants of one channel, in the session's unit; gain per N; None if unknown.

    ``noise`` is that of linear changes, where the response is a curve.
    """

    idle: Idle
    quantum: float
    time_constant: float = 0.0
    gain: float | None = None
    error: float = 0.0
    clip: float | None = None
    hysteresis: float | None = None
    broken: str | None = None
    polarity: float = 1.0
    shape: Shape = field(default_factory=Shape)
    noise: float | None = None


def fit_calibration(bench: BenchData, presses: Collection[int] | None = None) -> Calibration:
    """Fit every channel to the simulated true readings of presses, never to the gauge's force.

    Idle frames give offset, drift and noise; the release the time constant; the loading branch the gain and
    the clip; the unloading branch hysteresis. All but the idle frames are taken from ``presses``. A channel
    is dead if it never leaves its noise in the whole session, though its sensor was pressed. A channel whose
    values fall with force has polarity -1.

    Args:
        bench: the session.
        presses: numbers of the presses to use; None: all.

    Raises:
        InputError: no channel responds to a press.
    """
    used = bench.frames_of(range(len(bench.gauge)) if presses is None else presses)
    channels = [_measure_rest(bench, number) for number in range(bench.each.shape[1])]
    _mark_silent(bench, channels)
    driven = np.where(used[:, None], bench.true, 0.0)
    pressed = driven.max(axis=0) >= _PRESSED * driven.max()
    answering = [int(n) for n in np.flatnonzero(pressed) if channels[n].broken is None]
    measured = np.stack(
        [_subtract_rest(bench, number, channel) for number, channel in enumerate(channels)], 1
    )
    curves = _fit_shapes(bench, used, answering, channels, measured)
    linear = measured if curves is None else curves.straighten(measured)
    lagged, bends = _simulate_lag(
        bench.true, [channel.time_constant for channel in channels], bench.session.time
    )
    for number in answering:
        _fit_branches(bench, used, number, channels[number], linear, (lagged, bends), curves)
    gains = [gain for n in answering if (gain := channels[n].gain)]
    typical = float(np.median(gains)) if gains else 0.0
    if not gains:
        raise InputError(
            "no channel responds to a press below its limit: check layout, indenter, the forces and the "
            "session's clock"
        )
    return _convert_to_newton(bench, channels, 1.0 if bench.session.unit == "N" else 1 / typical, curves)


def _fit_shapes(
    bench: BenchData, used: np.ndarray, answering: list[int], channels: list[_Channel], measured: np.ndarray
) -> Curves | None:
    """Set time constants and shapes of channels; return the curves, in the session's unit, or None.

    The lag bends the response while the force rises, and a curve changes the decay after a release: each is
    fitted twice.
    """
    curves = None
    for _ in range(2):
        linear = measured if curves is None else curves.straighten(measured)
        for number in answering:
            channel = channels[number]
            floor = max(8 * channel.idle.noise, 3 * channel.quantum, 1e-9)
            if curves is not None:
                floor = float(curves.straighten(np.full(len(channels), floor))[number])
            channel.time_constant = _fit_time_constant(bench, used, linear[:, number], floor)
        lagged, _ = _simulate_lag(bench.true, [entry.time_constant for entry in channels], bench.session.time)
        for number in answering:
            channel, true = channels[number], lagged[:, number]
            near = bench.each[:, number] >= _NEAR * bench.each[:, number].max()
            rows = used & bench.loading & (true > 0) & np.isfinite(measured[:, number])
            rows &= near[bench.applied[1]]
            channel.shape = fit_shape(
                true[rows],
                measured[rows, number],
                bench.applied[1][rows],
                channel.idle.noise,
                channel.quantum,
            )
        previous, curves = curves, curves_of([channel.shape for channel in channels])
        if previous is None and curves is None:
            break
    return curves


def _measure_rest(bench: BenchData, number: int) -> _Channel:
    """Return the idle statistics of a channel; one that never changes is broken."""
    raw = bench.session.raw
    measured = raw[:, number]
    present = np.isfinite(measured)
    if not present.any():
        return _Channel(Idle(0.0, 0.0, 0.0), 0.0, broken="dead")
    if np.ptp(measured[present]) == 0:
        level = float(measured[present][0])
        full = 2**bench.session.bits - 1 if bench.session.bits else np.inf
        limit = level >= min(full, _LIMIT * float(np.nanmax(raw))) > 0
        kind = "dead" if level == 0 else "saturated" if limit else "stuck"
        return _Channel(Idle(level, 0.0, 0.0), 0.0, broken=kind)
    step = find_quantum(measured[present])
    quiet = present & bench.idle
    if quiet.sum() < 10:
        raise InputError(
            f"channel {number} has {quiet.sum()} idle frames: do not touch the skin for some seconds"
        )
    return _Channel(measure_idle(bench.session.time[quiet], measured[quiet], step), step)


def _mark_silent(bench: BenchData, channels: list[_Channel]) -> None:
    """Set the polarity of every channel; one that is silent in the whole session is dead."""
    responses = collect_responses(bench)
    polarity = find_polarity(responses, bench.each)
    pressed = bench.true.max(axis=0) >= _PRESSED * bench.true.max()
    for number, channel in enumerate(channels):
        channel.polarity = float(polarity[number])
        if channel.broken is None and pressed[number] and not responses.responding[number]:
            channel.broken = "dead"


def _subtract_rest(bench: BenchData, number: int, channel: _Channel) -> np.ndarray:
    """Return the change of a channel against its rest, (T,), in the session's unit, above 0 under force."""
    idle = channel.idle.offset + channel.idle.drift * bench.session.time
    return channel.polarity * (bench.session.raw[:, number] - idle)


def _fit_time_constant(bench: BenchData, used: np.ndarray, linear: np.ndarray, floor: float) -> float:
    """Return the weighted mean over releases of presses that reach a channel with linear changes (T,), s."""
    time = bench.session.time
    # Clipped readings contain no information on the lag.
    maximum = 0.8 * np.nanmax(linear)
    decays = []
    for release in bench.releases:
        if not used[release.start - 2] and not used[release.start - 1]:
            continue
        values = linear[release]
        start = int(np.argmax(values < maximum)) if len(values) and (values < maximum).any() else 0
        decays.append(fit_decay(time[release][start:], np.nan_to_num(values[start:]), floor))
    weight = sum(fraction for _, fraction in decays)
    return sum(value * fraction for value, fraction in decays) / weight if weight else 0.0


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


def _simulate_lag(
    true: np.ndarray, constants: list[float], time: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return lagged true readings, and the effect of a hysteresis of 1 on them, each (T, S), N."""
    force = torch.from_numpy(true)[None]
    peak = running_peak(force)
    bend = torch.where(peak > 0, 6 * force * (1 - force.abs() / peak.clamp(min=1e-30)), 0.0)
    both = first_order_lag(
        torch.cat([force, bend], -1), torch.tensor(constants).double().repeat(2), torch.from_numpy(time)
    )[0].numpy()
    return both[:, : true.shape[1]], both[:, true.shape[1] :]


def _fit_branches(
    bench: BenchData,
    used: np.ndarray,
    number: int,
    channel: _Channel,
    linear: np.ndarray,
    simulated: tuple[np.ndarray, np.ndarray],
    curves: Curves | None,
) -> None:
    """Fit gain and clip on the loading branch, hysteresis on the unloading one, of linear changes (T, S)."""
    measured, lagged, bend = (values[:, number] for values in (linear, *simulated))
    true = np.where(used, bench.true[:, number], 0.0)
    # In a solid, every press reaches every sensor a little; such readings are noise.
    pressed = np.isfinite(measured) & (true > _PRESSED * true.max())
    up = pressed & bench.loading & (lagged > 0)
    if up.sum() < 10:
        return
    noise = channel.idle.noise
    if channel.shape.kind != "linear":  # the curve has another slope at rest than under load
        noise = _MAD / math.sqrt(2) * float(np.median(np.abs(np.diff(measured[up]))))
        loaded = np.diff(measured[up], 2)  # twice: the rising force is no noise
        rest = np.diff(measured[bench.idle & np.isfinite(measured)], 2)
        channel.noise = _MAD / math.sqrt(6) * max(float(np.median(np.abs(part))) for part in (loaded, rest))
    gain, channel.error, plateau = fit_clip_and_gain(lagged[up], measured[up], noise)
    channel.clip = plateau
    if plateau is not None and curves is not None:
        channel.clip = float(curves.bend(np.full(linear.shape[1], plateau))[number])
    if np.isnan(gain):  # every reading is at the limit
        return
    # A slope within its error may be noise.
    channel.gain = gain if gain > _SURE * channel.error else None
    limit = np.inf if plateau is None else 0.9 * plateau
    # A gap no larger than the noise is not used.
    down = pressed & bench.unloading & (measured < limit) & (bend > 0.05 * lagged.max())
    if down.sum() < 10 or not channel.gain:
        return
    bent, lever = measured[down] - gain * lagged[down], gain * bend[down]
    keep = np.abs(bent - np.median(bent)) <= 6 * np.median(np.abs(bent - np.median(bent)))
    fraction = float((bent[keep] * lever[keep]).sum() / (lever[keep] ** 2).sum())
    error = float(np.std(bent[keep] - fraction * lever[keep]) / np.sqrt((lever[keep] ** 2).sum()))
    channel.hysteresis = fraction if fraction > 2 * error else 0.0


def _convert_to_newton(
    bench: BenchData, channels: list[_Channel], scale: float, curves: Curves | None
) -> Calibration:
    """Convert channels to N, and compute ranges over the working ones."""
    alive = [channel.broken is None for channel in channels]
    # Counts have an unknown zero, common to all channels; readings in N do not.
    counts = [channel.idle.offset for channel, live in zip(channels, alive, strict=True) if live]
    zero = 0.0 if bench.session.unit == "N" else float(np.median(counts))
    slopes = np.ones(len(channels)) if curves is None else curves.slopes
    noises = zip(channels, slopes.tolist(), strict=True)
    in_newton: dict[str, list[float | None]] = {
        "offset": [channel.polarity * (channel.idle.offset - zero) for channel in channels],
        "noise": [
            entry.idle.noise if entry.noise is None else entry.noise * slope for entry, slope in noises
        ],
        "drift": [channel.polarity * channel.idle.drift for channel in channels],
        "quantum": [channel.quantum for channel in channels],
        "clip": [channel.clip for channel in channels],
        "gain": [channel.gain for channel in channels],
    }
    sensors: dict[str, list[float | None]] = {
        name: [_round(value, scale) for value in values] for name, values in in_newton.items()
    }
    sensors["hysteresis"] = [_round(channel.hysteresis) for channel in channels]
    sensors["time_constant"] = [
        _round(channel.time_constant if channel.gain else None) for channel in channels
    ]
    if curves is not None:
        fitted = [channel.gain is not None for channel in channels]
        sensors["exponent"] = [
            _round(float(value)) if live else None
            for value, live in zip(curves.exponent, fitted, strict=True)
        ]
    for name in sensors.keys() & {"gain", "clip", "hysteresis", "time_constant", "exponent"}:
        sensors[name] = [value if live else None for value, live in zip(sensors[name], alive, strict=True)]
    broken = {
        kind: [n for n, channel in enumerate(channels) if channel.broken == kind]
        for kind in ("dead", "stuck", "saturated")
    }
    ranges: dict[str, list[float]] = {"dead": [0, alive.count(False)]}
    for name, values in sensors.items():
        working = [value for value, live in zip(values, alive, strict=True) if live and value is not None]
        ranges |= {name: [min(working), max(working)]} if working else {}
    error = 2 * scale * float(np.median([channel.error for channel in channels if channel.gain]))
    ranges["gain"] = [max(ranges["gain"][0] - error, 0.0), ranges["gain"][1] + error]
    about: dict[str, Any] = {
        "unit": bench.session.unit,
        "presses": len(bench.gauge),
        "frames": len(bench.session.time),
    }
    polarity = [int(channel.polarity) for channel in channels]
    signs = polarity if min(polarity) < 0 else ()
    calibration = Calibration(sensors, broken, ranges, scale, zero, about, polarity=signs)
    if curves is None:
        return calibration
    about["responses"] = describe_shapes([channel.shape for channel in channels])
    tables = {n: (scale * np.array(table)).tolist() for n, table in curves.tables.items()}
    return replace(calibration, about=about, exponent_at=float(curves.at[0]) * scale, tables=tables)


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
