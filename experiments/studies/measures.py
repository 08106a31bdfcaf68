"""Measures of a study: they evaluate a finished run on a device that a condition may change.

They import heavy packages when called, so that errors in their settings are reported early.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Gt, MinLen

from skin.errors import InputError
from skin.evaluation.settings import StreamSettings, check_evaluation

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from torch import Tensor

    from experiments.studies.pages import Page
    from experiments.studies.trials import Subject

_COUNTED = 1_000_003  # seed of the touches that are counted, which chose no threshold


@dataclass(frozen=True)
class Accuracy:
    """Accuracy and the like on the test touches, and alarms at the operating point of the run."""

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        import pandas as pd

        from skin.evaluation.metrics import compute_metrics, encode

        touches, task = subject.device.touches("test"), subject.device.task
        frame = pd.DataFrame([{"outcomes": None}])
        try:
            probabilities = subject.learner.probabilities(touches)
        except InputError as reason:  # another number of sensors, for example
            frame.attrs["cannot"] = str(reason)
            return frame
        point = subject.point() if subject.trained.point else None
        labels = touches.known_labels
        codes = encode(probabilities, labels, task, point)
        metrics = compute_metrics(probabilities, labels, task, point)
        return pd.DataFrame(
            [{f"same/{name}": value for name, value in metrics.items()}
             | {"outcomes": None if codes is None else codes.tobytes()}]
        )  # fmt: skip


@dataclass(frozen=True)
class Margins:
    """Errors by the distance from the thresholds of the labels.

    Groups predictions by area, travel, duration and pressure relative to their thresholds, and by the largest
    reading.

    Args:
        gestures: number of test touches.
    """

    gestures: Annotated[int, Ge(1)] = 20000

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        from experiments.studies.pages import margins_frame
        from skin.evaluation.margins import measure_margins

        return margins_frame(measure_margins(subject.learner, subject.device, self.gestures, subject.point()))

    def page(self, frame: "pd.DataFrame", title: str) -> "Page":
        """Return the page of a run."""
        from experiments.studies.pages import margins_page

        return margins_page(frame, title)


class Streams(StreamSettings):
    """False alarms per hour of a stream, and accuracy by the fraction of a touch that a window shows."""

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.pages import streams_frame
        from skin.evaluation.streams import evaluate_windows

        console = Console(stderr=True)
        progress = partial(track, description="streams", console=console, transient=True)
        return streams_frame(
            evaluate_windows(subject.learner, subject.device, self, subject.point(), progress)
        )

    def page(self, frame: "pd.DataFrame", title: str) -> "Page":
        """Return the page of a run."""
        from experiments.studies.pages import streams_page

        return streams_page(frame, title)


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

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        from rich.progress import track

        from experiments.studies.alarm_timing import time_courses
        from skin.live import engine_builder
        from skin.live.engine import DebounceSettings

        model = subject.reloaded
        engine = engine_builder.engine_settings(
            model, DebounceSettings(above=model.threshold), self.touch, self.drift
        ).build()
        device = model.device.simulated("held touches are simulated").replace(stream=False)
        frame = time_courses(engine, device, self.gestures, self.rate, partial(track, transient=True))
        lines = (", ".join(f"{name} {value}" for name, value in row.items() if value)
                 for row in frame.to_dict("records"))  # fmt: skip
        frame.attrs["about"] = "\n".join(lines)
        return frame


@dataclass(frozen=True)
class TouchAlarms:
    """False alarms and recall per touch, as the live view raises alarms, beside those of single windows.

    Thresholds are chosen on other touches of the same device than those that are counted.

    Args:
        safe, dangerous: number of touches that are counted.
    """

    safe: Annotated[int, Ge(1)] = 10000
    dangerous: Annotated[int, Ge(1)] = 2000

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        import numpy as np
        import pandas as pd

        from skin.core.rng import Stream, generator
        from skin.evaluation.alarm import SAFE_TOUCHES, AlarmSource, choose_alarm_threshold
        from skin.evaluation.operating_point import LABEL, Reached
        from skin.evaluation.touch_scores import touch_scores
        from skin.live.engine import DebounceSettings
        from skin.touch.labels import TOUCH

        trained, settings = subject.trained, check_evaluation(subject.config.evaluation)
        device = subject.device.simulated("touches are simulated")
        rate = float(np.ravel(device.rate)[0])
        aligned = rate <= device.model_rate
        live = trained.live_conditions(rate, DebounceSettings().alarm, aligned)
        at_once = replace(live, patience=0.0)
        source = AlarmSource("this run", settings, subject.learner, device=device)
        touch = choose_alarm_threshold(source, live, anew=True)
        window = choose_alarm_threshold(source, anew=True)
        assert touch is not None
        assert window is not None  # it has the label
        labels = device.sampler.balanced(2 * max(self.safe, self.dangerous), generator(Stream.TEST, 7))
        danger = labels[:, TOUCH.names.index(LABEL)]
        counted = np.concatenate([labels[~danger][: self.safe], labels[danger][: self.dangerous]])
        few = min(self.safe, SAFE_TOUCHES)
        alarms = touch.alarm(touch_scores(subject.learner, device, live, counted, _COUNTED))
        single = touch_scores(subject.learner, device, at_once, counted[:few], _COUNTED)
        tests = device.touches("test")
        raised, false = int(alarms[self.safe :].sum()), int(alarms[: self.safe].sum())
        probabilities = subject.learner.probabilities(tests)
        reached = {
            "touch": Reached(self.dangerous, raised, self.safe, false),
            "window": window.reached(probabilities, tests.known_labels, trained.device.task),
            "touch_at_window_threshold": Reached(0, 0, few, int(window.alarm(single).sum())),
        }
        metrics = {"touch/threshold": touch.threshold, "window/threshold": window.threshold}
        for name, alarm in reached.items():
            rates = (alarm.false_alarm_rate, *alarm.range)
            kinds = ("false_alarm_rate", "false_alarm_low", "false_alarm_high")
            metrics |= {f"{name}/{kind}": value for kind, value in zip(kinds, rates, strict=True)}
            metrics |= {f"{name}/recall": alarm.recall} if alarm.dangerous else {}
        frame = pd.DataFrame([metrics])
        frame.attrs["about"] = "\n".join(f"{name}: {alarm.sentence()}" for name, alarm in reached.items())
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

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        import numpy as np
        import pandas as pd
        import torch

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
        frame = pd.DataFrame([{"distance/largest": largest, "distance/quantile": quantile}])
        frame.attrs["about"] = (
            f"Over {self.gestures} gestures neighbours change their distance by {largest:.2%} at most, "
            f"99 % quantile {quantile:.2%} of pairs and frames in contact."
        )
        return frame


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
        (points[..., first, :] - points[..., second, :]).norm(dim=-1)
        for points in (positions, positions + motion)
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

    def __call__(self, subject: "Subject") -> "pd.DataFrame":
        import pandas as pd
        from rich.console import Console
        from rich.progress import track

        from experiments.studies.embeddings import probe
        from skin.device.balance import report_balance

        device, learner = subject.device, subject.learner if subject.model else None
        report_balance(device)
        count = (len(self.attributes) * 3 + (learner is not None) + 2) * len(self.seeds)
        steps = probe(device, self, learner)
        frame = pd.DataFrame(track(steps, "probing", count, console=Console(stderr=True)))
        frame.attrs["labels"] = list(device.task.names)
        return frame

    def page(self, frame: "pd.DataFrame", title: str) -> "Page":
        """Return the page of a run."""
        from experiments.studies.embeddings import embeddings_page

        return embeddings_page(frame)
