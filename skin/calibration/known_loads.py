"""Calibrate without a gauge: by a weight on a round base on every sensor.

The gain of a channel is its reading over the simulated one. A wide base hardly cares where the sensor lies
below it.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
import pandas as pd
import torch
from pydantic import PositiveFloat

from skin.body.base import AbstractBody, Sensors
from skin.calibration.bench import (
    BenchSession,
    Gauge,
    check_channels,
    per_newton,
    true_readings,
    write_bench_session,
)
from skin.calibration.fit import convert_to_newton
from skin.calibration.wiring import MAD, find_quantum, list_numbers, measure_rests
from skin.core.settings import configured
from skin.device.calibration import Calibration
from skin.device.resampling import Frame, StreamClock
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.wire.channels import UnitConversion
from skin.wire.emulator import Converter

GRAVITY = 9.80665  # m/s2
_HEAVIEST = 50.0  # kg: nobody puts more on a skin by hand
_SPREAD = 0.35  # of gains and model together, in assigning placements to sensors
_FLOOR = 0.03  # of the largest reading: what a model leaves beside a base
_QUIETER = 200.0  # times that the noise of sensors may be below that of the simulated device
_MISSED = 0.25  # fraction of the sensors that may have no gain
_PATIENCE = 60.0  # s in which a further load must be put down


# Steady loads in a session without a gauge: a weight put down and lifted again.


_BLOCK = 0.2  # s, whose median is one value
_REST = 5  # blocks without a load before the first one
_LOADED = 6.0  # standard deviations of a block: no noise of 100 channels and ten minutes reaches it
_STEPS = 2.0  # steps of the converter, likewise
_LIFTED = 0.15  # of the largest change of a load: below, it is lifted, and the skin recovers
_SETTLE = 2  # blocks after a load is lifted that are not used
_AFTER = 4  # blocks after it for the rest; fewer before the next load
_SHORTEST = 1.0  # s of a load: less is a touch
_STEADY = 0.4, 0.9  # part of a load that is used: a hand no longer guides it, and has not come back
_UNSTEADY = 0.2  # of the largest change: a load that changes more was touched or slid


@dataclass(frozen=True)
class Placements:
    """Steady loads of a session.

    Attributes:
        change: (P, S), against the rest before and after the load, in the session's unit.
        begin, end: (P,), s.
        idle: (T,), bool: frames without a load.
        noise: (S,), standard deviation of ``change``.
        unsteady: number of loads that were left out because they changed.
        reached: (S,), bool: the channel leaves its noise in at least one load.
    """

    change: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    idle: np.ndarray
    noise: np.ndarray
    unsteady: int
    reached: np.ndarray


def find_placements(session: BenchSession) -> Placements:
    """Return the loads of a session, in order of time.

    A load begins where a channel leaves its noise, and ends where all have lost most of their change. The
    first second must be without a load. There may be no load, or one that still lies at the end.
    """
    time, raw = session.time, session.raw
    block = np.floor((time - time[0]) / _BLOCK).astype(int)
    _, first = np.unique(block, return_index=True)
    medians = pd.DataFrame(raw).groupby(block).median()
    # Of a block without a value, what is between those before and after it; 0 of a channel without any.
    values = medians.interpolate(limit_direction="both").fillna(0.0).to_numpy()
    steps = np.array([find_quantum(column[np.isfinite(column)]) for column in raw.T])
    noise = MAD / np.sqrt(2) * np.median(np.abs(np.diff(values, axis=0)), axis=0)
    noise = np.maximum(noise, steps / np.sqrt(12))
    spans, rests = _find_loads(values, np.maximum(_LOADED * noise, _STEPS * steps))
    starts = time[first]
    idle = np.ones(len(time), dtype=bool)
    rows, times, unsteady = [], [], 0
    for (begin, end), (before, after) in zip(spans, rests, strict=True):
        margin = slice(first[max(begin - 1, 0)], first[end + _SETTLE] if end + _SETTLE < len(first) else None)
        idle[margin] = False
        if starts[end - 1] - starts[begin] < _SHORTEST:
            continue
        low, high = (begin + round(fraction * (end - begin)) for fraction in _STEADY)
        steady = values[low : max(high, low + 3)] - (before + after) / 2
        change = np.median(steady, axis=0)
        if (np.ptp(steady, axis=0) > _UNSTEADY * np.abs(change).max() + _LOADED * noise).any():
            unsteady += 1
            continue
        rows.append(change)
        times.append((starts[begin], starts[end - 1]))
    moments = np.array(times).reshape(-1, 2)
    change = np.array(rows).reshape(-1, len(noise))
    few = noise * np.sqrt(1 / 5 + 1 / (2 * _AFTER))
    reached = (np.abs(change) > np.maximum(_LOADED * few, _STEPS * steps)).any(axis=0)
    return Placements(change, moments[:, 0], moments[:, 1], idle, few, unsteady, reached)


def _find_loads(
    values: np.ndarray, limits: np.ndarray
) -> tuple[list[tuple[int, int]], list[tuple[np.ndarray, np.ndarray]]]:
    """Return first and last block of every load, and the rests (S,) before and after it."""
    spans, rests = list[tuple[int, int]](), list[tuple[np.ndarray, np.ndarray]]()
    count = len(values)
    number = min(_REST, count)
    rest = np.median(values[:number], axis=0)
    while number < count:
        if not (np.abs(values[number] - rest) > limits).any():
            rest = rest + 0.2 * (values[number] - rest)
            number += 1
            continue
        begin, peak = number, np.zeros(len(limits))
        while number < count:
            change = np.abs(values[number] - rest)
            peak = np.maximum(peak, change)
            if not (change > np.maximum(limits, _LIFTED * peak.max())).any():
                break
            number += 1
        after = rest
        if number < count:
            quiet = values[number + _SETTLE : number + _SETTLE + _AFTER]
            calm = quiet[(np.abs(quiet - rest) <= np.maximum(limits, _LIFTED * peak.max())).all(axis=1)]
            after = np.median(calm, axis=0) if len(calm) else rest
        spans.append((begin, number))
        rests.append((rest, after))
        rest, number = after, number + _SETTLE
    return spans, rests


@dataclass(frozen=True)
class KnownLoad:
    """What is put on the skin.

    Attributes:
        weight: kg.
        base: radius of the weight's round base, m.
    """

    weight: float
    base: float

    @classmethod
    def of(cls, weight: float | None, base: float | None, size: tuple[float, float]) -> "KnownLoad":
        """Return a load that a skin of this size, m, can carry.

        Raises:
            InputError: no mass or no base, or one that is too large or not above 0.
        """
        if weight is None or base is None:
            raise InputError(
                "a known load is a mass in kg on a round base of a radius in m: give weight=2.0 base=0.02"
            )
        if not 0 < weight <= _HEAVIEST:
            in_grams = f"; for {weight:g} g give weight={weight / 1000:g}" * (weight >= 100)
            raise InputError(f"weight={weight:g} is a mass in kg above 0 and up to {_HEAVIEST:g}{in_grams}")
        widest = min(size) / 2
        if not 0 < base <= widest:
            in_mm = f"; for {base:g} mm give base={base / 1000:g}" * (base >= 1)
            raise InputError(
                f"base={base:g} is a radius in m above 0 that fits on the skin of {size[0]:g} x "
                f"{size[1]:g} m, so at most {widest:g}{in_mm}"
            )
        return cls(weight, base)

    @property
    def force(self) -> float:
        """N."""
        return GRAVITY * self.weight


@dataclass(frozen=True)
class LoadResult:
    """A calibration by known loads, and how well it is determined.

    Attributes:
        calibration: of the skin.
        placements: number of placements of every sensor, (S,).
        differ: median difference between placements of the same sensor, fraction; NaN where every sensor has
            one.
        never: sensors that were never loaded: their gain is the median.
    """

    calibration: Calibration
    placements: np.ndarray
    differ: float
    never: list[int]


def fit_known_load(device: Simulated, session: BenchSession, load: KnownLoad) -> LoadResult:
    """Fit offsets and noise to idle frames, and gains to placements of a load.

    Args:
        device: with the skin as designed.
        session: idle, and placements in any order, with the skin untouched between them.
        load: what was put on it.

    Raises:
        InputError: another number of channels, no placement, or sensors without one.
    """
    check_channels(device, session)
    placements = find_placements(session)
    if not len(placements.change):
        touched = f" ({placements.unsteady} changed while they lay, or were touched)"
        raise InputError(
            f"no placement in the session{touched * bool(placements.unsteady)}: leave the skin untouched for "
            "3 s, put the load down, let go of it for 2 s, lift it for 2 s, and so on"
        )
    gains, counts, differ = _fit_weight(device, placements, load)
    return _build(session, placements, load, gains, counts, differ, float(device.constants.noise.median()))


def base_readings(model: AbstractSimulator, body: AbstractBody, sensors: Sensors, base: float) -> np.ndarray:
    """Return the readings (S, S), N, under 1 N on a round base over each sensor.

    Near the rim the base is as far inside as it needs to be to lie on the skin.
    """
    positions = np.clip(sensors.positions[:, :2], base, np.array(body.size) - base)
    count = len(positions)
    zeros, names = np.zeros(count), np.full(count, "disc")
    presses = np.arange(count)
    rows = Gauge(presses.astype(float), zeros + 1, positions, zeros + base, zeros, names, presses)
    return per_newton(model, body, rows)


def _fit_weight(
    device: Simulated, placements: Placements, load: KnownLoad
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return gains (S,), in the session's unit per N, NaN if unknown; placements (S,); their difference."""
    expected = load.force * base_readings(device.model, device.body, device.sensors, load.base)
    sensor = _assign(expected, placements)
    gains, counts = np.full(len(expected), np.nan), np.bincount(sensor, minlength=len(expected))
    differences = []
    for number in np.flatnonzero((counts > 0) & placements.reached):
        ratios = placements.change[sensor == number, number] / expected[number, number]
        gains[number] = np.median(ratios) if len(ratios) > 2 else ratios.mean()
        if len(ratios) > 1:
            differences.append(np.abs(ratios / gains[number] - 1).mean() * 2)
    return gains, counts, float(np.median(differences)) if differences else math.nan


def _assign(expected: np.ndarray, placements: Placements) -> np.ndarray:
    """Return the sensor (P,) below each placement: that whose pattern of readings is the most likely.

    Gains are unknown, so a reading is its expectation within a third. A dead sensor is found by the readings
    of its neighbours.
    """
    size = np.abs(placements.change)
    typical = float(np.median(size.max(axis=1)) / np.median(np.diagonal(expected)))
    measured = placements.change[:, None, :] * np.sign(_sign(placements)) / typical
    noise = placements.noise / typical
    variance = (_SPREAD * expected) ** 2 + noise**2 + (_FLOOR * expected.max()) ** 2
    cost = (measured - expected) ** 2 / variance + np.log(variance)
    return np.asarray(cost[..., placements.reached].sum(axis=-1).argmin(axis=1))


def _sign(placements: Placements) -> np.ndarray:
    """Return 1 or -1 per channel, (S,): whether it rises under load; as most others, if it is silent."""
    strongest = np.abs(placements.change).argmax(axis=0)
    signs = np.sign(placements.change[strongest, np.arange(placements.change.shape[1])])
    maximum = -1.0 if signs[placements.reached].sum() < 0 else 1.0
    return np.where(placements.reached & (signs != 0), signs, maximum)


def _build(
    session: BenchSession,
    placements: Placements,
    load: KnownLoad,
    gains: np.ndarray,
    counts: np.ndarray,
    differ: float,
    usual: float,
) -> LoadResult:
    """Return the calibration of gains (S,), in the session's unit per N, NaN if unknown.

    A load in another unit makes the noise, N, that of no sensor; ``usual`` is that of the simulated device.
    """
    signs = _sign(placements)
    dead = [int(n) for n in np.flatnonzero(~placements.reached)]
    never = [int(n) for n in np.flatnonzero(placements.reached & ~(gains * signs > 0))]
    if len(dead) + len(never) > _MISSED * len(gains):
        raise InputError(
            f"sensors {list_numbers(sorted(dead + never))} were never loaded, or do not respond: put the "
            "load on every sensor and record again, or check the wiring"
        )
    # Slow drift is left to the tare: placements move the rest a little, too.
    rests = measure_rests(
        replace(session, time=session.time - session.time[placements.idle].mean()), placements.idle
    )
    absolute = np.where(np.isfinite(gains), gains * signs, np.nan)
    typical = float(np.nanmedian(absolute))
    quiet = float(np.median(np.maximum(rests["noise"], rests["quantum"] / math.sqrt(12)))) / typical
    if quiet < usual / _QUIETER:
        raise InputError(
            f"weight={load.weight:g} (kg) would mean a noise of {quiet:.2g} N, device.noise is {usual:g}: "
            "give the load in this unit, or device.noise= if the sensors are so quiet"
        )
    metadata = {"placements": len(placements.change), "weight": load.weight, "base": load.base}
    values = rests.drop(columns="drift").assign(gain=absolute)
    calibration = convert_to_newton(session, values, signs, {"dead": dead}, metadata)
    return LoadResult(calibration, counts, differ, never)


def print_known_load(result: LoadResult) -> None:
    """Print gains, placements, and the sensors without a gain."""
    calibration = result.calibration
    gains = [gain for gain in calibration.sensors["gain"] if gain is not None]
    print(
        f"{calibration.about['placements']} placements, {len(gains)} of {len(calibration)} sensors have a "
        f"gain: median {np.median(gains):.4g}, {min(gains):.4g} to {max(gains):.4g}"
    )
    if math.isfinite(result.differ):
        print(f"placements of the same sensor differ by {result.differ:.1%} (median)")
    if dead := calibration.broken["dead"]:
        print(f"dead, or never loaded: sensors {list_numbers(dead)} (from 0) never left their noise")
    if result.never:
        print(f"never loaded, so of median gain: sensors {list_numbers(result.never)}")
    if inverse := np.flatnonzero(calibration.signs < 0).tolist():
        print(f"inverse, values fall with force: sensors {list_numbers(inverse)}")


# A second load, measured while it is put on three sensors.


def measure_ratios(
    frames: Iterable[Frame],
    first: Sequence[Frame],
    conversion: UnitConversion,
    expected: np.ndarray,
    seconds: float,
    say: Callable[[str], None],
) -> dict[str, float]:
    """Return measured over predicted reading of three loaded sensors, or of all if there are fewer.

    Args:
        frames: of the skin, from now on.
        first: frames of the untouched skin before.
        conversion: of values to N.
        expected: readings (S, S), N, under the load on each sensor.
        seconds: for which each load must lie.
        say: called with each message for the user.

    Raises:
        InputError: no load lies so long, or its reading changes: the device may follow its own baseline.
    """
    clock, stream, ratios, enough = StreamClock(), iter(frames), dict[str, float](), min(3, len(expected))
    rate = (len(first) - 1) / np.ptp([clock(frame) for frame in first])
    rows = [conversion.newtons(frame.values) for frame in first]
    shapes = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    while further := [conversion.newtons(frame.values) for frame in islice(stream, math.ceil(rate))]:
        rows += further
        time = np.arange(len(rows)) / rate
        found = find_placements(BenchSession(time, np.array(rows), "N"))
        lying = time[-1] - time[found.idle][-1]
        # A load that has just been put down may still change.
        if found.unsteady and not 0 < lying < 2 * seconds:
            raise InputError(
                "readings changed while a load lay: the device seems to follow its own baseline, so that a "
                "long press disappears: switch that off in its firmware; or the load moved: check again"
            )
        counted = found.end - found.begin >= seconds
        for change in found.change[counted]:
            # The pattern identifies the sensor for any scale and sign.
            sensor = int(np.abs(shapes @ change).argmax())
            if str(sensor) not in ratios:
                say(
                    f"sensor {sensor}: {change[sensor]:.3g} N, predicted {expected[sensor, sensor]:.3g} N; "
                    f"{len(ratios) + 1} of {enough}, lift it"
                )
            ratios[str(sensor)] = float(change[sensor] / expected[sensor, sensor])
        if len(ratios) >= enough and lying == 0:
            return ratios
        if time[-1] - found.begin[counted].max(initial=0.0) > _PATIENCE + seconds:
            break
    raise InputError(
        f"no further load lay for {seconds:g} s within {_PATIENCE:g} s: give a heavier one, as in weight=1, "
        "or let the device keep its baseline"
    )


# A simulated bench: the protocol of its presses, and the session of a device under them.


@dataclass(frozen=True)
class Protocol:
    """Idle time, then a staircase at each position: up, down, up to the peak, and a sudden release.

    The upward steps determine gains, the downward steps hysteresis, the release the lag, and idle time
    offset, noise and drift.

    Attributes:
        peak: largest force of every press, N.
        steps: fractions of the peak on the way up, and reversed on the way down.
        hold: at every step, s.
        ramp: from one step to the next, s; the release takes none.
        idle: before the first press, s.
        rest: after every press, s.
        indenter: name as in ``touch.shapes``.
        radius: half its larger extent, m.
        rate: of gauge and session, Hz.
    """

    peak: PositiveFloat = 120.0
    steps: Sequence[float] = (0.1, 0.2, 0.4, 0.7, 1.0)
    hold: PositiveFloat = 0.3
    ramp: PositiveFloat = 0.05
    idle: PositiveFloat = 3.0
    rest: PositiveFloat = 2.0
    indenter: str = "blurred_disc"
    radius: PositiveFloat = 0.01
    rate: PositiveFloat = 100.0

    def gauge(self, positions: np.ndarray) -> Gauge:
        """Return a gauge's rows for presses at positions (P, 2), m."""
        levels = [0.0, *self.steps, *list(self.steps)[-2::-1], self.steps[-1]]
        corners = np.cumsum([0.0, *[self.ramp, self.hold] * (len(levels) - 1)])
        heights = self.peak * np.repeat(levels, 2)[1:]
        inside = np.arange(0, corners[-1], 1 / self.rate)
        press = np.concatenate(
            [np.interp(inside, corners, heights), np.zeros(max(2, round(0.2 * self.rate)))]
        )
        pause, start = round(self.rest * self.rate), round(self.idle * self.rate)
        starts = start + np.arange(len(positions)) * (len(press) + pause)
        frame = (starts[:, None] + np.arange(len(press))).ravel()
        rows = len(frame)
        return Gauge(
            frame / self.rate,
            np.tile(press, len(positions)),
            np.repeat(positions, len(press), axis=0),
            np.full(rows, self.radius),
            np.zeros(rows),
            np.full(rows, self.indenter),
            np.repeat(np.arange(len(positions)), len(press)),
        )

    def positions(self, device: Simulated, generator: np.random.Generator) -> np.ndarray:
        """Return two positions per sensor, on it and up to 3 mm beside it, (2 S, 2), m, inside the sheet."""
        centre = device.sensors.positions[:, :2]
        beside = centre + generator.uniform(-0.003, 0.003, centre.shape)
        return np.clip(np.concatenate([centre, beside]), 0, device.size)


def emulate_session(
    device: Simulated,
    gauge: Gauge,
    protocol: Protocol,
    generator: np.random.Generator,
    bits: int | None = None,
) -> BenchSession:
    """Simulate a session of a device under the presses of a gauge, in N, or in counts of ``bits``."""
    frames = round((gauge.time[-1] + protocol.rest) * protocol.rate)
    time = np.arange(frames) / protocol.rate
    true = true_readings(gauge, per_newton(device.model, device.body, gauge), time)
    return sent_session(device, true, time, generator, bits, gauge)


def sent_session(
    device: Simulated,
    true: np.ndarray,
    time: np.ndarray,
    generator: np.random.Generator,
    bits: int | None,
    gauge: Gauge | None = None,
) -> BenchSession:
    """Return what a device sends of true readings (T, S), N, at times (T,), s: N, or counts of ``bits``."""
    measured = device.imperfection.raw(
        torch.from_numpy(true)[None].float(), device.constants, generator, torch.from_numpy(time).float()
    )[0].numpy() * device.imperfection.signs(true.shape[1])
    sent = Converter(bits, device.imperfection.clip)(measured)
    return BenchSession(time, sent, "N" if bits is None else "adc", gauge, bits)


def write_demo_session(device: Simulated, settings: Mapping[str, Any], path: str) -> str:
    """Write the simulated session of a device under the protocol; return a summary.

    Args:
        device: the simulated device.
        settings: ``conf/calibrate.yaml`` under ``calibrate``.
        path: .csv or .parquet.

    Raises:
        InputError: the protocol is invalid.
    """
    protocol = configured(Protocol, settings["protocol"], "calibrate.protocol")
    randomness = np.random.default_rng(device.seed)
    rows = protocol.gauge(protocol.positions(device, randomness))
    session = emulate_session(device, rows, protocol, randomness, settings["bits"])
    return f"{write_bench_session(session, path)}: {len(rows)} presses in {session.time[-1]:.0f} s"


# A session of an emulated skin under the load.


def emulate_placements(
    device: Simulated,
    readings: np.ndarray,
    protocol: Protocol,
    generator: np.random.Generator,
    bits: int | None = None,
) -> BenchSession:
    """Simulate placements of a load one after the other, 2 s each, with pauses of ``protocol.rest``.

    Args:
        device: the skin.
        readings: true readings of each placement, (P, S), N.
        protocol: its ``idle``, ``rest``, ``ramp`` and ``rate``.
        generator: of the noise.
        bits: of the converter; None: N are sent.
    """
    period = 2 * protocol.ramp + 2.0 + protocol.rest
    time = np.arange(round((protocol.idle + len(readings) * period) * protocol.rate)) / protocol.rate
    number = np.floor((time - protocol.idle) / period).astype(int)
    inside = (time - protocol.idle) % period
    corners = [0.0, protocol.ramp, protocol.ramp + 2.0, 2 * protocol.ramp + 2.0]
    fraction = np.where(number >= 0, np.interp(inside, corners, [0.0, 1.0, 1.0, 0.0]), 0.0)
    true = fraction[:, None] * readings[np.maximum(number, 0)]
    return sent_session(device, true, time, generator, bits)


def write_demo_placements(device: Simulated, load: KnownLoad, settings: Mapping[str, Any], path: str) -> str:
    """Write the simulated session of a load on every sensor twice, in any order; return a summary.

    Args:
        device: the skin.
        load: what is put on it.
        settings: ``conf/calibrate.yaml`` under ``calibrate``.
        path: .csv or .parquet.
    """
    protocol = configured(Protocol, settings["protocol"], "calibrate.protocol")
    randomness = np.random.default_rng(device.seed)
    order = np.concatenate([randomness.permutation(len(device.sensors)) for _ in range(2)])
    readings = load.force * base_readings(device.model, device.body, device.sensors, load.base)[order]
    session = emulate_placements(device, readings, protocol, randomness, settings["bits"])
    return f"{write_bench_session(session, path)}: {session.time[-1]:.0f} s"
