"""Calibrate without a gauge: by a weight on a round base on every sensor.

The gain of a channel is its reading over the simulated one. A wide base hardly cares where the sensor lies
below it.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pandas as pd
import torch

from skin.body.base import AbstractBody, Sensors
from skin.calibration.bench import (
    BenchSession,
    Gauge,
    check_channels,
    per_newton,
    warn_of_thickness,
    write_bench_session,
)
from skin.calibration.fit import convert_to_newton
from skin.calibration.wiring import MAD, find_quantum, list_numbers, measure_rests
from skin.device.calibration import Calibration
from skin.device.resampling import Frame, StreamClock
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.labels import Limits
from skin.touch.shapes import pressed_images
from skin.wire.channels import UnitConversion
from skin.wire.emulator import Converter

GRAVITY = 9.80665  # m/s2
_HEAVIEST = 50.0  # kg: nobody puts more on a skin by hand
_SPREAD, _FLOOR = 0.35, 0.03  # of gains and model together; of the largest reading, beside a base
_QUIETER = 200.0  # times that the noise of sensors may be below that of the simulated device
_INCLINED = "incline=20 downhill=[45,225] height=0.01"
_ALONG = 0.1  # of the reading inwards: cross-talk of a fiftieth would change less by a fifth
_MISSED = 0.25  # fraction of the sensors that may have no gain
_THUMB = 0.011  # m, radius of a press at the limit of dangerous touches
# Part of its reading that a second load must give: after 2 kg on 20 mm, a response that is a square root is
# then off by more than 25 % on skins of up to 25 mm.
_FIRM = 0.7
_PATIENCE = 60.0  # s in which a further load must be put down


# Steady loads in a session without a gauge: a weight put down and lifted again.


_BLOCK, _SHORTEST = 0.2, 1.0  # s, whose median is one value; of a load: less is a touch
_FIRST, _FOLLOW = 5, 0.2  # blocks of the first rest; part of a block by which the rest follows the skin
# Standard deviations of a block, steps of the converter: noise of 100 channels in ten minutes stays below.
_LOADED, _STEPS = 6.0, 2.0
_LIFTED = 0.15  # of the largest change of a channel: below, it is at rest, and the skin recovers
_SETTLE, _REST = 2, 4  # blocks after a load is lifted that are not used, and that are its rest
_STEADY = 0.4, 0.9  # part of a load that is used: a hand no longer guides it, and has not come back
_UNSTEADY = 0.2  # of the largest change: a load that changes more was touched or slid


@dataclass(frozen=True)
class Placements:
    """Steady loads of a session.

    Attributes:
        change: (P, S), against the rest before and after the load, in the session's unit.
        span: (P, 2), begin and end, s.
        idle: (T,), bool: frames without a load.
        noise: (S,), standard deviation of ``change``.
        unsteady: number of loads that were left out because they changed.
        reached: (S,), bool: the channel leaves its noise in at least one load.
        limited: (P, S), part of the time during which the channel was at its limit, or had no value.
    """

    change: np.ndarray
    span: np.ndarray
    idle: np.ndarray
    noise: np.ndarray
    unsteady: int
    reached: np.ndarray
    limited: np.ndarray


def find_placements(session: BenchSession) -> Placements:
    """Return the loads of a session, in order of time.

    A load begins where a channel leaves its noise, and ends where all have lost most of their change. The
    first second must be without a load. There may be no load, or one that still lies at the end.
    """
    blocks = np.floor((session.time - session.time[0]) / _BLOCK)
    _, first, block = np.unique(blocks, return_index=True, return_inverse=True)
    medians, starts = pd.DataFrame(session.raw).groupby(block).median(), session.time[first]
    # Of a block without a value, what is between those before and after it; 0 of a channel without any.
    values = medians.interpolate(limit_direction="both").fillna(0.0).to_numpy()
    steps = np.array([find_quantum(column[np.isfinite(column)]) for column in session.raw.T])
    noise = np.maximum(
        MAD / np.sqrt(2) * np.median(np.abs(np.diff(values, axis=0)), axis=0), steps / np.sqrt(12)
    )
    loaded = _find_loads(values, np.maximum(_LOADED * noise, _STEPS * steps))
    limited = pd.DataFrame(session.limited).groupby(block).mean().to_numpy()
    # From the block before a load to those in which the skin settles after it.
    resting = np.convolve(loaded, np.ones(2 + _SETTLE))[1:-_SETTLE] == 0
    rows, spans, unsteady = [], [], 0
    for _, load in pd.Series(np.flatnonzero(loaded)).groupby((~loaded).cumsum()[loaded]):
        begin, end = load.iloc[0], load.iloc[-1]
        if starts[end] - starts[begin] < _SHORTEST:
            continue
        low, high = (begin + round(fraction * (end + 1 - begin)) for fraction in _STEADY)
        steady = values[low : max(high, low + 3)]
        rests = values[:begin][resting[:begin]][-_REST:], values[end:][resting[end:]][:_REST]
        change = np.median(steady, axis=0) - (
            np.vstack(rests).mean(axis=0) if any(map(len, rests)) else np.nan
        )
        if not (np.ptp(steady, axis=0) <= _UNSTEADY * np.abs(change).max() + _LOADED * noise).all():
            unsteady += 1
            continue
        rows.append((change, limited[low:high].mean(axis=0)))
        spans.append((starts[begin], starts[end]))
    change, parts = np.array(rows).reshape(-1, 2, len(noise)).swapaxes(0, 1)
    error = noise * np.sqrt(1 / 5 + 1 / (2 * _REST))
    return Placements(
        change,
        np.array(spans).reshape(-1, 2),
        resting[block],
        error,
        unsteady,
        reached=(np.abs(change) > np.maximum(_LOADED * error, _STEPS * steps)).any(axis=0),
        limited=parts,
    )


def _find_loads(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return which blocks (N,) are under a load: they differ from the rest, which follows slow changes."""
    rest, loaded = np.median(values[:_FIRST], axis=0), np.zeros(len(values), dtype=bool)
    away = np.maximum(limits, _LIFTED * np.abs(values - rest).max(axis=0))
    for number, value in enumerate(values):
        loaded[number] = (np.abs(value - rest) > away).any()
        if not loaded[number]:
            rest = rest + _FOLLOW * (value - rest)
    return loaded


@dataclass(frozen=True)
class KnownLoad:
    """What is put on the skin.

    Attributes:
        weight: kg.
        base: radius of the weight's round base, m.
        incline: of the skin to the horizontal, degrees.
        downhill: directions of the chart that point downhill, one after the other, degrees from x towards y.
        height: of the weight's centre of gravity above its base, m.
    """

    weight: float
    base: float
    incline: float = 0.0
    downhill: Sequence[float] = ()
    height: float = 0.0

    @classmethod
    def of(
        cls,
        weight: float | None,
        base: float | None,
        size: tuple[float, float],
        incline: float | None = None,
        downhill: Sequence[float] | None = None,
        height: float | None = None,
    ) -> "KnownLoad":
        """Return a load that a skin of this size, m, can carry.

        Raises:
            InputError: no mass or no base, one that is too large or not above 0, an incline that is not
                completely described, or on which the load would tip.
        """
        if not (weight and base and 0 < weight <= _HEAVIEST and 0 < base <= min(size) / 2):
            raise InputError(
                f"weight={weight} base={base} is no known load: give a mass in kg, up to {_HEAVIEST:g}, and "
                f"the radius in m of its round base, which lies on the skin, up to {min(size) / 2:g}: as in "
                "weight=2.0 base=0.02"
            )
        if len({value is None for value in (incline, downhill, height)}) > 1:
            raise InputError(
                f"got incline={incline} downhill={downhill} height={height}: an incline needs its angle and "
                "directions downhill, degrees, and the height of the weight's centre of gravity, m, as in "
                f"{_INCLINED}"
            )
        # At this height, the pressure at the upper edge is 0.
        if incline and height and height * math.tan(math.radians(incline)) > base / 4:
            raise InputError(
                f"on incline={incline:g} a weight with its centre of gravity height={height:g} m above its "
                f"base={base:g} lifts its upper edge: take a flatter one, or incline it by up to "
                f"{math.degrees(math.atan(base / height / 4)):.1f} degrees"
            )
        return cls(weight, base, incline or 0.0, downhill or (), height or 0.0)


def fit_known_load(device: Simulated, session: BenchSession, load: KnownLoad) -> Calibration:
    """Fit offsets and noise to idle frames, and gains to placements of a load.

    Args:
        device: with the skin as designed.
        session: idle, and placements in any order, with the skin untouched between them; those of one
            direction downhill after those of another.
        load: what was put on it.

    Raises:
        InputError: another number of channels, placements missing or at a limit, or a load in another unit.
    """
    check_channels(device, session)
    placements = find_placements(session)
    if not len(placements.change):
        raise InputError(
            f"no placement in the session ({placements.unsteady} changed while they lay, or were touched): "
            "leave the skin untouched for 3 s, put down the load, let go for 2 s, lift it for 2 s, and so on"
        )
    expected = base_readings(device.model, device.body, device.sensors, load)
    gains, signs, loaded, site = _fit_gains(expected, placements)
    if len(missed := np.flatnonzero(np.isnan(gains) & loaded)) > _MISSED * loaded.sum():
        raise InputError(
            f"sensors {list_numbers(missed)} were never loaded, do not respond, or a load lay on the skin in "
            "the first second: put the load on every sensor and record again, or check the wiring"
        )
    # Slow drift is left to the tare: placements move the rest a little, too.
    centred = replace(session, time=session.time - session.time[placements.idle].mean())
    rests = measure_rests(centred, placements.idle).drop(columns="drift")
    quiet = float(np.hypot(rests["noise"], rests["quantum"] / math.sqrt(12)).median() / np.nanmedian(gains))
    usual = float(device.constants.noise.median())
    if quiet < usual / _QUIETER:  # a load in another unit makes the noise that of no sensor
        raise InputError(
            f"weight={load.weight:g} (kg) would mean a noise of {quiet:.2g} N, device.noise is {usual:g}: "
            "give the load in this unit, or device.noise= if the sensors are so quiet"
        )
    return convert_to_newton(
        session,
        rests.assign(gain=gains),
        signs,
        {"dead": missed.tolist()},  # a gain that nobody knows hides any force
        {"placements": len(placements.change)}
        | {name: part for name, part in vars(load).items() if part}
        | (
            {}
            if loaded.all()
            else {"along the surface": f"gains unknown, as inwards; {_INCLINED} gives them"}
        )
        | (
            {}
            if load.incline
            else warn_of_thickness(
                device,
                expected[0, site],
                signs * placements.change / gains,
                placements.noise / gains,
                lambda *skin: base_readings(device.simulator(*skin), skin[0], skin[1], load)[0, site],
            )
        ),
    )


@torch.no_grad()
def base_readings(
    model: AbstractSimulator, body: AbstractBody, sensors: Sensors, load: KnownLoad
) -> np.ndarray:
    """Return the readings under a load over each of N sites, for each direction downhill, (D, N, S), N.

    Near the rim the base is as far inside as it needs to be to lie on the skin. Friction holds the load: its
    traction is the pressure times the slope. The pressure increases linearly downhill, by the moment of the
    weight: that of a bar under an eccentric force.

    Raises:
        InputError: an incline that leaves a direction of sensors without load, without such sensors, or of a
            body that is not flat.
    """
    positions = np.clip(sensors.positions[:: sensors.axes, :2], load.base, np.array(body.size) - load.base)
    images = torch.cat(
        [*pressed_images(body, stair_gauge(positions, indenter="disc", radius=load.base).presses)]
    )
    x, y = (
        size * (torch.arange(count) + 0.5) - torch.from_numpy(places)[:, None]
        for size, count, places in zip(body.cell, body.cells, positions.T, strict=True)
    )
    angle, readings = math.radians(load.incline), []
    slope, force = math.tan(angle), math.cos(angle) * GRAVITY * load.weight  # N, inwards
    for down in torch.deg2rad(torch.tensor([*load.downhill] or [0.0])):
        below = down.cos() * x[:, None, :] + down.sin() * y[:, :, None]  # m, downhill of the middle
        pressure = force * images * (1 + 4 * load.height * slope / load.base**2 * below).float()
        friction = slope * torch.stack([down.cos(), down.sin()])[None] if slope else None
        readings.append(model(pressure, friction).readings.double().numpy())
    expected = np.stack(readings)
    if load.incline and not (body.flat and sensors.axes > 1 and _find_own(expected)[1].all()):
        raise InputError(
            "this incline does not load each axis along the surface, of layout.axes=three, by "
            f"{_ALONG:.0%} of the one inwards: give directions between the axes, as in {_INCLINED}, "
            "a steeper incline or a flatter weight; leave it out where sensors have one axis or "
            "the body is no flat sheet"
        )
    return expected


def _find_own(expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return readings at the loaded site itself, (D, N, axes), of all, (D, N, S); which count, (N, axes)."""
    own = np.einsum("dnna->dna", expected.reshape(*expected.shape[:2], expected.shape[1], -1))
    size = np.abs(own).min(axis=0)
    return own, size >= _ALONG * size[:, -1:]


def _fit_gains(
    expected: np.ndarray, placements: Placements
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return gains (NaN: none), signs and which the load determines, (S,), and the sites of the loads, (P,).

    A site is that whose pattern of readings is the most likely. Gains are unknown, so a reading is its
    expectation within a third. A dead sensor is found by the readings of its neighbours.

    Raises:
        InputError: readings at a limit, or placements whose direction downhill is unknown.
    """
    own, loaded = _find_own(expected)
    directions, sites, axes = own.shape
    strongest = placements.change[np.abs(placements.change).argmax(axis=0), np.arange(sites * axes)]
    inwards = np.arange(sites * axes) % axes == axes - 1
    used, signs = inwards & placements.reached, np.where(strongest < 0, -1.0, 1.0)
    signs[~used] = -1.0 if signs[used].sum() < 0 else 1.0  # as most others
    change, pattern = signs * placements.change, expected[0]
    typical = float(np.median(change[:, inwards].max(axis=1)) / np.median(pattern[:, inwards].max(axis=1)))
    variance = (_SPREAD * pattern) ** 2 + (placements.noise / typical) ** 2 + (_FLOOR * pattern.max()) ** 2
    cost = (change[:, None] / typical - pattern) ** 2 / variance + np.log(variance)
    site = cost[..., used].sum(axis=-1).argmin(axis=1)
    # Half of the values at the limit make their median the limit. Such a sensor may read so little that the
    # load seems to lie on another site.
    limited = (
        (placements.limited >= 0.5)
        & placements.reached
        & loaded.ravel()
        & (
            (site[:, None] == np.arange(sites * axes) // axes)
            | (inwards & (change > _FLOOR * typical * pattern.max()))
        )
    )
    if len(full := np.flatnonzero(limited.any(axis=0))):
        raise InputError(
            f"sensors {list_numbers(full)} (from 0) were at their limit, or sent no value, under the load: "
            "take a lighter weight and record again, or leave them out by "
            f"'calibrate.broken=[{','.join(map(str, full))}]'"
        )
    # All loads of one direction come before those of the next.
    direction = np.arange(len(site)) * directions // len(site)
    counts = np.array([np.bincount(site[direction == turn], minlength=sites) for turn in range(directions)])
    if (counts != counts[0]).any():
        raise InputError(
            f"the load lay {list_numbers(counts.sum(axis=0))} times on the sites 0 to {sites - 1} "
            f"({placements.unsteady} more changed): put it on each site equally often for each of the "
            f"{directions} directions downhill, one direction after the other, and record again"
        )
    ratios = pd.DataFrame(
        change.reshape(-1, sites, axes)[np.arange(len(site)), site]
        / np.where(loaded, own, np.nan)[direction, site]
    )
    # In two opposite directions, cross-talk of the force inwards and errors of the position cancel.
    medians = ratios.groupby([site, direction]).median().groupby(level=0)
    agreed = medians.mean().where(medians.min() * medians.max() > 0).reindex(range(sites)).to_numpy().ravel()
    gains = np.where(placements.reached & ((agreed > 0) | ~inwards), np.abs(agreed), np.nan)
    return gains, np.where((agreed < 0) & ~inwards, -signs, signs), loaded.ravel(), site


# A second load, measured while it is put on three sensors.


def firm_readings(
    model: AbstractSimulator, body: AbstractBody, sensors: Sensors, load: KnownLoad, limits: Limits
) -> np.ndarray:
    """Return the readings under a second load over each of N sites, (N, S), N.

    Raises:
        InputError: they are far below those of a dangerous press, up to which sensors may be curved.
    """
    base = min(_THUMB, *(side / 2 for side in body.size))
    firm = KnownLoad(min(limits.pressure * math.pi * base**2, limits.force) / GRAVITY, base)
    expected, needed = (base_readings(model, body, sensors, used)[0] for used in (load, firm))
    if np.median(share := expected.max(axis=1) / needed.max(axis=1)) < _FIRM:
        raise InputError(
            f"this load reads only {np.median(share):.0%} of a press at the limit of dangerous touches, and "
            "would not show a curve of the sensors: give a heavier and wider one, as in "
            f"weight={firm.weight:.1f} base={base:g}"
        )
    return expected


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
        expected: readings (N, S), N, under the load on each site.
        seconds: for which each load must lie.
        say: called with each message for the user.

    Raises:
        InputError: no load lies so long, or its reading changes: the device may follow its own baseline.
    """
    clock, stream, ratios, enough = StreamClock(), iter(frames), dict[str, float](), min(3, len(expected))
    rate = (len(first) - 1) / np.ptp([clock(frame) for frame in first])
    rows = [conversion.newtons(frame.values) for frame in first]
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
        counted = np.ptp(found.span, axis=1) >= seconds
        for change in found.change[counted]:
            # The pattern identifies the site for any scale and sign.
            site = int(np.abs(expected @ change / np.linalg.norm(expected, axis=1)).argmax())
            sensor = expected.shape[1] // len(expected) * (site + 1) - 1  # inwards
            if str(sensor) not in ratios:
                say(
                    f"sensor {sensor}: {change[sensor]:.3g} N, predicted {expected[site, sensor]:.3g} N; "
                    f"{len(ratios) + 1} of {enough}, lift it"
                )
            ratios[str(sensor)] = float(change[sensor] / expected[site, sensor])
        if len(ratios) >= enough and lying == 0:
            return ratios
        if time[-1] - found.span[counted].min(axis=1).max(initial=0.0) > _PATIENCE + seconds:
            break
    raise InputError(
        f"no further load lay for {seconds:g} s within {_PATIENCE:g} s: give a heavier one, as in weight=1, "
        "or let the device keep its baseline"
    )


# Simulated sessions: presses of a gauge, and placements of a load.


_RAMP = 0.05  # s from one step of force to the next; a release takes none


def stair_gauge(
    positions: np.ndarray,
    peak: float = 120.0,
    steps: Sequence[float] = (0.1, 0.2, 0.4, 0.7, 1.0),
    hold: float = 0.3,
    idle: float = 3.0,
    rest: float = 2.0,
    indenter: str = "blurred_disc",
    radius: float = 0.01,
    rate: float = 100.0,
) -> Gauge:
    """Return a gauge's rows for a staircase at each position: up, down, up to the peak, and a sudden release.

    The upward steps determine gains, the downward steps hysteresis, the release the lag, and idle time
    offset, noise and drift.

    Args:
        positions: of the presses, (P, 2), m.
        peak: largest force of every press, N.
        steps: fractions of the peak on the way up, and reversed on the way down.
        hold: at every step, s.
        idle: before the first press, s.
        rest: after every press, s.
        indenter: name as in ``touch.shapes``.
        radius: half its larger extent, m.
        rate: of gauge and session, Hz.
    """
    levels = [0.0, *steps, *list(steps)[-2::-1], steps[-1]]
    corners = np.cumsum([0.0, *[_RAMP, hold] * (len(levels) - 1)])
    inside = np.arange(0, corners[-1], 1 / rate)
    press = np.r_[
        np.interp(inside, corners, peak * np.repeat(levels, 2)[1:]), np.zeros(max(2, round(0.2 * rate)))
    ]
    starts = round(idle * rate) + np.arange(len(positions)) * (len(press) + round(rest * rate))
    return Gauge(
        (starts[:, None] + np.arange(len(press))).ravel() / rate,
        np.tile(press, len(positions)),
        np.repeat(np.arange(len(positions)), len(press)),
        pd.DataFrame(positions, columns=["x_m", "y_m"]).assign(indenter=indenter, radius_m=radius, angle=0.0),
    )


def choose_presses(device: Simulated, generator: np.random.Generator) -> np.ndarray:
    """Return two positions per sensor, on it and up to 3 mm beside it, (2 S, 2), m, inside the sheet."""
    centre = device.sensors.positions[:, :2]
    return np.clip(np.r_[centre, centre + generator.uniform(-0.003, 0.003, centre.shape)], 0, device.size)


def emulate_session(
    device: Simulated,
    gauge: Gauge,
    generator: np.random.Generator,
    bits: int | None = None,
    each: np.ndarray | None = None,
) -> BenchSession:
    """Return what a device sends under the presses of a gauge: N, or counts of a converter.

    Args:
        device: the skin.
        gauge: rows at the rate of the session.
        generator: of the noise.
        bits: of the converter; None: N are sent.
        each: true readings per N of each press, (P, S); None: those of the device.
    """
    time = np.arange(0.0, gauge.time[-1] + 2.0, float(np.median(np.diff(gauge.time))))
    each = per_newton(device.model, device.body, gauge) if each is None else each
    force, press = gauge.at(time)
    true = torch.from_numpy(force[:, None] * each[press])[None].float()
    readings = device.imperfection.raw(true, device.constants, generator, torch.from_numpy(time).float())
    return BenchSession(
        time,
        Converter(bits, device.imperfection.clip)(
            readings[0].numpy() * device.imperfection.signs(true.shape[2])
        ),
        "N" if bits is None else "adc",
        gauge,
        bits,
    )


def emulate_placements(
    device: Simulated,
    readings: np.ndarray,
    generator: np.random.Generator,
    bits: int | None = None,
    idle: float = 3.0,
) -> BenchSession:
    """Return a session of placements of a load one after the other, each of 2 s, with pauses of 2 s.

    Args:
        device: the skin.
        readings: true readings of each placement, (P, S), N.
        generator: of the noise.
        bits: of the converter; None: N are sent.
        idle: before the first one, s.
    """
    return replace(
        emulate_session(
            device,
            stair_gauge(np.zeros((len(readings), 2)), 1.0, (1.0,), hold=1.0, idle=idle),
            generator,
            bits,
            readings,
        ),
        gauge=None,
    )


def write_demo(device: Simulated, load: KnownLoad | None, bits: int | None, path: str) -> str:
    """Write a simulated session of presses, or of a load on every site twice; return a summary.

    Args:
        device: the skin.
        load: what is put on it, in any order; None: it is pressed with a gauge.
        bits: of the converter; None: N are sent.
        path: .csv or .parquet.
    """
    randomness = np.random.default_rng(device.seed)
    if load is None:
        loads = choose_presses(device, randomness)
        session = emulate_session(device, stair_gauge(loads), randomness, bits)
    else:
        expected = base_readings(device.model, device.body, device.sensors, load)
        loads = np.vstack([*map(randomness.permutation, expected.repeat(max(1, 2 // len(expected)), axis=0))])
        session = emulate_placements(device, loads, randomness, bits)
    return f"{write_bench_session(session, path)}: {len(loads)} presses in {session.time[-1]:.0f} s"
