"""Touches of a session beside their simulation (report, figures 11 and 12).

A session of ``skin record`` holds gestures, one of a bench holds presses. Both become pairs of what is
simulated and what was measured, with one page and one figure.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from skin.calibration.bench import (
    BenchData,
    Units,
    build_bench_data,
    pressed_peaks,
    read_bench_session,
    read_gauge,
)
from skin.calibration.wiring import turn_gauge
from skin.core.files import write
from skin.core.rng import Stream, generator
from skin.core.settings import configured
from skin.device.base import AbstractSimulated, Blank
from skin.device.resampling import resample
from skin.device.touches import Touches
from skin.errors import InputError
from skin.plot.figures import COLOURS, save_figure
from skin.record.recorder import check_session
from skin.record.session import read_session
from skin.runs.configuration import Config
from skin.touch.labels import TOUCH
from skin.wire.emulator import Gesture, emulated_gestures, gestures_with_labels
from skin.wire.segmentation import label_text

_IDLE = 30  # frames before a simulated gesture, which give its baseline
_BEFORE, _AFTER = 20, 40  # frames of a session that the figure shows around a press
_FEWEST = 3  # frames of a press: less determines no slope


@dataclass(frozen=True)
class Pair:
    """One touch, simulated and measured.

    Attributes:
        number: of the touch in its session.
        labels: name -> 0 or 1; None: a press of a bench, at one position.
        time: (T,), s, from the beginning of the touch.
        applied: force on the simulated skin, (T,), N.
        simulated: (T, S), N.
        measured: (T, S), N; NaN where nothing was measured.
        valid: (T, S), bool: frames of the touch, of sensors that work on both sides.
    """

    number: int
    labels: Mapping[str, int] | None
    time: np.ndarray
    applied: np.ndarray
    simulated: np.ndarray
    measured: np.ndarray
    valid: np.ndarray

    @property
    def sensor(self) -> int:
        """The sensor that answers most in simulation."""
        return _find_strongest(self.simulated, self.valid)

    @property
    def force(self) -> float:
        """The largest applied force, N."""
        return float(self.applied[self.valid.any(axis=1)].max())

    @property
    def peaks(self) -> tuple[float, float]:
        """Largest reading, simulated and measured, N: of ``sensor`` for a press, else of any sensor."""
        answering = self.valid.copy()
        if self.labels is None:
            answering[:, np.arange(answering.shape[1]) != self.sensor] = False
        return float(self.simulated[answering].max()), float(self.measured[answering].max())

    @property
    def rmse(self) -> float:
        """Over all readings, N."""
        return float(np.sqrt(np.mean((self.simulated - self.measured)[self.valid] ** 2)))

    @property
    def slope(self) -> float:
        """Measured over simulated readings of ``sensor``, through 0."""
        frames = self.valid[:, self.sensor]
        x, y = self.simulated[frames, self.sensor], self.measured[frames, self.sensor]
        return float(x @ y / (x @ x))


@dataclass(frozen=True)
class SessionComparison:
    """The touches of a session beside their simulation.

    Attributes:
        things: ``presses`` or ``gestures``.
        same: the very same touches are simulated, not only such of the same labels.
        pairs: touch by touch.
        touches: both sides as a model sees them, simulated and measured.
    """

    things: str
    same: bool
    pairs: Sequence[Pair]
    touches: tuple[Touches, Touches]


@dataclass(frozen=True)
class Agreement:
    """What a run predicts of both sides.

    Attributes:
        names: of the labels.
        simulated, measured: (B, L), bool.
        truth: (B, L), bool; None where nobody knows.
    """

    names: Sequence[str]
    simulated: np.ndarray
    measured: np.ndarray
    truth: np.ndarray | None = None

    def lines(self, things: str) -> list[str]:
        """Return how often the run says the same of both sides, and how often what is true."""
        lines = []
        for number, name in enumerate(self.names):
            sides = self.simulated[:, number], self.measured[:, number]
            same = int((sides[0] == sides[1]).sum())
            line = f"- the run says the same of `{name}` on {same} of {len(sides[0])} {things}"
            if self.truth is not None:
                right = [int((side == self.truth[:, number]).sum()) for side in sides]
                line += f", and is right on {right[0]} simulated and {right[1]} recorded ones"
            lines.append(line)
        return lines


def compare_session(
    device: AbstractSimulated, path: str, presses: str | None, settings: Mapping[str, Any]
) -> SessionComparison:
    """Return the touches of a session beside their simulation.

    Args:
        device: with its imperfections, or its calibration.
        path: of the session.
        presses: the gauge's file; None: the session contains gestures, or the columns of a gauge.
        settings: ``conf/compare.yaml`` under ``compare``.

    Raises:
        InputError: files that cannot be used, or that do not fit each other.
    """
    if presses is None and holds_gestures(path):
        return compare_gestures(device, path, settings["seed"])
    shape = settings["indenter"], settings["radius"]
    scales = {name: settings[name] for name in ("force_scale", "time_scale")}
    units = configured(Units, scales | {"command": "compare"}, "compare")
    session = read_bench_session(path, *shape, settings["unit"], units)
    calibration = device.imperfection.calibration
    if calibration is not None and calibration.channels and session.channels is None:
        session = replace(session, raw=session.raw[:, list(calibration.channels)])
    rows = session.gauge if presses is None else read_gauge(presses, *shape, settings["delay"], units)
    if rows is not None:
        rows = turn_gauge(rows, settings["places"], device.size)
    return compare_presses(device, build_bench_data(device, session, rows), settings["scale"])


def compare_predictions(
    name: str, config: Config, comparison: SessionComparison, device: AbstractSimulated
) -> Agreement:
    """Return the predictions of a run for both sides; print a warning if it learned another mechanics.

    Args:
        name: of the run.
        config: of the command.
        comparison: of the session.
        device: with which the session was simulated.

    Raises:
        InputError: there is no such run, or it cannot predict these touches.
    """
    from skin.runs.build import load_model
    from skin.runs.run import find_run

    run = find_run(config.tracking, name, config.trust)
    if (learned := run.stored.simulator["_target_"]) != config.simulator["_target_"]:
        text = f"run {run.identity} was trained with {learned}"
        print(f"{text}: add simulator= to simulate the session with it\n")
    blank = Blank.of(device.task, device.size, comparison.touches[0])
    model = load_model(run, replace(run.stored, layout=config.layout), device=blank, alarm=False)
    simulated, measured = ((model.predict(side) > 0.5).numpy() for side in comparison.touches)
    labels = [pair.labels for pair in comparison.pairs if pair.labels is not None]
    truth = np.array([[bool(row[name]) for name in device.task.names] for row in labels])
    return Agreement(device.task.names, simulated, measured, truth if labels else None)


def holds_gestures(path: str) -> bool:
    """Return whether a session marks gestures, as those of skin record do."""
    beside = Path(path).expanduser().with_name(Path(path).name + ".json")
    try:
        about = json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(about, dict) and "window" in about


def compare_gestures(device: AbstractSimulated, path: str, seed: int) -> SessionComparison:
    """Return the gestures of a session beside their simulation.

    Announced gestures are those of an emulator: the same ones are simulated, on the device that is given.
    What a person did is not known but for its labels: gestures of the same labels are simulated.

    Args:
        device: with its imperfections, or its calibration.
        path: x.csv of skin record.
        seed: of the emulator, or of the gestures of the same labels.

    Raises:
        InputError: no session, no labels in it, another layout, window or rate, or another emulator's.
    """
    stored = read_session(Path(path).expanduser())
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(Path(path), stored.about, now)
    takes = [entry for _, entry in sorted(stored.gestures.items()) if entry[0].labels is not None]
    if not takes:
        raise InputError(f"{path} has no gesture with labels: record it with device.labels=prompted")
    same = stored.about.get("labels") == "announced"
    numbers, labels = [take.number for take, _ in takes], [dict(take.labels or {}) for take, _ in takes]
    if same:
        played = list(islice(emulated_gestures(device, seed), max(numbers) + 1))
        gestures = [played[number] for number in numbers]
        for number, gesture, row in zip(numbers, gestures, labels, strict=True):
            if any(row.get(name, holds) != holds for name, holds in gesture.labels.items()):
                raise InputError(
                    f"gesture {number} of the session is {label_text(row)}, the simulated one is "
                    f"{label_text(gesture.labels)}: give the emulator's settings and its emulate.seed as "
                    "compare.seed"
                )
    else:
        rows = np.array([[row[name] for name in TOUCH.names] for row in labels])
        gestures = gestures_with_labels(device, rows, seed)
    working = ~device.constants.dead.numpy()
    pairs = []
    for simulated, gesture, (take, conversion) in zip(
        _simulate_readings(device, gestures), gestures, takes, strict=True
    ):
        if take.resampled is None:
            continue
        values, valid = conversion(take.resampled.values, take.resampled.valid)
        valid = valid & working
        if valid.any() and simulated.any():
            time = np.arange(len(simulated)) / device.model_rate
            measured = np.where(valid, values.astype(float), np.nan)
            prompt = dict(take.labels or {})
            pairs.append(Pair(take.number, prompt, time, gesture.applied, simulated, measured, valid))
    if not pairs:
        raise InputError(f"{path} has no gesture with a sensor response: record more, or check the wiring")
    simulated, measured, valid = (
        np.stack([getattr(pair, name) for pair in pairs]) for name in ("simulated", "measured", "valid")
    )
    touches = _touches(device, simulated, valid), _touches(device, measured, valid)
    return SessionComparison("gestures", same, pairs, touches)


def _simulate_readings(device: AbstractSimulated, gestures: Sequence[Gesture]) -> np.ndarray:
    """Return what a device reads in gestures above what it reads before them, (B, T, S), N."""
    true = torch.from_numpy(np.stack([gesture.force for gesture in gestures])).float()
    true = torch.nn.functional.pad(true, (0, 0, _IDLE, 0))
    noise = generator(Stream.NOISE, device.seed, Stream.TEST, 6)
    readings = device.imperfection.raw(true, device.constants, noise).double()
    return (readings[:, _IDLE:] - readings[:, :_IDLE].median(dim=1, keepdim=True).values).numpy()


def compare_presses(device: AbstractSimulated, bench: BenchData, scale: float | None) -> SessionComparison:
    """Simulate a session's presses on a device; idle medians are subtracted on both sides.

    Args:
        device: with its imperfections, or its calibration.
        bench: the session and what pressed it.
        scale: N per unit of the session; None: the calibration's, or 1 where the session is in N.

    Raises:
        InputError: nobody knows what a count is worth, or no press has frames.
    """
    session, calibration = bench.session, device.imperfection.calibration
    if scale is None and calibration is not None and session.unit != "N":
        scale = calibration.scale
    if scale is None and session.unit != "N":
        raise InputError(
            "the session is in counts: give device.calibration=FILE.yaml, or compare.scale=0.039"
        )
    noise = generator(Stream.NOISE, device.seed, Stream.TEST, 4)
    true, time = torch.from_numpy(bench.true)[None].float(), torch.from_numpy(session.time).float()
    simulated = device.imperfection.raw(true, device.constants, noise, time)[0].double().numpy()
    signs = 1.0 if calibration is None else calibration.signs
    measured = session.raw * ((1.0 if scale is None else scale) * signs)
    working = ~device.constants.dead.numpy() & np.isfinite(measured[bench.idle]).any(axis=0)
    simulated, measured = (_subtract_idle(side, bench.idle) for side in (simulated, measured))
    valid = np.isfinite(measured) & working
    pairs = [
        pair
        for number in range(len(bench.gauge))
        if (pair := _cut_press(bench, simulated, measured, valid, number))
    ]
    if not pairs:
        raise InputError("no press has frames in the session: check the clocks, see compare.delay")
    begins = [bench.gauge.time[bench.gauge.first[pair.number]] for pair in pairs]
    contacts = torch.from_numpy(_contacts(device, bench, begins)).float()
    sides = (
        _resample(device, session.time, simulated, np.isfinite(simulated) & working, begins),
        _resample(device, session.time, measured, valid, begins),
    )
    simulation, recording = (replace(side, contacts=contacts) for side in sides)
    return SessionComparison("presses", True, pairs, (simulation, recording))


def _contacts(device: AbstractSimulated, bench: BenchData, begins: list[float]) -> np.ndarray:
    """Return the contacts in the middle of each frame of the model, from the beginning of each press."""
    middles = (np.arange(device.window) + 0.5) / device.model_rate
    peaks = pressed_peaks(device.body, bench.gauge)
    return np.stack([bench.gauge.contacts(begin + middles, peaks) for begin in begins])


def _subtract_idle(values: np.ndarray, idle: np.ndarray) -> np.ndarray:
    """Return readings (T, S) without their idle medians; NaN for a channel without values."""
    return values - np.ma.filled(np.ma.median(np.ma.masked_invalid(values[idle]), axis=0), np.nan)


def _cut_press(
    bench: BenchData, simulated: np.ndarray, measured: np.ndarray, valid: np.ndarray, number: int
) -> Pair | None:
    """Return a press with some frames around it; None if it has too few, or no sensor that works feels it."""
    force, press = bench.applied
    inside = np.flatnonzero((press == number) & valid.any(axis=1))
    if len(inside) < _FEWEST or not simulated[inside][valid[inside]].any():
        return None
    span = slice(max(0, inside[0] - _BEFORE), inside[-1] + _AFTER)
    time = bench.session.time[span] - bench.session.time[inside[0]]
    pressed = valid[span] & (press[span] == number)[:, None]
    return Pair(number, None, time, force[span], simulated[span], measured[span], pressed)


def _resample(
    device: AbstractSimulated, time: np.ndarray, values: np.ndarray, valid: np.ndarray, begins: list[float]
) -> Touches:
    """Return a window of readings from the beginning of each press."""
    rate, window = device.model_rate, device.window
    # Halfway between two frames, because one on the edge between two intervals could fall in either.
    ends = np.array(begins) + window / rate - 0.5 * float(np.median(np.diff(time)))
    clean, saturated = np.where(valid, values, 0.0), np.zeros_like(valid)
    rows = [resample(time, clean, valid, saturated, end, 1 / rate, window) for end in ends]
    return _touches(device, np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows]))


def _touches(device: AbstractSimulated, readings: np.ndarray, valid: np.ndarray) -> Touches:
    """Return readings (B, T, S), N, as a model sees them: 0 where not valid."""
    clean = torch.from_numpy(np.where(valid, readings, 0.0)).float()
    positions = torch.from_numpy(device.sensors.positions).float()
    return Touches(clean, torch.from_numpy(valid), positions, None, device.model_rate)


def comparison_markdown(comparison: SessionComparison, agreement: Agreement | None, about: str) -> str:
    """Return a page in Markdown.

    Args:
        comparison: the touches.
        agreement: predictions of a run; None without one.
        about: a sentence on where this came from.
    """
    pairs, things, same = comparison.pairs, comparison.things, comparison.same
    ratios = [pair.slope if same else pair.peaks[1] / pair.peaks[0] for pair in pairs]
    low, middle, high = np.percentile(ratios, [25, 50, 75])
    title = f"The same {things}" if same else f"{things.capitalize()} of the same labels"
    lines = [f"# {title}, simulated and recorded", "", about, "", "![force and reading](compare.png)", ""]
    lines += [
        f"- {things}: {len(pairs)}",
        f"- gain ratio of {'readings' if same else 'largest readings'} (recorded over simulated), median: "
        f"{middle:.3f}, middle half {low:.3f} to {high:.3f}",
    ]
    if same:
        rmse = np.sqrt(np.mean([pair.rmse**2 for pair in pairs]))
        fractions = [np.median([pair.peaks[side] / pair.force for pair in pairs]) for side in (0, 1)]
        lines += [
            f"- RMSE of readings: {rmse:.3f} N",
            f"- largest reading per applied force: {fractions[0]:.1%} simulated, {fractions[1]:.1%} recorded "
            "(the report's skin: about 5 %)",
        ]
    else:
        lines.append("- what a person did is known by its labels only, so frames are not compared one by one")
    lines += [] if agreement is None else agreement.lines(things)
    columns = ["gesture" if things == "gestures" else "press", "sensor", "force, N", "simulated, N"]
    lines += ["", f"| {' | '.join([*columns, 'recorded, N', 'ratio', 'RMSE, N'])} |", "|---" * 7 + "|"]
    for pair, ratio in zip(pairs, ratios, strict=True):
        name = f"{pair.number}: {label_text(pair.labels)}" if pair.labels else str(pair.number)
        error = f"{pair.rmse:.3f}" if same else ""
        lines.append(
            f"| {name} | {pair.sensor} | {pair.force:.1f} | {pair.peaks[0]:.2f} | {pair.peaks[1]:.2f} | "
            f"{ratio:.3f} | {error} |"
        )
    return "\n".join(lines) + "\n"


def plot_comparison(comparison: SessionComparison, count: int) -> Figure:
    """Draw applied force and reading, simulated above, measured below, of the ``count`` strongest touches."""
    strongest = sorted(comparison.pairs, key=lambda pair: -pair.peaks[0])[:count]
    figure = Figure(figsize=(3.6 * len(strongest), 5.4), layout="constrained")
    axes = figure.subplots(2, len(strongest), squeeze=False, sharex="col")
    for column, pair in enumerate(strongest):
        answering = pair.sensor if comparison.same else _find_strongest(pair.measured, pair.valid)
        sides = ("simulated", pair.simulated, pair.sensor), ("recorded", pair.measured, answering)
        for axis, (name, values, sensor) in zip(axes[:, column], sides, strict=True):
            if name == "simulated" or comparison.same:
                axis.plot(pair.time, pair.applied, color=COLOURS[0])
                axis.set_ylabel("applied force, N", color=COLOURS[0])
            else:
                axis.set_yticks([])
            twin = axis.twinx()
            twin.plot(pair.time, values[:, sensor], ".-", color=COLOURS[4], linewidth=1, markersize=3)
            twin.set_ylabel("reading, N", color=COLOURS[4])
            twin.set_ylim(-0.05 * max(pair.peaks), 1.1 * max(pair.peaks))
            thing = "press" if pair.labels is None else "gesture"
            axis.set_title(f"{name}, {thing} {pair.number}, sensor {sensor}", fontsize=9)
        axes[1, column].set_xlabel("time, s")
    return figure


def _find_strongest(values: np.ndarray, valid: np.ndarray) -> int:
    """Return the sensor with the largest valid reading."""
    return int(np.where(valid, values, -np.inf).max(axis=0).argmax())


def publish_comparison(
    comparison: SessionComparison, agreement: Agreement | None, about: str, count: int, folder: Path
) -> list[Path]:
    """Write ``compare.md`` and ``compare.png`` into a folder, each whole; return their paths."""
    page = write(comparison_markdown(comparison, agreement, about), folder / "compare.md")
    return [page, save_figure(plot_comparison(comparison, count), folder / "compare.png")]
