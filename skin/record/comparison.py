"""Touches of a session beside their simulation (report, figures 11 and 12).

A session of ``skin record`` holds gestures, one of a bench holds presses. Both become pairs of what is
simulated and what was measured, with one page and one figure.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from skin.calibration.bench import (
    BenchData,
    BenchSettings,
    build_bench_data,
    read_bench_session,
)
from skin.core.files import write
from skin.core.rng import Stream, generator
from skin.device.base import Blank
from skin.device.resampling import resample
from skin.device.simulated import Simulated
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.guarantee import replay_presses
from skin.plot.figures import COLOURS, save_figure
from skin.record.session import check_session, read_session
from skin.runs.configuration import Config
from skin.touch.labels import RELEASE, TOUCH
from skin.touch.shapes import pressed_images, pressed_peaks
from skin.wire.channels import NewtonFrame, unit_conversion
from skin.wire.emulator import Gesture, emulated_gestures, gestures_with_labels
from skin.wire.segmentation import label_text

_IDLE = 30  # frames before a simulated gesture, which give its baseline


@dataclass(frozen=True)
class Pair:
    """One touch, simulated and measured.

    Attributes:
        number: of the touch in its session.
        labels: name -> 0 or 1; None: a press of a bench, at one position.
        same: the very same touch is simulated, not one of the same labels.
        applied: force on the simulated skin, (T,), N; NaN in frames outside of the touch.
        simulated, measured: (T, S), N, at the model's rate.
        valid: (T, S), bool: sensors that work on both sides.
    """

    number: int
    labels: Mapping[str, int] | None
    same: bool
    applied: np.ndarray
    simulated: np.ndarray
    measured: np.ndarray
    valid: np.ndarray

    @property
    def thing(self) -> str:
        """What the touch is called."""
        return "press" if self.labels is None else "gesture"

    @cached_property
    def touched(self) -> np.ndarray:
        """Valid readings of the touch, (T, S), bool."""
        return self.valid & np.isfinite(self.applied)[:, None]

    @cached_property
    def sensors(self) -> tuple[int, int]:
        """The sensors that answer most, simulated and measured; of the same touch the former is both."""
        sides = (self.simulated, self.measured)
        first, second = (int(np.where(self.touched, side, -np.inf).max(axis=0).argmax()) for side in sides)
        return first, first if self.same else second

    @cached_property
    def measures(self) -> dict[str, float]:
        """The largest force and the largest readings of ``sensors``, N; measured over simulated; RMSE, N.

        The ratio is that of all readings of the sensor, through 0, or of the largest readings if the touches
        differ.
        """
        sides = zip((self.simulated, self.measured), self.sensors, strict=True)
        x, y = (side[self.touched[:, sensor], sensor] for side, sensor in sides)
        return {
            "force": float(np.nanmax(self.applied)),
            "simulated": float(x.max()),
            "recorded": float(y.max()),
            "ratio": float(x @ y / (x @ x) if self.same else y.max() / x.max()),
            "rmse": float(np.sqrt(np.mean((self.simulated - self.measured)[self.touched] ** 2))),
        }


@dataclass(frozen=True)
class SessionComparison:
    """The touches of a session beside their simulation.

    Attributes:
        things: ``presses`` or ``gestures``.
        pairs: touch by touch.
        touches: both sides as a model sees them, simulated and measured.
        bench: of which the presses are; None of gestures.
    """

    things: str
    pairs: Sequence[Pair]
    touches: Sequence[Touches]
    bench: BenchData | None = None


def compare_session(
    device: Simulated, path: str, presses: str | None, settings: Mapping[str, Any]
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
    if presses is None and Path(path).expanduser().is_dir():
        return compare_gestures(device, path, settings["seed"])
    files = BenchSettings.of(settings, "compare")
    session = read_bench_session(path, files, presses)
    calibration = device.imperfection.calibration
    if calibration is not None and calibration.channels and session.channels is None:
        session = replace(session, raw=session.raw[:, list(calibration.channels)])
    if session.gauge is not None:
        session = replace(session, gauge=session.gauge.turned(files.places, device.size))
    return compare_presses(device, build_bench_data(device, session), settings["scale"])


def compare_predictions(
    name: str, config: Config, comparison: SessionComparison, device: Simulated
) -> list[str]:
    """Return what a run predicts of both sides; print a warning if it learned another mechanics.

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
    simulated, measured = ((model.learner.probabilities(side) > 0.5).numpy() for side in comparison.touches)
    return describe_agreement(comparison, device.task.names, simulated, measured)


def describe_agreement(
    comparison: SessionComparison, names: Sequence[str], simulated: np.ndarray, measured: np.ndarray
) -> list[str]:
    """Return how often predictions (B, L), bool, are the same for both sides, and how often they are true."""
    count, same = len(simulated), (simulated == measured).sum(axis=0)
    lines = [
        f"- the run says the same of `{name}` on {number} of {count} {comparison.things}"
        for name, number in zip(names, same, strict=True)
    ]
    labels = [pair.labels for pair in comparison.pairs if pair.labels is not None]
    if labels:
        truth = np.array([[bool(row[name]) for name in names] for row in labels])
        right = zip(*((side == truth).sum(axis=0) for side in (simulated, measured)), strict=True)
        words = [f", and is right on {first} simulated and {second} recorded ones" for first, second in right]
        lines = [line + text for line, text in zip(lines, words, strict=True)]
    return lines


def compare_gestures(device: Simulated, path: str, seed: int) -> SessionComparison:
    """Return the gestures of a session beside their simulation.

    Announced gestures are those of an emulator: the same ones are simulated, on the device that is given.
    What a person did is not known but for its labels: gestures of the same labels are simulated.

    Args:
        device: with its imperfections, or its calibration.
        path: folder of skin record.
        seed: of the emulator, or of the gestures of the same labels.

    Raises:
        InputError: no session, no labels in it, another layout, window or rate, or another emulator's.
    """
    stored = read_session(Path(path).expanduser())
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(Path(path), stored.metadata, now)
    taken = [take for _, take in sorted(stored.gestures.items()) if take[0].labels is not None]
    if not taken:
        raise InputError(f"{path} has no gesture with labels: record it with device.labels=prompted")
    same = stored.metadata.get("labels") == "announced"
    labels = {gesture.number: dict(gesture.labels or {}) for gesture, _ in taken}
    if same:
        played = list(islice(emulated_gestures(device, seed), max(labels) + 1))
        gestures = [played[number] for number in labels]
        for gesture, (number, row) in zip(gestures, labels.items(), strict=True):
            if any(row.get(name, value) != value for name, value in gesture.labels.items()):
                raise InputError(
                    f"gesture {number} of the session is {label_text(row)}, the simulated one is "
                    f"{label_text(gesture.labels)}: give the emulator's settings and its emulate.seed as "
                    "compare.seed"
                )
    else:
        rows = np.array([[row[name] for name in TOUCH.names] for row in labels.values()])
        gestures = gestures_with_labels(device, rows, seed)
    recorded = [
        (*conversion(take.resampled.values, take.resampled.valid), gesture.applied)
        for (take, conversion), gesture in zip(taken, gestures, strict=True)
        if take.resampled is not None  # never of a stored gesture
    ]
    measured, received, applied = map(np.stack, zip(*recorded, strict=True))
    valid = received & ~device.constants.dead.numpy()
    simulated = _simulate_readings(device, gestures)
    pairs = [
        Pair(number, row, same, *sides)
        for (number, row), *sides in zip(labels.items(), applied, simulated, measured, valid, strict=True)
        if sides[1][sides[3]].any()
    ]
    if not pairs:
        raise InputError(f"{path} has no gesture with a sensor response: record more, or check the wiring")
    return SessionComparison("gestures", pairs, _touches(device, pairs))


def _simulate_readings(device: Simulated, gestures: Sequence[Gesture]) -> np.ndarray:
    """Return what a device reads in gestures above what it reads before them, (B, T, S), N."""
    force = np.stack([gesture.force for gesture in gestures])
    true = torch.from_numpy(np.pad(force, ((0, 0), (_IDLE, 0), (0, 0)))).float()
    noise = generator(Stream.NOISE, device.seed, Stream.TEST, 6)
    readings = device.imperfection.raw(true, device.constants, noise).double()
    return (readings[:, _IDLE:] - readings[:, :_IDLE].median(dim=1, keepdim=True).values).numpy()


def compare_presses(device: Simulated, bench: BenchData, scale: float | None) -> SessionComparison:
    """Simulate a session's presses on a device; idle medians are subtracted on both sides.

    Args:
        device: with its imperfections, or its calibration.
        bench: the session and what pressed it.
        scale: N per unit of the session; None: the calibration's, or 1 where the session is in N.

    Raises:
        InputError: nobody knows what a count is worth, or no press has frames.
    """
    session, calibration = bench.session, device.imperfection.calibration
    if scale is None:
        scale = 1.0 if session.unit == "N" else getattr(calibration, "scale", None)
    if scale is None:
        raise InputError(
            "the session is in counts: give device.calibration=FILE.yaml, or compare.scale=0.039"
        )
    noise = generator(Stream.NOISE, device.seed, Stream.TEST, 4)
    true, time = torch.from_numpy(bench.true)[None].float(), torch.from_numpy(session.time).float()
    simulated = device.imperfection.raw(true, device.constants, noise, time)[0].double().numpy()
    measured = session.raw * (scale * (1.0 if calibration is None else calibration.signs))
    working = ~device.constants.dead.numpy() & np.isfinite(measured[bench.idle]).any(axis=0)
    sides = np.stack([simulated, measured])
    idle = np.ma.median(np.ma.masked_invalid(sides[:, bench.idle]), axis=1, keepdims=True)
    sides -= np.ma.filled(idle, np.nan)
    received = np.isfinite(sides).all(axis=0) & working
    rate, window, gauge = device.model_rate, device.window, bench.gauge
    # In the middle of each frame of the model; its intervals end halfway between two frames of the session,
    # because a frame on the edge between two intervals could fall in either.
    times = gauge.time[gauge.first][:, None] + (np.arange(window) + 0.5) / rate
    ends = times[:, -1] + 0.5 / rate - 0.5 * float(np.median(np.diff(session.time)))
    rows = [
        [
            resample(session.time, np.where(received, side, 0.0), received, ~received, end, 1 / rate, window)
            for side in sides
        ]
        for end in ends
    ]
    pairs = []
    for number, (first, second) in enumerate(rows):
        force, press = gauge.at(times[number])
        if first.values[press == number].any():
            applied = np.where(press == number, force, np.nan)
            pairs.append(Pair(number, None, True, applied, first.values, second.values, first.valid))
    if not pairs:
        raise InputError("no press has frames in the session: check the clocks, see compare.delay")
    peaks = pressed_peaks(device.body, gauge.presses)
    contacts = torch.from_numpy(np.stack([gauge.contacts(times[pair.number], peaks) for pair in pairs]))
    touches = [replace(side, contacts=contacts.float()) for side in _touches(device, pairs)]
    return SessionComparison("presses", pairs, touches, bench)


def judge_presses(
    device: Simulated,
    bench: BenchData,
    scale: float | None,
    rate: float,
    alarms: Callable[[Sequence[NewtonFrame], np.ndarray | None], bool],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what :func:`skin.evaluation.guarantee.describe_presses` needs of the presses of a session.

    The pressure of a press is that of its picture under the gauge's force. It is on a sensor if it exceeds
    the limit at the centre of a valid one.

    Args:
        device: with its calibration, if any.
        bench: the session and what pressed it.
        scale: N per unit of the session; None: the calibration's, or 1.
        rate: of the model, Hz.
        alarms: as in :func:`skin.evaluation.guarantee.replay_presses`.

    Returns:
        The largest excess, that at valid sensors, multiples of the limit, and alarms, bool, (P,) each.

    Raises:
        InputError: the skin was never at rest before a press.
    """
    gauge, time, raw = bench.gauge, bench.session.time, bench.session.raw
    force, calibration = np.maximum.reduceat(gauge.force, gauge.first), device.imperfection.calibration
    end = np.maximum.reduceat(np.where(gauge.force > 0, gauge.time, -np.inf), gauge.first)
    settings, pressure = device.sampler.settings, force * pressed_peaks(device.body, gauge.presses)
    peak = settings.danger.excess(
        pressure, force, end - gauge.time[gauge.first] > settings.thresholds.duration
    )
    scale = 1.0 if scale is None and calibration is None else scale
    press = np.maximum(*(gauge.at(moment)[1] for moment in (time, time - RELEASE)))
    alarmed, works = replay_presses(
        alarms,
        lambda baseline, header: unit_conversion(raw.shape[1], baseline, scale, calibration, header),
        *(rate, time, raw, press, len(gauge)),
    )
    column, row = (device.sensors.positions[:, :2] / device.body.cell).astype(int).T
    shares = [image[0, row, column] / image.max() for image in pressed_images(device.body, gauge.presses)]
    return peak, peak * (np.stack(shares) * works).max(axis=1), alarmed


def _touches(device: Simulated, pairs: Sequence[Pair]) -> list[Touches]:
    """Return simulated and measured readings as a model sees them: 0 where not valid."""
    valid, positions = np.stack([pair.valid for pair in pairs]), device.sensors.positions
    return [
        Touches(
            torch.from_numpy(np.where(valid, np.stack(side), 0.0)).float(),
            torch.from_numpy(valid),
            torch.from_numpy(positions).float(),
            None,
            device.model_rate,
        )
        for side in zip(*((pair.simulated, pair.measured) for pair in pairs), strict=True)
    ]


def publish_comparison(
    comparison: SessionComparison, agreement: Sequence[str], description: str, count: int, folder: Path
) -> list[Path]:
    """Write ``compare.md`` and ``compare.png`` into a folder, each whole; return their paths.

    Args:
        comparison: the touches.
        agreement: lines of :func:`compare_predictions`; none without a run.
        description: a sentence on where this came from.
        count: how many touches the figure shows.
        folder: of the files.
    """
    page = write(_page(comparison, agreement, description), folder / "compare.md")
    return [page, save_figure(_figure(comparison, count), folder / "compare.png")]


def _page(comparison: SessionComparison, agreement: Sequence[str], description: str) -> str:
    """Return a page in Markdown."""
    pairs, things, same = comparison.pairs, comparison.things, comparison.pairs[0].same
    table = pd.DataFrame([pair.measures for pair in pairs])
    low, middle, high = table["ratio"].quantile([0.25, 0.5, 0.75])
    if same:
        simulated, recorded = table[["simulated", "recorded"]].div(table["force"], axis=0).median()
        errors = (
            f"- RMSE of readings: {np.sqrt((table['rmse'] ** 2).mean()):.3f} N\n"
            f"- largest reading per applied force: {simulated:.1%} simulated, {recorded:.1%} recorded "
            "(the report's skin: about 5 %)"
        )
    else:
        errors = "- what a person did is known by its labels only, so frames are not compared one by one"
    names = [
        f"{pair.number}: {label_text(pair.labels)}" if pair.labels else f"{pair.number}" for pair in pairs
    ]
    rows = [
        f"| {name} | {pair.sensors[0]} | {row.force:.1f} | {row.simulated:.2f} | {row.recorded:.2f} | "
        f"{row.ratio:.3f} | {f'{row.rmse:.3f}' if same else ''} |"
        for name, pair, row in zip(names, pairs, table.itertuples(), strict=True)
    ]
    title = f"The same {things}" if same else f"{things.capitalize()} of the same labels"
    lines = [
        f"# {title}, simulated and recorded\n",
        f"{description}\n",
        "![force and reading](compare.png)\n",
        f"- {things}: {len(pairs)}",
        f"- gain ratio of {'readings' if same else 'largest readings'} (recorded over simulated), median: "
        f"{middle:.3f}, middle half {low:.3f} to {high:.3f}",
        errors,
        *agreement,
        f"\n| {pairs[0].thing} | sensor | force, N | simulated, N | recorded, N | ratio | RMSE, N |",
        "|---" * 7 + "|",
        *rows,
    ]
    return "\n".join(lines) + "\n"


def _figure(comparison: SessionComparison, count: int) -> Figure:
    """Draw applied force and reading, simulated above, measured below, of the ``count`` strongest touches."""
    strongest = sorted(comparison.pairs, key=lambda pair: -pair.measures["simulated"])[:count]
    figure = Figure(figsize=(3.6 * len(strongest), 5.4), layout="constrained")
    axes = figure.subplots(2, len(strongest), squeeze=False, sharex="col")
    time = np.arange(len(strongest[0].applied)) / comparison.touches[0].rate
    for column, pair in zip(axes.T, strongest, strict=True):
        top = max(pair.measures["simulated"], pair.measures["recorded"])
        sides = zip(
            column, ("simulated", "recorded"), (pair.simulated, pair.measured), pair.sensors, strict=True
        )
        for axis, name, values, sensor in sides:
            if name == "simulated" or pair.same:
                axis.plot(time, pair.applied, color=COLOURS[0])
                axis.set_ylabel("applied force, N", color=COLOURS[0])
            twin = axis.twinx()
            twin.plot(time, values[:, sensor], ".-", color=COLOURS[4], linewidth=1, markersize=3)
            twin.set_ylabel("reading, N", color=COLOURS[4])
            twin.set_ylim(-0.05 * top, 1.1 * top)
            axis.set_title(f"{name}, {pair.thing} {pair.number}, sensor {sensor}", fontsize=9)
        column[1].set_xlabel("time, s")
    return figure
