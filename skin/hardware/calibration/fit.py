"""Fit the constants of a simulated device to a bench session."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch

from skin.errors import InputError
from skin.hardware.calibration import _channel
from skin.hardware.calibration.channels import Idle, collect_responses, find_polarity
from skin.hardware.calibration.presses import BenchData
from skin.sensor_dynamics import first_order_lag, running_peak
from skin.signal.calibration import Calibration

_PRESSED = 0.05  # of the largest true reading: less determines no gain
_SURE = 6.0  # standard errors above 0: less is no answer either
_LIMIT = 0.95  # of the largest reading of all: a channel that is always there is saturated


@dataclass
class _Channel:
    """Constants of one channel, in the session's unit; gain per N; None if unknown."""

    idle: Idle
    quantum: float
    time_constant: float = 0.0
    gain: float | None = None
    error: float = 0.0
    clip: float | None = None
    hysteresis: float | None = None
    broken: str | None = None
    polarity: float = 1.0


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
    used = bench.of(range(len(bench.gauge)) if presses is None else presses)
    channels = [_at_rest(bench, number) for number in range(bench.each.shape[1])]
    _respond(bench, channels)
    driven = np.where(used[:, None], bench.true, 0.0)
    pressed = driven.max(axis=0) >= _PRESSED * driven.max()
    answering = [int(n) for n in np.flatnonzero(pressed) if channels[n].broken is None]
    for number in answering:
        channels[number].time_constant = _time_constant(bench, used, number, channels[number])
    lagged, bends = _regressors(
        bench.true, [channel.time_constant for channel in channels], bench.session.time
    )
    for number in answering:
        _answer(bench, used, number, channels[number], lagged[:, number], bends[:, number])
    gains = [gain for n in answering if (gain := channels[n].gain)]
    typical = float(np.median(gains)) if gains else 0.0
    if not gains:
        raise InputError(
            "no channel responds to a press below its limit: check layout, indenter, the forces and the "
            "session's clock"
        )
    return _calibration(bench, channels, 1.0 if bench.session.unit == "N" else 1 / typical)


def _at_rest(bench: BenchData, number: int) -> _Channel:
    """Return the idle statistics of a channel; one that never changes is broken."""
    raw = bench.session.raw
    measured = raw[:, number]
    there = np.isfinite(measured)
    if not there.any():
        return _Channel(Idle(0.0, 0.0, 0.0), 0.0, broken="dead")
    if np.ptp(measured[there]) == 0:
        level = float(measured[there][0])
        full = 2**bench.session.bits - 1 if bench.session.bits else np.inf
        limit = level >= min(full, _LIMIT * float(np.nanmax(raw))) > 0
        kind = "dead" if level == 0 else "saturated" if limit else "stuck"
        return _Channel(Idle(level, 0.0, 0.0), 0.0, broken=kind)
    step = _channel.quantum(measured[there])
    quiet = there & bench.idle
    if quiet.sum() < 10:
        raise InputError(
            f"channel {number} has {quiet.sum()} idle frames: do not touch the skin for some seconds"
        )
    return _Channel(_channel.idle(bench.session.time[quiet], measured[quiet], step), step)


def _respond(bench: BenchData, channels: list[_Channel]) -> None:
    """Set the polarity of every channel; one that is silent in the whole session is dead."""
    responses = collect_responses(bench)
    polarity = find_polarity(responses, bench.each)
    pressed = bench.true.max(axis=0) >= _PRESSED * bench.true.max()
    for number, channel in enumerate(channels):
        channel.polarity = float(polarity[number])
        if channel.broken is None and pressed[number] and not responses.responding[number]:
            channel.broken = "dead"


def _rest_taken(bench: BenchData, number: int, channel: _Channel) -> np.ndarray:
    """Return the change of a channel against its rest, (T,), in the session's unit, above 0 under force."""
    rest = channel.idle.offset + channel.idle.drift * bench.session.time
    return channel.polarity * (bench.session.raw[:, number] - rest)


def _time_constant(bench: BenchData, used: np.ndarray, number: int, channel: _Channel) -> float:
    """Return the weighted mean over releases of presses that reach the channel, s."""
    measured, time = _rest_taken(bench, number, channel), bench.session.time
    # Clipped readings contain no information on the lag.
    most = 0.8 * np.nanmax(measured)
    found = []
    for release in bench.releases:
        if not used[release.start - 2] and not used[release.start - 1]:
            continue
        values = measured[release]
        start = int(np.argmax(values < most)) if len(values) and (values < most).any() else 0
        floor = max(8 * channel.idle.noise, 3 * channel.quantum, 1e-9)
        found.append(_channel.decay(time[release][start:], np.nan_to_num(values[start:]), floor))
    weight = sum(one for _, one in found)
    return sum(value * one for value, one in found) / weight if weight else 0.0


def _regressors(true: np.ndarray, constants: list[float], time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lagged true readings, and the effect of a hysteresis of 1 on them, each (T, S), N."""
    force = torch.from_numpy(true)[None]
    peak = running_peak(force)
    bend = torch.where(peak > 0, 6 * force * (1 - force.abs() / peak.clamp(min=1e-30)), 0.0)
    both = first_order_lag(
        torch.cat([force, bend], -1), torch.tensor(constants).double().repeat(2), torch.from_numpy(time)
    )[0].numpy()
    return both[:, : true.shape[1]], both[:, true.shape[1] :]


def _answer(
    bench: BenchData, used: np.ndarray, number: int, channel: _Channel, lagged: np.ndarray, bend: np.ndarray
) -> None:
    """Fit gain and clip on the loading branch, hysteresis on the unloading branch."""
    measured = _rest_taken(bench, number, channel)
    true = np.where(used, bench.true[:, number], 0.0)
    # In a solid, every press reaches every sensor a little; such readings are noise.
    there = np.isfinite(measured) & (true > _PRESSED * true.max())
    up = there & bench.loading & (lagged > 0)
    if up.sum() < 10:
        return
    gain, channel.error, channel.clip = _channel.clip_and_gain(lagged[up], measured[up], channel.idle.noise)
    if np.isnan(gain):  # every reading is at the limit
        return
    # A slope within its error may be noise.
    channel.gain = gain if gain > _SURE * channel.error else None
    limit = np.inf if channel.clip is None else 0.9 * channel.clip
    # A gap no larger than the noise is not used.
    down = there & bench.unloading & (measured < limit) & (bend > 0.05 * lagged.max())
    if down.sum() < 10 or not channel.gain:
        return
    rest, lever = measured[down] - gain * lagged[down], gain * bend[down]
    keep = np.abs(rest - np.median(rest)) <= 6 * np.median(np.abs(rest - np.median(rest)))
    share = float((rest[keep] * lever[keep]).sum() / (lever[keep] ** 2).sum())
    error = float(np.std(rest[keep] - share * lever[keep]) / np.sqrt((lever[keep] ** 2).sum()))
    channel.hysteresis = share if share > 2 * error else 0.0


def _calibration(bench: BenchData, channels: list[_Channel], scale: float) -> Calibration:
    """Convert channels to N, and compute ranges over the working ones."""
    alive = [channel.broken is None for channel in channels]
    # Counts have an unknown zero, common to all channels; readings in N do not.
    counts = [channel.idle.offset for channel, live in zip(channels, alive, strict=True) if live]
    zero = 0.0 if bench.session.unit == "N" else float(np.median(counts))
    in_newton: dict[str, list[float | None]] = {
        "offset": [channel.polarity * (channel.idle.offset - zero) for channel in channels],
        "noise": [channel.idle.noise for channel in channels],
        "drift": [channel.polarity * channel.idle.drift for channel in channels],
        "quantum": [channel.quantum for channel in channels],
        "clip": [channel.clip for channel in channels],
        "gain": [channel.gain for channel in channels],
    }
    sensors: dict[str, list[float | None]] = {
        name: [_six(value, scale) for value in values] for name, values in in_newton.items()
    }
    sensors["hysteresis"] = [_six(channel.hysteresis) for channel in channels]
    sensors["time_constant"] = [_six(channel.time_constant if channel.gain else None) for channel in channels]
    for name in ("gain", "clip", "hysteresis", "time_constant"):
        sensors[name] = [one if live else None for one, live in zip(sensors[name], alive, strict=True)]
    broken = {
        kind: [n for n, channel in enumerate(channels) if channel.broken == kind]
        for kind in ("dead", "stuck", "saturated")
    }
    ranges = _ranges(sensors, alive)
    error = 2 * scale * float(np.median([channel.error for channel in channels if channel.gain]))
    ranges["gain"] = [max(ranges["gain"][0] - error, 0.0), ranges["gain"][1] + error]
    about = {"unit": bench.session.unit, "presses": len(bench.gauge), "frames": len(bench.session.time)}
    polarity = [int(channel.polarity) for channel in channels]
    known = polarity if min(polarity) < 0 else ()
    return Calibration(sensors, broken, ranges, scale, zero, about, polarity=known)


def _six(value: float | None, scale: float = 1.0) -> float | None:
    return None if value is None else float(f"{value * scale:.6g}") + 0.0  # no negative 0


def _ranges(sensors: dict[str, list[float | None]], alive: list[bool]) -> dict[str, list[float]]:
    """Return the least and the largest of every quantity among sensors that live, and how many do not."""
    ranges: dict[str, list[float]] = {"dead": [0, alive.count(False)]}
    for name, values in sensors.items():
        known = [one for one, live in zip(values, alive, strict=True) if live and one is not None]
        ranges |= {name: [min(known), max(known)]} if known else {}
    return ranges
