"""Measures of a study: they evaluate a finished run on a device that a condition may change.

They import heavy packages when called, so that errors in their settings are reported early.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from annotated_types import Ge, Gt, MinLen

from skin.errors import InputError
from skin.evaluation.settings import StreamSettings, check_evaluation

if TYPE_CHECKING:
    import numpy as np
    from mlflow.entities import Run
    from torch import Tensor

    from experiments.studies.pages import Page
    from skin.device.base import AbstractDevice
    from skin.evaluation.operating_point import OperatingPoint
    from skin.learning.learner import AbstractLearner
    from skin.runs.configuration import Config
    from skin.runs.model_of_run import RunModel

_COUNTED = 1_000_003  # seed of the touches that are counted, which chose no threshold


@dataclass(frozen=True)
class Subject:
    """The subject of a measure.

    Attributes:
        config: of the run, with the changes of the condition; that of the command without a run.
        device: as ``config`` describes it.
        run: as MLflow has it; None where a study has no runs.
        model: what the run learned, and the device that it was trained on.
    """

    config: "Config"
    device: "AbstractDevice"
    run: "Run | None" = None
    model: "RunModel | None" = None

    @property
    def trained(self) -> "RunModel":
        """What the run learned.

        Raises:
            InputError: there is no run.
        """
        if self.model is None:
            raise InputError("this study needs a finished run: study.run=latest, or study.rows=[features]")
        return self.model

    @property
    def title(self) -> str:
        """The name of the run, for pages and figures."""
        run = self.run
        assert run is not None
        # As in the published tables; the id of a run differs between databases.
        return f"{run.info.run_name}, run {run.data.tags.get('fingerprint', run.info.run_id)[:8]}"

    @property
    def learner(self) -> "AbstractLearner":
        """What the run learned."""
        return self.trained.learner

    def point(self) -> "OperatingPoint":
        """Return where the run raises the alarm on this device."""
        from skin.evaluation.operating_point import OperatingPoint
        from skin.runs.model_of_run import alarm_point

        run = self.trained.run
        point = self.trained.point if run is None else alarm_point(run, self.learner, self.config)
        return point or OperatingPoint.default(check_evaluation(self.config.evaluation).false_alarm_rate)


@dataclass(frozen=True)
class Measurement:
    """The result of a measure.

    Attributes:
        metrics: name -> value; shares are of 1.
        page: what is published; None where the metrics tell everything.
        outcomes: of each test gesture (:func:`skin.evaluation.metrics.encode`); None: not known.
        cannot: why the learner does not accept the touches; empty where it does.
    """

    metrics: dict[str, float]
    page: "Page | None" = None
    outcomes: "np.ndarray | None" = None
    cannot: str = ""


class StudyMeasure(Protocol):
    """A frozen dataclass of settings that measures."""

    def __call__(self, subject: Subject) -> Measurement:
        """Measure; InputError where the device or the learner cannot be measured so."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy and the like on the test touches, and alarms at the operating point of the run."""

    def __call__(self, subject: Subject) -> Measurement:
        from skin.evaluation.metrics import compute_metrics, encode

        touches = subject.device.touches("test")
        task = subject.device.task
        try:
            chances = subject.learner.probabilities(touches)
        except InputError as reason:  # another number of sensors, for example
            return Measurement({}, cannot=str(reason))
        point = subject.point() if subject.trained.point else None
        values = compute_metrics(chances, touches.known_labels, task, point)
        outcomes = encode(chances, touches.known_labels, task, point)
        return Measurement({f"same/{name}": value for name, value in values.items()}, outcomes=outcomes)


@dataclass(frozen=True)
class Margins:
    """Errors by the distance from the thresholds of the labels.

    Groups predictions by area, travel, duration and pressure relative to their thresholds, and by the largest
    reading.

    Args:
        gestures: number of test touches.
    """

    gestures: Annotated[int, Ge(1)] = 20000

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.pages import margins_page
        from skin.evaluation.margins import measure_margins

        report = measure_margins(subject.learner, subject.device, self.gestures, subject.point())
        return Measurement(report.metrics, margins_page(report, subject.title))


class Streams(StreamSettings):
    """False alarms per hour of a stream, and accuracy by the share of a touch that a window shows."""

    def __call__(self, subject: Subject) -> Measurement:
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.pages import streams_page
        from skin.evaluation.streams import evaluate_windows

        console = Console(stderr=True)
        progress = partial(track, description=subject.title, console=console, transient=True)
        report = evaluate_windows(subject.learner, subject.device, self, subject.point(), progress)
        return Measurement(report.metrics(), streams_page(report, subject.title))


@dataclass(frozen=True)
class Holds:
    """Delay of the alarm, and whether it persists during a held press.

    Feeds dangerous taps, presses, holds of 1 s to 10 min and slow ramps to the engine of ``skin live``, in
    simulated time.

    Args:
        gestures: number of taps, presses, short holds and ramps; a tenth of it of those of ten minutes.
        rate: of the device, Hz.
        touch: as ``live.touch``, N.
        drift: as ``live.drift``, N in ten minutes.
    """

    gestures: Annotated[int, Ge(1)] = 40
    rate: Annotated[float, Gt(0)] = 100.0
    touch: Annotated[float, Gt(0)] | None = None
    drift: Annotated[float, Ge(0)] = 0.2

    def __call__(self, subject: Subject) -> Measurement:
        from rich.progress import track

        from experiments.studies.alarm_timing import FIELDS, time_courses
        from experiments.studies.pages import Page
        from skin.hardware.live import engine_builder
        from skin.hardware.live.engine import DebounceSettings
        from skin.runs.model_of_run import load_model

        run = subject.trained.run
        assert run is not None  # it was loaded
        model = load_model(run, subject.config)
        engine = engine_builder.engine_settings(model, DebounceSettings(), self.touch, self.drift).build()
        device = model.device.simulated("held touches are simulated").replace(stream=False)
        table = [
            FIELDS,
            *time_courses(engine, device, self.gestures, self.rate, partial(track, transient=True)),
        ]
        courses = (zip(FIELDS, values, strict=True) for values in table[1:])
        lines = [", ".join(f"{name} {value}" for name, value in line if value) for line in courses]
        return Measurement({}, Page("\n".join(lines), {"Time to alarm": table}, table))


@dataclass(frozen=True)
class TouchAlarms:
    """False alarms and recall per touch, as the live view raises alarms, beside those of single windows.

    Thresholds are chosen on other touches of the same device than those that are counted.

    Args:
        safe, dangerous: number of touches that are counted.
    """

    safe: Annotated[int, Ge(1)] = 10000
    dangerous: Annotated[int, Ge(1)] = 2000

    def __call__(self, subject: Subject) -> Measurement:
        import numpy as np

        from experiments.studies.pages import Page
        from skin.core.rng import Stream, generator
        from skin.evaluation.operating_point import (
            LABEL,
            SAFE_TOUCHES,
            Reached,
            choose_for_touches,
            choose_operating_point,
            touch_scores,
        )
        from skin.hardware.live.engine import DebounceSettings
        from skin.touch.labels import TOUCH

        trained, settings = subject.trained, check_evaluation(subject.config.evaluation)
        device = subject.device.simulated("touches are simulated")
        patience = DebounceSettings().alarm
        rate = float(np.ravel(device.rate)[0])
        aligned = rate <= device.model_rate
        watching = trained.watching(rate, patience, aligned)
        at_once = trained.watching(rate, 0.0, aligned)
        target = settings.false_alarm_rate
        touch = choose_for_touches(subject.learner, device, watching, target)
        window = choose_operating_point(subject.learner, device, settings)
        assert window is not None  # it has the label
        labels = device.sampler.balanced(2 * max(self.safe, self.dangerous), generator(Stream.TEST, 7))
        danger = labels[:, TOUCH.names.index(LABEL)]
        counted = np.concatenate([labels[~danger][: self.safe], labels[danger][: self.dangerous]])
        scores = touch_scores(subject.learner, device, watching, counted, _COUNTED)
        few = min(self.safe, SAFE_TOUCHES)
        single = touch_scores(subject.learner, device, at_once, counted[:few], _COUNTED)
        tests = device.touches("test")
        chances = subject.learner.probabilities(tests)
        metrics, lines = dict[str, float](), list[str]()
        alarms = touch.alarm(scores)
        alarms_of = {
            "touch": Reached(
                self.dangerous, int(alarms[self.safe :].sum()), self.safe, int(alarms[: self.safe].sum())
            ),
            "window": window.reached(chances, tests.known_labels, trained.device.task),
            "touch_at_window_threshold": Reached(0, 0, few, int(window.alarm(single).sum())),
        }
        for name, reached in alarms_of.items():
            low, high = reached.range
            metrics |= {f"{name}/false_alarm_rate": reached.false_alarm_rate}
            metrics |= {f"{name}/false_alarm_low": low, f"{name}/false_alarm_high": high}
            metrics |= {f"{name}/recall": reached.recall} if reached.dangerous else {}
            lines.append(f"{name}: {reached.sentence()}")
        metrics |= {"touch/threshold": touch.threshold, "window/threshold": window.threshold}
        return Measurement(metrics, Page("\n".join(lines), {}, []))


@dataclass(frozen=True)
class Motion:
    """How far touches change the distances of neighbouring sensors; needs no run.

    Args:
        gestures: number of gestures.
        count: neighbours of a sensor are its nearest so many (``representation.count``).
    """

    gestures: Annotated[int, Ge(1)] = 1000
    count: Annotated[int, Ge(1)] = 6

    def __call__(self, subject: Subject) -> Measurement:
        import numpy as np
        import torch

        from experiments.studies.pages import Page
        from skin.core.rng import Stream, generator
        from skin.learning.graph import neighbours

        device = subject.device.simulated("motions of sensors are simulated")
        positions = torch.tensor(device.sensors.positions)
        if len(positions) < 2:
            raise InputError("one sensor has no neighbours whose distance could change: add sensors")
        pairs = np.nonzero(np.triu(neighbours(device.sensors.positions, "knn", self.count)))
        movie = device.sampler.sample(self.gestures, generator(Stream.TEST, 8))
        motion = device.model.motion(movie.frames)[movie.index] * movie.scale[..., None, None]
        changes = distance_changes(positions, motion[motion.flatten(2).any(dim=-1)], *pairs)
        largest, quantile = float(changes.max()), float(np.quantile(changes, 0.99))
        return Measurement(
            {"distance/largest": largest, "distance/quantile": quantile},
            Page(
                f"Over {self.gestures} gestures neighbours change their distance by {largest:.2%} at most, "
                f"99 % quantile {quantile:.2%} of pairs and frames in contact."
            ),
        )


def distance_changes(
    positions: "Tensor", motion: "Tensor", first: "np.ndarray", second: "np.ndarray"
) -> "Tensor":
    """Return relative changes of the distance of pairs of sensors, (..., P), without sign.

    Args:
        positions: of the sensors at rest (S, 3), m.
        motion: of the sensors (..., S, 3), m.
        first, second: sensors of each pair (P,).
    """
    rest, moved = (
        (places[..., first, :] - places[..., second, :]).norm(dim=-1)
        for places in (positions, positions + motion)
    )
    return (moved / rest - 1).abs()


@dataclass(frozen=True)
class ProbeSettings:
    """What is probed; ``conf/study/embeddings.yaml`` explains the fields."""

    attributes: Annotated[Sequence[Literal["degree", "reading"]], MinLen(1)] = ("degree", "reading")
    train: Annotated[int, Ge(20)] = 800
    test: Annotated[int, Ge(10)] = 400
    seeds: Annotated[Sequence[int], MinLen(1)] = (0, 1, 2)
    layouts: Annotated[int, Ge(1)] = 3
    levels: Annotated[int, Ge(2)] = 8
    depth: Annotated[int, Ge(0)] = 2
    width: Annotated[int, Ge(2)] = 128
    epochs: Annotated[int, Ge(1)] = 50
    graph: Mapping[str, Any] = field(default_factory=lambda: {"edges": "knn", "count": 6, "weight": "exp"})


class Embeddings(ProbeSettings):
    """Accuracy of an SVM on graph embeddings, readings, and the encoder of a run, if one is given."""

    def __call__(self, subject: Subject) -> Measurement:
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.embeddings import build_embeddings_page, probe
        from skin.device.balance import report_balance

        device, learner = subject.device, subject.learner if subject.model else None
        report_balance(device)
        count = (len(self.attributes) * 3 + (learner is not None) + 2) * len(self.seeds)
        steps = probe(device, self, learner)
        results = list(track(steps, "probing", count, console=Console(stderr=True)))
        return Measurement({}, build_embeddings_page(results, device.task.names))
