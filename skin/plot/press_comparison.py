"""Presses of a bench session beside their simulation (report, figures 11 and 12)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.hardware.calibration import bench_session, gauge
from skin.hardware.calibration.bench_data import BenchData, build_bench_data
from skin.plot.figures import COLOURS, save_figure
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.signal.resampling import resample


@dataclass(frozen=True)
class Press:
    """One press, at the sensor that answers most in simulation.

    Attributes:
        number: of the press.
        sensor: number of the sensor.
        ratio: slope of recorded over simulated readings through 0.
        rmse: over all working sensors, N.
        force: largest applied, N.
        peaks: largest reading, simulated and recorded, N.
    """

    number: int
    sensor: int
    ratio: float
    rmse: float
    force: float
    peaks: tuple[float, float]


@dataclass(frozen=True)
class Comparison:
    """Readings of a session and of its simulation, without their idle medians.

    Attributes:
        bench: the session and what pressed it.
        simulated: (T, S), N.
        recorded: (T, S), N.
        valid: (S,), bool: sensors that work in both.
        presses: one by one.
    """

    bench: BenchData
    simulated: np.ndarray
    recorded: np.ndarray
    valid: np.ndarray
    presses: Sequence[Press]


@dataclass(frozen=True)
class Verdicts:
    """What a run says of both sides.

    Attributes:
        names: of the labels.
        simulated, recorded: (B, L), bool.
        truth: (B, L), bool; None where nobody knows.
    """

    names: Sequence[str]
    simulated: np.ndarray
    recorded: np.ndarray
    truth: np.ndarray | None = None


def agreement(verdicts: Verdicts | None, things: str) -> list[str]:
    """Return lines on how often a run says the same of both sides, and how often what is true."""
    if verdicts is None:
        return []
    lines = []
    for number, name in enumerate(verdicts.names):
        sides = verdicts.simulated[:, number], verdicts.recorded[:, number]
        same = int((sides[0] == sides[1]).sum())
        line = f"- the run says the same of `{name}` on {same} of {len(sides[0])} {things}"
        if verdicts.truth is not None:
            right = [int((side == verdicts.truth[:, number]).sum()) for side in sides]
            line += f", and is right on {right[0]} simulated and {right[1]} recorded ones"
        lines.append(line)
    return lines


def read_presses(
    device: AbstractSimulated, path: str, presses: str | None, settings: Mapping[str, Any]
) -> "Comparison":
    """Return the presses of a session beside their simulation.

    Args:
        device: as in :func:`compare`.
        path: of the session.
        presses: the gauge's file; None: in the session.
        settings: ``conf/compare.yaml`` under ``compare``.

    Raises:
        InputError: files that cannot be used, or that do not fit each other.
    """
    shape = settings["indenter"], settings["radius"]
    said = bench_session.read_bench_session(path, *shape, settings["unit"])
    calibration = device.imperfection.calibration
    if calibration is not None and calibration.channels and said.channels is None:
        said = replace(said, raw=said.raw[:, list(calibration.channels)])
    rows = None if presses is None else gauge.read_gauge(presses, *shape, settings["delay"])
    found = compare(device, build_bench_data(device, said, rows), settings["scale"])
    if not found.presses:
        raise InputError("no press has frames in the session: check the clocks, see compare.delay")
    return found


def compare(device: AbstractSimulated, bench: BenchData, scale: float | None) -> Comparison:
    """Simulate a session's presses on a device, and compare reading by reading.

    Args:
        device: with its imperfections, or its calibration.
        bench: the session.
        scale: N per unit of the session; None: the calibration's, or 1 where the session is in N.

    Raises:
        InputError: nobody knows what a count is worth.
    """
    said, known = bench.session, device.imperfection.calibration
    if scale is None and known is not None and said.unit != "N":
        scale = known.scale
    if scale is None and said.unit != "N":
        raise InputError(
            "the session is in counts: give device.calibration=FILE.yaml, or compare.scale=0.039"
        )
    noise = generator(Stream.NOISE, device.seed, Stream.TEST, 4)
    true, time = torch.from_numpy(bench.true)[None].float(), torch.from_numpy(said.time).float()
    felt = device.imperfection.raw(true, device.constants, noise, time)[0].double().numpy()
    signs = 1.0 if known is None else known.signs
    recorded = said.raw * ((1.0 if scale is None else scale) * signs)
    idle = bench.idle
    simulated, recorded = (values - np.nanmedian(values[idle], axis=0) for values in (felt, recorded))
    valid = ~device.constants.dead.numpy() & np.isfinite(recorded[idle]).any(axis=0)
    found = Comparison(bench, simulated, recorded, valid, [])
    presses = [_press(found, number) for number in range(len(bench.gauge))]
    return Comparison(bench, simulated, recorded, valid, [press for press in presses if press])


def _press(found: Comparison, number: int) -> Press | None:
    force, press = found.bench.applied
    mine = (press == number) & np.isfinite(found.recorded).all(axis=1)
    if mine.sum() < 3:
        return None
    simulated, recorded = found.simulated[mine], found.recorded[mine]
    sensor = int(np.where(found.valid, simulated.max(axis=0), -np.inf).argmax())
    x, y = simulated[:, sensor], recorded[:, sensor]
    rmse = float(np.sqrt(np.mean((simulated - recorded)[:, found.valid] ** 2)))
    peaks = float(x.max()), float(y.max())
    return Press(number, sensor, float(x @ y / (x @ x)), rmse, float(force[mine].max()), peaks)


def press_touches(
    found: Comparison, positions: np.ndarray, rate: float, window: int
) -> tuple[Touches, Touches]:
    """Return the presses as a model sees them, simulated and recorded: a window from each one's beginning."""
    time, gauge = found.bench.session.time, found.bench.gauge
    begins = [gauge.time[gauge.first[press.number]] for press in found.presses]
    length, both = window / rate - 0.5 * float(np.median(np.diff(time))), []
    for values in (found.simulated, found.recorded):
        valid = np.isfinite(values) & found.valid
        clean, never = np.where(valid, values, 0.0), np.zeros_like(valid)
        rows = [resample(time, clean, valid, never, begin + length, 1 / rate, window) for begin in begins]
        readings, marks = (torch.from_numpy(np.stack([row[part] for row in rows])) for part in (0, 1))
        places = torch.from_numpy(positions).float()
        both.append(Touches(readings.float() * marks, marks, places, None, rate))
    return both[0], both[1]


def presses_markdown(found: Comparison, verdicts: Verdicts | None, about: str) -> str:
    """Return a page in Markdown.

    Args:
        found: the comparison.
        verdicts: of a run; None without one.
        about: a sentence on where this came from.
    """
    presses = found.presses
    ratios = np.array([press.ratio for press in presses])
    rmse = np.sqrt(np.mean([press.rmse**2 for press in presses]))
    shares = [[press.peaks[side] / press.force for press in presses] for side in (0, 1)]
    low, high = np.percentile(ratios, [25, 75])
    title, picture = "# The same presses, simulated and recorded", "![force and reading](compare.png)"
    lines = [title, "", about, "", picture, ""]
    lines += [
        f"- presses: {len(presses)}",
        f"- gain ratio (recorded over simulated), median: {np.median(ratios):.3f}, middle half {low:.3f} "
        f"to {high:.3f}",
        f"- RMSE of readings: {rmse:.3f} N",
        f"- largest reading per applied force: {np.median(shares[0]):.1%} simulated, "
        f"{np.median(shares[1]):.1%} recorded (the report's skin: about 5 %)",
    ]
    lines += agreement(verdicts, "presses")
    lines += [
        "",
        "| press | sensor | force, N | simulated, N | recorded, N | ratio | RMSE, N |",
        "|---" * 7 + "|",
    ]
    lines += [
        f"| {press.number} | {press.sensor} | {press.force:.1f} | {press.peaks[0]:.2f} | "
        f"{press.peaks[1]:.2f} | {press.ratio:.3f} | {press.rmse:.3f} |"
        for press in presses
    ]
    return "\n".join(lines) + "\n"


def plot_presses(found: Comparison, shown: int, path: Path) -> Path:
    """Draw applied force and reading, simulated above, recorded below, for the strongest presses."""
    strongest = sorted(found.presses, key=lambda press: -press.peaks[0])[:shown]
    drawn = Figure(figsize=(3.6 * len(strongest), 5.4), layout="constrained")
    axes = drawn.subplots(2, len(strongest), squeeze=False, sharex="col")
    force, press = found.bench.applied
    time = found.bench.session.time
    for column, one in enumerate(strongest):
        mine = np.flatnonzero(press == one.number)
        span = slice(max(0, mine[0] - 20), mine[-1] + 40)
        top = 1.1 * max(one.peaks)
        for row, (name, values) in enumerate((("simulated", found.simulated), ("recorded", found.recorded))):
            axis = axes[row, column]
            axis.plot(time[span] - time[mine[0]], force[span], color=COLOURS[0])
            axis.set_ylabel("applied force, N", color=COLOURS[0])
            twin = axis.twinx()
            twin.plot(time[span] - time[mine[0]], values[span, one.sensor], color=COLOURS[4], linewidth=1)
            twin.set_ylabel("reading, N", color=COLOURS[4])
            twin.set_ylim(-0.05 * top, top)
            axis.set_title(f"{name}, press {one.number}, sensor {one.sensor}", fontsize=9)
        axes[1, column].set_xlabel("time, s")
    return save_figure(drawn, path)
