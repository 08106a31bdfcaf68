"""Measures of a study, and what they measure: a finished run on a device that a condition may change.

A measure is a frozen dataclass of settings that maps a :class:`Subject` to a data frame, with a row for each
touch or condition, or a single row of metrics. ``attrs`` of the frame may have ``about`` (a text for a
person), ``metrics`` (name -> value, where the rows are something else), and ``cannot`` (why the learner does
not accept the touches). A measure may have ``page(frame, title)``.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from annotated_types import Ge
from hydra.utils import instantiate
from torch import Tensor

from experiments.studies.pages import Page, Panel, draw_panels
from skin.core.rng import Stream, generator
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated
from skin.device.touches import Recording
from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.metrics import compute_metrics, encode
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.report import ALARM_NAME, measure_margins
from skin.evaluation.settings import StreamSettings, check_evaluation
from skin.evaluation.streams import WindowReport, evaluate_windows
from skin.learning.graph import neighbours
from skin.learning.learner import AbstractLearner
from skin.runs.build import TorchModel, alarm_source, build_device, load_run
from skin.runs.configuration import Config
from skin.touch.labels import TOUCH


@dataclass(frozen=True)
class Subject:
    """The subject of a measure.

    Attributes:
        config: of the run, with the changes of the condition; that of the command without a run.
        model: what the run learned, and the device that it was trained on; None where a study has no runs.
        condition: name.
        changes: overrides of the condition.
    """

    config: Config
    model: TorchModel | None = None
    condition: str = ""
    changes: Sequence[str] = ()

    @cached_property
    def device(self) -> AbstractDevice:
        """The device that ``config`` describes."""
        return build_device(self.config)

    @property
    def trained(self) -> TorchModel:
        """What the run learned.

        Raises:
            InputError: there is no run.
        """
        if self.model is None:
            raise InputError("this study needs a finished run: study.run=latest, or study.rows=[features]")
        return self.model

    @property
    def learner(self) -> AbstractLearner:
        """What the run learned."""
        return self.trained.learner

    def load(self, name: str) -> Any:
        """Return a finished run, pretrained model or exported one for the skin of the configuration."""
        if name.endswith(".onnx"):
            return load_run(name)
        return load_run(name, body=instantiate(self.config.body), layout=instantiate(self.config.layout))

    def point(self) -> OperatingPoint:
        """Return where the run raises the alarm on this device."""
        run, point = self.trained.run, self.trained.point
        if run is not None:
            point = choose_alarm_threshold(alarm_source(run, self.learner, self.config))
        return point or OperatingPoint(0.5, check_evaluation(self.config.evaluation).false_alarm_rate)


StudyMeasure = Callable[[Subject], pd.DataFrame]
"""A frozen dataclass of settings that measures; InputError where the device or learner cannot be measured."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy and the like on the test touches, and alarms at the operating point of the run."""

    def __call__(self, subject: Subject) -> pd.DataFrame:
        touches, task = subject.device.touches("test"), subject.device.task
        try:
            probabilities = subject.learner.probabilities(touches)
        except InputError as reason:  # another number of sensors, for example
            frame = pd.DataFrame([{"outcomes": None}])
            frame.attrs["cannot"] = str(reason)
            return frame
        point = subject.point() if subject.trained.point else None
        scored = probabilities, touches.known_labels, task, point
        codes, metrics = encode(*scored), compute_metrics(*scored)
        outcomes = {"outcomes": None if codes is None else codes.tobytes()}
        return pd.DataFrame([{f"same/{name}": value for name, value in metrics.items()} | outcomes])


@dataclass(frozen=True)
class Margins:
    """Errors by the distance from the thresholds of the labels.

    Groups predictions by area, travel, duration and pressure relative to their thresholds, and by the largest
    reading.

    Args:
        gestures: number of test touches.
    """

    gestures: Annotated[int, Ge(1)] = 20000

    def __call__(self, subject: Subject) -> pd.DataFrame:
        point = subject.point()
        frame, reached = measure_margins(subject.learner, subject.device, self.gestures, point)
        frame.attrs["about"] = f"{point.sentence()}; {reached.sentence()}"
        return frame

    def page(self, frame: pd.DataFrame, title: str) -> Page:
        """Return the page of a run: said against measure over threshold, errors by reading."""
        data = frame.drop(columns=["mean", "lower", "upper"])
        groups = dict([*data.groupby(["label", "by"], sort=False)])
        spans, faint = (dict([*frame[frame.by == by].groupby("label")]) for by in ("threshold", "reading"))
        columns, scale = ["mean", "y", "lower", "upper"], [[1], [100], [100], [100]]
        called = {
            name: lines.assign(y=lines.said.astype(int) / lines.touches)[columns].to_numpy().T * scale
            for name in ("big", "dangerous", ALARM_NAME)
            for lines in [spans[name]]
        }
        wrong = {name: 100 * faint[name].wrong / faint[name].touches for name in TOUCH.names}
        ticks = [
            f"above {row.low}\n{row.touches}"
            if row.high == "inf"
            else f"{row.low} to {row.high}\n{row.touches}"
            for row in faint["big"].itertuples()
        ]
        label = "area (big) or pressure (dangerous) over its threshold"
        courses = {name: np.stack([np.arange(len(line)), line]) for name, line in wrong.items()}
        panels = [
            Panel(label, "touches called so, %, with 95 %", called, limits=(0.4, 2.5)),
            Panel("highest reading above idle, N; touches", "wrong, %", courses, ticks=ticks),
        ]
        tables = {" by ".join(key): group.iloc[:, 2:].astype(str) for key, group in groups.items()}
        return Page(frame.attrs["about"], tables, data, draw_panels(title, panels))


class Streams(StreamSettings):
    """False alarms per hour of a stream, and accuracy by the fraction of a touch that a window shows."""

    def __call__(self, subject: Subject) -> pd.DataFrame:
        return streams_frame(evaluate_windows(subject.learner, subject.device, self, subject.point()))

    def page(self, frame: pd.DataFrame, title: str) -> Page:
        """Return the page of a run."""
        tables = {}
        for measure, group in frame.groupby("measure", sort=False):
            table = group.pivot(index="name", columns="at", values="value").fillna("")
            tables[measure] = table.reindex(columns=group["at"].unique()).reset_index()
        return Page(frame.attrs["about"], tables, frame)


def streams_frame(report: WindowReport) -> pd.DataFrame:
    """Return every figure of an evaluation on streams, as texts: measure, name, at, value."""
    rows: list[Sequence[object]] = []
    for part in report.bins:
        rows.append(["windows", "", part.name, part.count])
        rows += (["accuracy", name, part.name, f"{v:.4f}"] for name, v in part.accuracy.items())
        rows += (["majority", name, part.name, f"{v:.4f}"] for name, v in part.majority.items())
    cells = ("idle said idle", "idle said touched", "touched said idle", "touched said touched")
    for gate, counts in report.gates.items():
        rows += ([cell, gate, "", int(n)] for cell, n in zip(cells, counts.flatten(), strict=True))
    parts = list[str]()
    for gate, alarms in report.alarms.items():
        rows += ([f"alarms {name}", gate, "", value] for name, value in vars(alarms).items())
        low, high = alarms.range
        parts.append(
            f"gate {gate}: {alarms.per_hour:.1f} ({low:.1f} to {high:.1f}) false alarms per hour without "
            f"touch, {alarms.found} of {alarms.dangerous} dangerous touches and {alarms.raised} of "
            f"{alarms.safe} safe ones raised the alarm"
        )
    rows += [
        ["threshold, N", "threshold", "", f"{report.threshold:.4f}"],
        ["stream, h", "", "", report.hours],
    ]
    rows += (["window, s", "overall", f"{window:g}", value] for window, value in report.lengths.items())
    parts.append(report.point.sentence())
    frame = pd.DataFrame(rows, columns=["measure", "name", "at", "value"]).map(str)
    frame.attrs |= {"metrics": report.metrics(), "about": "; ".join(parts)}
    return frame


@dataclass(frozen=True)
class Motion:
    """How far touches change the distances of neighbouring sensors; needs no run.

    Args:
        gestures: number of gestures.
        count: neighbours of a sensor are its nearest so many (``representation.count``).
    """

    gestures: Annotated[int, Ge(1)] = 1000
    count: Annotated[int, Ge(1)] = 6

    def __call__(self, subject: Subject) -> pd.DataFrame:
        device = subject.device.simulated("motions of sensors are simulated")
        positions = torch.tensor(device.sensors.positions)
        if len(positions) < 2:
            raise InputError("one sensor has no neighbours whose distance could change: add sensors")
        pairs = np.nonzero(np.triu(neighbours(device.sensors.positions, "knn", self.count)))
        movie = device.sampler.sample(self.gestures, generator(Stream.TEST, 8))
        motion = device.model.motion(movie.frames)[movie.index] * movie.scale[..., None, None]
        changes = distance_changes(positions, motion[motion.flatten(2).any(dim=-1)], *pairs)
        largest, quantile = float(changes.max()), float(np.quantile(changes, 0.99))
        frame = pd.DataFrame([{"distance/largest": largest, "distance/quantile": quantile}])
        frame.attrs["about"] = (
            f"Over {self.gestures} gestures neighbours change their distance by {largest:.2%} at most, "
            f"99 % quantile {quantile:.2%} of pairs and frames in contact."
        )
        return frame


def distance_changes(positions: Tensor, motion: Tensor, first: np.ndarray, second: np.ndarray) -> Tensor:
    """Return relative changes of the distance of pairs of sensors, (..., P), without sign.

    Args:
        positions: of the sensors at rest (S, 3), m.
        motion: of the sensors (..., S, 3), m.
        first, second: sensors of each pair (P,).
    """
    rest, moved = (
        (points[..., first, :] - points[..., second, :]).norm(dim=-1)
        for points in (positions, positions + motion)
    )
    return (moved / rest - 1).abs()


def frozen_hash(recording: Recording, overrides: Sequence[str]) -> str:
    """Return a hash of what rounding does not change: overrides, labels, gestures and invalid readings.

    Args:
        recording: the touches of a set.
        overrides: of the set.
    """
    touches, names = recording.touches, ("shape", "duration", "onset", "draws")
    parts = [touches.known_labels.bool(), touches.valid, *(recording.parameters[name] for name in names)]
    content = ["\n".join(overrides).encode(), *(part.contiguous().numpy().tobytes() for part in parts)]
    return hashlib.sha256(b"".join(content)).hexdigest()[:16]


@dataclass(frozen=True)
class Frozen:
    """Accuracies of a predictor on a set.

    Args:
        predictor: a finished run or pretrained model, a file of ``skin export`` (for the sets of its layout),
            or ``package.module:function`` of readings (B, T, S), N, NaN where invalid, and positions (S, 3),
            m, that returns the probability of each label, (B, 4): big, dynamic, press, dangerous.
        hash: of the touches.
    """

    predictor: str = "any_skin"
    hash: str = ""

    def __call__(self, subject: Subject) -> pd.DataFrame:
        device = subject.device.simulated("frozen sets are simulated")
        if (predict := self._predict(subject, device)) is None:
            return pd.DataFrame()
        recording = device.recording("test", complete=False)
        if (present := frozen_hash(recording, subject.changes)) != self.hash:
            raise InputError(
                f"the touches of the set {subject.condition} have the hash {present}, and the frozen ones "
                f"{self.hash}: use the version of the package that they were frozen with"
            )
        touches = recording.touches
        labels = touches.known_labels
        readings = touches.readings.masked_fill(~touches.valid, torch.nan).numpy()
        probabilities = torch.as_tensor(np.asarray(predict(readings, device.sensors.positions), np.float32))
        if probabilities.shape != labels.shape or not probabilities.isfinite().all():
            raise InputError(
                f"a predictor returns finite probabilities {tuple(labels.shape)}, got "
                f"{tuple(probabilities.shape)}"
            )
        metrics = compute_metrics(probabilities, labels, device.task).items()
        accuracies = {key: round(100 * value, 2) for key, value in metrics if key.endswith("/accuracy")}
        start = {"set": subject.condition, "hash": present, "gestures": len(touches)}
        return pd.DataFrame([start | accuracies])

    def _predict(self, subject: Subject, device: Simulated) -> Callable[[np.ndarray, np.ndarray], Any] | None:
        """Return the predictor for the skin of a device; None: it was exported for another layout."""
        module, _, function = self.predictor.partition(":")
        if function:
            try:
                return getattr(import_module(module), function)
            except (ImportError, AttributeError) as error:
                raise InputError(f"predictor={self.predictor} cannot be imported: {error}") from error
        model = subject.load(self.predictor)
        same = model.positions.shape == device.sensors.positions.shape
        if not same or not np.allclose(model.positions, device.sensors.positions, atol=1e-6):
            return None
        return lambda readings, positions: model.predict(readings)
