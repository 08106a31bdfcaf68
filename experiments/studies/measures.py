"""Measures of a study: they evaluate a finished run on a device that a condition may change.

They import heavy packages when called, so that errors in their settings are reported early.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

from annotated_types import Ge, Gt

from experiments.studies.embedding.probe_settings import ProbeSettings
from experiments.studies.subject import Measurement, Subject
from skin.errors import InputError
from skin.evaluation.stream_settings import StreamSettings

_COUNTED = 1_000_003  # seed of the touches that are counted, which chose no threshold


@dataclass(frozen=True)
class Accuracy:
    """Accuracy and the like on the test touches, and alarms at the operating point of the run."""

    def __call__(self, subject: Subject) -> Measurement:
        from skin.evaluation.metrics import metrics
        from skin.evaluation.outcomes import encode

        touches = subject.device.touches("test")
        assert touches.labels is not None
        task = subject.device.task
        point = subject.point() if subject.of.trained.point else None
        try:
            chances = subject.learner.probabilities(touches)
        except InputError as reason:  # another number of sensors, for example
            return Measurement({}, cannot=str(reason))
        found = metrics(chances, touches.labels, task, point)
        outcomes = encode(chances, touches.labels, task, point)
        return Measurement({f"same/{name}": value for name, value in found.items()}, outcomes=outcomes)


@dataclass(frozen=True)
class SelfShare:
    """How much of its own row a node of the run's graph is (:func:`skin.representation.graph.self_share`)."""

    def __call__(self, subject: Subject) -> Measurement:
        from skin.build import build_data
        from skin.representation.graph import self_share

        data = build_data(subject.config, subject.device)
        graph = data.representation_for(data.example.positions)
        return Measurement({"self_share": self_share(graph.adjacency)})  # type: ignore[arg-type]


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
        from experiments.studies.margins_page import build_margins_page
        from skin.evaluation.margins import margins

        found = margins(subject.learner, subject.device, self.gestures, subject.point())
        return Measurement(found.metrics, build_margins_page(found, subject.title))


class Streams(StreamSettings):
    """False alarms per hour of a stream, and accuracy by the share of a touch that a window shows."""

    def __call__(self, subject: Subject) -> Measurement:
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.streams_page import build_streams_page
        from skin.evaluation.sliding_windows import evaluate_windows

        console = Console(stderr=True)
        shown = partial(track, description=subject.title, console=console, transient=True)
        found = evaluate_windows(subject.learner, subject.device, self, subject.point(), shown)
        return Measurement(found.metrics(), build_streams_page(found, subject.title))


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

        from experiments.studies.tables import Page
        from skin.hardware.live import engine_builder
        from skin.hardware.live.alarm_timing import FIELDS, time_courses
        from skin.hardware.live.verdict import DebounceSettings
        from skin.model_of_run import load_model

        run = subject.of.trained.run
        assert run is not None  # it was loaded
        of = load_model(run, subject.config)
        engine = engine_builder.engine_settings(of, DebounceSettings(), self.touch, self.drift).build()
        device = of.device.simulated("held touches are simulated").replace(stream=False)
        table = [
            FIELDS,
            *time_courses(engine, device, self.gestures, self.rate, partial(track, transient=True)),
        ]
        told = (zip(FIELDS, values, strict=True) for values in table[1:])
        lines = [", ".join(f"{name} {value}" for name, value in line if value) for line in told]
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

        from experiments.studies.tables import Page
        from skin.evaluation import touch_alarm
        from skin.evaluation.alarm import Reached
        from skin.evaluation.operating_point import LABEL, choose_operating_point
        from skin.evaluation.touch_alarm import choose_for_touches, touch_scores
        from skin.hardware.live.verdict import DebounceSettings
        from skin.labels import TOUCH
        from skin.rng import Stream, generator
        from skin.touch.sampler import balanced

        of, settings = subject.of.trained, subject.config.evaluation
        device = subject.device.simulated("touches are simulated")
        patience = DebounceSettings().alarm
        aligned = device.rate <= device.model_rate
        watching = of.watching(device.rate, patience, aligned)
        one = of.watching(device.rate, 0.0, aligned)
        target = settings.false_alarm_rate
        touch = choose_for_touches(subject.learner, device, watching, target)
        window = choose_operating_point(subject.learner, device, settings)
        assert window is not None  # it has the label
        labels = balanced(2 * max(self.safe, self.dangerous), generator(Stream.TEST, 7))
        danger = labels[:, TOUCH.names.index(LABEL)]
        wanted = np.concatenate([labels[~danger][: self.safe], labels[danger][: self.dangerous]])
        scores = touch_scores(subject.learner, device, watching, wanted, _COUNTED)
        few = min(self.safe, touch_alarm.SAFE)
        single = touch_scores(subject.learner, device, one, wanted[:few], _COUNTED)
        tests = device.touches("test")
        chances = subject.learner.probabilities(tests)
        metrics, lines = dict[str, float](), list[str]()
        alarms = touch.alarm(scores)
        found = {
            "touch": Reached(
                self.dangerous, int(alarms[self.safe :].sum()), self.safe, int(alarms[: self.safe].sum())
            ),
            "window": window.reached(chances, tests.known_labels, of.device.task),
            "touch_at_window_threshold": Reached(0, 0, few, int(window.alarm(single).sum())),
        }
        for name, reached in found.items():
            low, high = reached.range
            metrics |= {f"{name}/false_alarm_rate": reached.false_alarm_rate}
            metrics |= {f"{name}/false_alarm_low": low, f"{name}/false_alarm_high": high}
            metrics |= {f"{name}/recall": reached.recall} if reached.dangerous else {}
            lines.append(f"{name}: {reached.sentence()}")
        metrics |= {"touch/threshold": touch.threshold, "window/threshold": window.threshold}
        return Measurement(metrics, Page("\n".join(lines), {}, []))


@dataclass(frozen=True)
class Motion:
    """Displacements of sensors under touches, and how well readings predict them; needs no run.

    Args:
        gestures: number of test gestures.
    """

    gestures: Annotated[int, Ge(1)] = 1000

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.motion import motion_change
        from experiments.studies.tables import Page

        device = subject.device.simulated("how sensors move is known in simulation only")
        found = motion_change(device, self.gestures)
        return Measurement({}, Page(f"Over {self.gestures} gestures {found.sentence}.\n\n{found.motion}"))


class Embeddings(ProbeSettings):
    """Accuracy of an SVM on graph embeddings, readings, and the encoder of a run, if one is given."""

    def __call__(self, subject: Subject) -> Measurement:
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.embedding.probe import probe
        from experiments.studies.embedding_spaces import build_embeddings_page
        from skin.class_balance import report_balance

        device, learner = subject.device, subject.learner if subject.finished else None
        report_balance(device)
        count = (len(self.attributes) * 3 + (learner is not None) + 2) * len(self.seeds)
        steps = probe(device, self, learner)
        found = list(track(steps, "probing", count, console=Console(stderr=True)))
        names = device.task.names
        return Measurement({}, build_embeddings_page(found, names))


@dataclass(frozen=True)
class UnseenSkins:
    """Accuracy on each of the skins that ``device=skins`` tests on.

    Args:
        gestures: number of touches on each.
    """

    gestures: Annotated[int, Ge(1)] = 1000

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.unseen_skins import measure_unseen_skins

        return measure_unseen_skins(subject, self.gestures)


@dataclass(frozen=True)
class Adaptation:
    """Accuracy after fine-tuning on the gestures of a device, beside rows that are trained on them.

    Args:
        rows: names of experiments.
        epochs: of their trainings; None: those of the experiments.
        adapt: settings of the fine-tuning that differ from ``conf/adapt.yaml``.
    """

    rows: Sequence[str] = ("features", "best")
    epochs: Annotated[int, Ge(1)] | None = None
    adapt: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, subject: Subject) -> Measurement:
        from experiments.studies.adaptation_curve import measure_adaptation

        return measure_adaptation(subject, self.rows, self.epochs, self.adapt)
