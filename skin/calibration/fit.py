"""Fit the constants of a simulated device to a bench session, and test them on held-out presses."""

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from skin.calibration.bench import BenchData, BenchSession, per_newton, warn_of_thickness
from skin.calibration.channel import Channel, Loads, fit_channel
from skin.calibration.wiring import (
    MAD,
    QUIET,
    check_usable,
    collect_responses,
    find_polarity,
    list_numbers,
    measure_rests,
)
from skin.device.calibration import BROKEN, QUANTITIES, Calibration, Curves, Table
from skin.device.imperfection import Imperfection
from skin.device.simulated import Simulated
from skin.errors import InputError

# Of the largest true reading: less determines no gain. Of the strongest one of a press: sensors that count.
_PRESSED, _RESPONDING = 0.05, 0.05
_LOADED = 0.2  # of a press's peak: frames in which its force is estimated
# Of the largest reading of all: a channel that is always there is saturated. Of the limit of a channel.
_LIMIT, _CLIPPED = 0.95, 0.95
_TOO_FAR = 0.25  # error of a held-out force; positions off by 2 mm cause less
_WEAK = 0.05  # of the median gain: such a channel has 20 times the noise of others
_GAUGES, _LIKE = {"kg": 9.80665, "g": 0.00980665}, 1.5  # N; factor within which a unit explains
_UNITS = {"gain": "", "exponent": "", "hysteresis": "of peak", "time_constant": "s", "drift": "N/s"}


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
    broken = _find_broken(
        bench.session,
        bench.true.max(axis=0),
        responses.responding & (np.isfinite(raw[bench.idle]).sum(axis=0) >= QUIET),
    )
    rests = measure_rests(bench.session, bench.idle)
    polarity, (offset, drift) = find_polarity(responses, bench.each), rests[["offset", "drift"]].to_numpy().T
    changes = polarity * (raw - offset - drift * bench.session.time[:, None])
    driven = bench.true[np.isin(bench.applied[1], list(used))].max(axis=0, initial=0.0)
    noise, loads = np.hypot(rests["noise"], rests["quantum"] / math.sqrt(12)), Loads(bench, used)
    channels = {
        number: channel
        for number in np.flatnonzero(driven >= _PRESSED * driven.max()).tolist()
        if not any(number in group for group in broken.values())
        if (channel := fit_channel(loads, bench.each[:, number], changes[:, number], noise[number]))
    }
    if not any(channel.known for channel in channels.values()):
        raise InputError(
            "no channel responds to a press below its limit: check layout, indenter, the forces and the "
            "session's clock"
        )
    return _describe(bench, rests.assign(drift=polarity * drift), polarity, channels, changes, broken)


def _find_broken(session: BenchSession, pressed: np.ndarray, responding: np.ndarray) -> dict[str, list[int]]:
    """Return the broken channels by kind: those that never change, or are silent though ``pressed``, N."""
    largest, table = float(np.nanmax(session.raw, initial=-np.inf)), pd.DataFrame(session.raw)
    limit = min(2**session.bits - 1 if session.bits else np.inf, _LIMIT * largest)
    still, level = table.nunique().to_numpy() < 2, table.bfill().iloc[0].fillna(0.0).to_numpy()
    fixed, full = still & (level != 0), (level >= limit) & (limit > 0)
    dead = ~fixed & (still | (pressed >= _PRESSED * pressed.max()) & ~responding)
    return {
        kind: np.flatnonzero(where).tolist()
        for kind, where in zip(BROKEN, (dead, fixed & ~full, fixed & full), strict=True)
    }


def _curved_noise(bench: BenchData, curves: Curves, number: int, change: np.ndarray) -> float:
    """Return the noise under load of a curved channel, where its curve is the reference.

    Elsewhere it has other slopes. Differences are taken twice: the rising force is no noise.
    """
    true, every = bench.true[:, number], np.repeat(change[:, None], len(curves.exponent), axis=1)
    linear = curves.straighten(every)[:, number]
    loaded = linear[bench.loading & (true > _PRESSED * true.max()) & np.isfinite(change)]
    return MAD / math.sqrt(6) * float(np.median(np.abs(np.diff(loaded, 2)))) * float(curves.slopes[number])


def _describe(
    bench: BenchData,
    values: pd.DataFrame,
    polarity: np.ndarray,
    channels: Mapping[int, Channel],
    changes: np.ndarray,
    broken: Mapping[str, list[int]],
) -> Calibration:
    """Return the calibration that follows from the rest and the response of every channel."""
    known = {n: channel for n, channel in channels.items() if channel.known}
    bent = {n: channel for n, channel in known.items() if channel.kind != "linear"}
    at = math.exp(float(np.median([channel.middle[1] for channel in bent.values()]))) if bent else 1.0
    tables = {n: channel.table(at) for n, channel in bent.items() if channel.kind == "table"}
    values["clip"] = pd.Series({n: channel.clip for n, channel in channels.items()})
    values[["gain", "hysteresis", "time_constant"]] = pd.DataFrame.from_dict(
        {n: [channel.gain(at), channel.hysteresis, channel.time_constant] for n, channel in known.items()},
        orient="index",
    )
    if bent:
        values["exponent"] = pd.Series(
            {n: channel.slopes[0] if channel.kind == "power" else 1.0 for n, channel in known.items()}
        )
        curves = Curves(values["exponent"].fillna(1.0).to_numpy(), np.full(len(values), at), tables)
        for n in bent:
            values.loc[n, "noise"] = _curved_noise(bench, curves, n, changes[:, n])
    return convert_to_newton(
        bench.session,
        values,
        polarity,
        broken,
        {"presses": len(bench.gauge), "frames": len(bench.session.time)},
        at if bent else None,
        tables,
    )


def convert_to_newton(
    session: BenchSession,
    values: pd.DataFrame,
    polarity: np.ndarray,
    broken: Mapping[str, Sequence[int]],
    metadata: Mapping[str, Any],
    at: float | None = None,
    tables: Mapping[int, Table] | None = None,
) -> Calibration:
    """Return the calibration of a session, with ranges over the working channels.

    Args:
        session: of the channels.
        values: columns of quantities (S,), in the session's unit, gain per N, offset of the raw values; NaN
            if unknown.
        polarity: (S,), 1 or -1.
        broken: kind -> numbers of channels.
        metadata: origin of the calibration.
        at, tables: of curves (:class:`skin.device.calibration.Curves`), in the session's unit; None: all
            channels are linear.
    """
    alive = ~np.isin(np.arange(len(polarity)), np.concatenate([*broken.values()]))
    # Counts have an unknown zero, common to all channels; readings in N do not.
    scale, zero = (
        (1.0, 0.0)
        if session.unit == "N"
        else (1 / float(np.nanmedian(values["gain"])), float(np.median(values["offset"][alive])))
    )
    values = values.assign(offset=polarity * (values["offset"] - zero))
    values[values.columns.difference(["hysteresis", "time_constant", "exponent"])] *= scale
    # Six digits, and no negative 0.
    values = values.map(lambda value: float(f"{value:.6g}") + 0.0)
    ranges = {"dead": [0.0, float((~alive).sum())]} | {
        str(name): [float(column.min()), float(column.max())]
        for name, column in values[alive].dropna(axis="columns", how="all").items()
    }
    return Calibration(
        values.rename(columns=str).astype(object).where(values.notna(), None).to_dict("list"),
        {kind: list(map(int, numbers)) for kind, numbers in broken.items()},
        ranges,
        scale,
        zero,
        {"unit": session.unit, **metadata},
        polarity=polarity.astype(int).tolist() if polarity.min() < 0 else (),
        exponent_at=1.0 if at is None else at * scale,
        tables={n: (scale * np.array(table)).tolist() for n, table in (tables or {}).items()},
    )


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on presses that were not used for the calibration.

    Attributes:
        rmse: N, of the ``simulated`` true readings (gain 1, no offset), of these ``tared``, with the offset
            of each sensor, and of the ``calibrated`` simulation.
        held_out: numbers of these presses.
        force: ratio of the force that measured readings give to that of the calibrated simulation, median
            over the loading of each held-out press, (n,); empty if no sensor could be used.
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
    # Each has an earlier press at the same strongest sensor.
    spare = np.flatnonzero(pd.Series(bench.each.argmax(axis=1)).duplicated())
    if not len(spare):
        raise InputError("no press can be held out: press near every sensor at least twice")
    count = min(len(spare), max(1, round(fraction * len(bench.gauge))))
    held = spare[np.linspace(0, len(spare) - 1, count).round().astype(int)].tolist()
    calibration = fit_calibration(bench, set(range(len(bench.gauge))) - set(held))
    # 0 outside of held-out presses, where no sensor counts.
    answers = np.where(np.isin(bench.applied[1], held)[:, None], bench.each[bench.applied[1]], 0.0)
    counted = np.isfinite(calibration.corrected(bench.session.raw)) & (
        answers > _RESPONDING * answers.max(axis=1, keepdims=True)
    )
    measured, simulated = calibration.newtons(bench.session.raw), predict_session(bench, calibration)
    sides = bench.true, bench.true + calibration.values()["offset"], simulated
    rmse = {
        name: float(np.sqrt(np.mean((side - measured)[counted] ** 2)))
        for name, side in zip(("simulated", "tared", "calibrated"), sides, strict=True)
    }
    shown = simulated / (calibration.scale * calibration.signs) + calibration.zero
    loaded = bench.loading & (bench.applied[0] > _LOADED * bench.gauge.force.max())
    force, expected = (estimate_force(raw, answers, calibration) for raw in (bench.session.raw, shown))
    ratios = pd.Series(force / expected)[loaded].groupby(bench.applied[1][loaded]).median().dropna()
    return HeldOutErrors(rmse, held, ratios.to_numpy())


def predict_session(bench: BenchData, calibration: Calibration) -> np.ndarray:
    """Return the simulated readings of a calibrated device without noise, (T, S), N."""
    imperfection, randomness = Imperfection(calibration=calibration), np.random.default_rng(0)
    constants = imperfection.constants(bench.each.shape[1], randomness)._replace(noise=torch.zeros(()))
    true, time = (torch.from_numpy(values).float() for values in (bench.true, bench.session.time))
    return imperfection.raw(true[None], constants, randomness, time)[0].double().numpy()


def estimate_force(raw: np.ndarray, each: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Estimate the force of a press from readings, (...), N, by least squares over usable sensors.

    Args:
        raw: (..., S), in the session's unit.
        each: (S,) or (..., S), true readings per N of that indenter at that position, as
            :func:`skin.calibration.bench.per_newton` gives them.
        calibration: of this skin.

    Returns:
        NaN if every sensor that responds to the press is broken or at its limit.
    """
    true = _below_limit(raw, calibration)
    felt = np.isfinite(true) & (each > _RESPONDING * each.max(axis=-1, keepdims=True))
    weights = np.where(felt, each, 0.0)
    square = (weights**2).sum(axis=-1)
    return (weights * np.nan_to_num(true)).sum(axis=-1) / np.where(square > 0, square, np.nan)


def _below_limit(raw: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Return true readings (..., S), N; NaN for broken sensors, and for values at the limit of a sensor."""
    values = calibration.values()
    below = calibration.newtons(raw) - values["offset"] < _CLIPPED * values["clip"]
    return np.where(below, calibration.corrected(raw), np.nan)


def check_force(calibration: Calibration, clip: float) -> None:
    """Compare the unit of the gauge with what this skin can give.

    Args:
        calibration: fitted to the gauge.
        clip: largest force that a sensor of this skin measures, N.

    Raises:
        InputError: gains of sensors in N, or limits of sensors in counts, are those of a gauge in another
            unit.
    """
    sensors = pd.DataFrame(calibration.sensors).astype(float)
    ratio, words = sensors["gain"].median(), "the gains of sensors in N are {:.3g}"
    if calibration.about.get("unit") != "N":
        limits = sensors["clip"].to_numpy()
        limits = limits if calibration.curves is None else calibration.curves.straighten(limits)
        ratio = clip / pd.Series(limits).median()
        words = f"device.clip={clip:g} N is {{:.3g}} times the limit of the sensors"
    for name, unit in _GAUGES.items():
        if abs(math.log(ratio / unit)) < math.log(_LIKE):
            raise InputError(
                f"{words.format(ratio)}: the force of the gauge seems to be in {name}; add "
                f"calibrate.force_scale={unit:g}, or calibrate.force_scale=1 if it is in N"
            )


def fit_presses(
    device: Simulated, bench: BenchData, fraction: float, known_unit: bool
) -> tuple[Calibration, HeldOutErrors]:
    """Return a calibration by presses of a gauge, and its errors on held-out ones.

    Args:
        device: with the skin as designed.
        bench: data of the session.
        fraction: of the presses that are held out.
        known_unit: whether the unit of the gauge is known; otherwise the limit of the device tells it.

    Raises:
        InputError: the unit of the gauge is wrong, or too few sensors can be used.
    """
    calibration = fit_calibration(bench)
    check_usable(calibration)
    if not known_unit:
        check_force(calibration, device.imperfection.clip)
    force, press = (values[bench.loading] for values in bench.applied)
    ratios = _below_limit(bench.session.raw[bench.loading], calibration) / force[:, None]
    each = pd.DataFrame(ratios).groupby(press).median()  # of the presses that have frames
    fits = warn_of_thickness(
        device,
        bench.each[each.index],
        each.to_numpy(),
        calibration.values()["noise"] / force.max(),
        lambda body, sensors: per_newton(device.simulator(body, sensors), body, bench.gauge)[each.index],
    )
    return replace(calibration, about={**calibration.about, **fits}), evaluate_held_out(bench, fraction)


def print_calibration(calibration: Calibration, errors: HeldOutErrors | None = None) -> None:
    """Print the constants of working sensors, what is unusual about others, and held-out errors."""
    rows = {
        name: [np.median(calibration.known(name)), *calibration.ranges[name], _UNITS.get(name, "N")]
        for name in QUANTITIES
        if name in calibration.ranges
    }
    print(*(f"{name} {value}" for name, value in calibration.about.items() if name != "unit"), sep=", ")
    print(
        pd.DataFrame.from_dict(rows, orient="index", columns=["median", "least", "largest", ""]).to_string(
            float_format="{:.4g}".format
        )
    )
    gains = pd.Series(calibration.sensors["gain"], dtype=float)
    groups: dict[str, Sequence[int] | np.ndarray] = {
        **{kind + " or never loaded" * (kind == "dead"): each for kind, each in calibration.broken.items()},
        "inverse, values fall with force": np.flatnonzero(calibration.signs < 0),
        "curved, as in a table": list(calibration.tables),
        f"weak, less than {_WEAK:.0%} of the median gain": np.flatnonzero(gains < _WEAK * gains.median()),
        "not loaded, or at the limit, so of median gain": np.flatnonzero(
            gains.isna() & ~calibration.values()["dead"]
        ),
    }
    for words, numbers in groups.items():
        if len(numbers):
            print(f"{words}: sensors {list_numbers(numbers)} (from 0)")
    if errors is None:
        return
    print(
        f"RMSE on {len(errors.held_out)} held-out presses:",
        ", ".join(f"{name} {value:.4f} N" for name, value in errors.rmse.items()),
    )
    if len(errors.force):
        off = np.abs(errors.force - 1)
        print(f"force of these presses from readings: off by {np.median(off):.1%}, at most {off.max():.1%}")
        if off.max() > _TOO_FAR:
            warnings.warn(
                f"the force of a held-out press is off by {off.max():.0%}: sensors are probably not where "
                "the layout says, and then their gains are wrong; measure their positions",
                UserWarning,
                stacklevel=2,
            )
