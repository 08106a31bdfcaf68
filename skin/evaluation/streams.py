"""Evaluation on sliding windows over a stream, which show a part of a touch, a whole touch, or none."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean

import torch
from torch import Tensor

from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics, count_confusions
from skin.evaluation.operating_point import LABEL, OperatingPoint, Predictor
from skin.evaluation.settings import StreamSettings
from skin.touch.labels import ALARM, TOUCH_OR_NOT, Task

# Contact detection by a threshold (report, section 4.2).


Gate = Callable[[Touches, Tensor], Tensor]
"""Maps windows and their probabilities (B, L) to predicted contact, (B,), bool."""


def rise(touches: Touches, idle: Tensor | float = 0.0) -> Tensor:
    """Return the largest rise of each window above the untouched skin, (B,), N; at least 0.

    The baseline is not taken from the window: a touch held throughout it would become the baseline.

    Args:
        touches: invalid readings are ignored.
        idle: (S,), N, readings of the untouched skin; 0 after a tare.
    """
    return ((touches.readings - idle) * touches.valid).flatten(1).amax(dim=1).clamp(min=0)


@dataclass(frozen=True)
class ContactThreshold:
    """Predicts contact if a reading rises by ``minimum`` N or more above its baseline.

    Attributes:
        minimum: N.
        idle: (S,), N, as in :func:`rise`.
    """

    minimum: float
    idle: Tensor | float = 0.0

    @classmethod
    def tuned(cls, rises: Tensor, touched: Tensor, idle: Tensor | float = 0.0) -> "ContactThreshold":
        """Return the threshold of the highest balanced accuracy.

        Args:
            rises: (B,), N, from :func:`rise`, of windows that are not used for testing.
            touched: (B,), bool.
            idle: (S,), N, as in :func:`rise`.

        Raises:
            InputError: all windows are touched, or none is.
        """
        if touched.all() or not touched.any():
            raise InputError(
                f"{len(touched)} validation windows are all alike, with touch or all without: "
                "give more with data.gestures"
            )
        levels = torch.cat([rises.unique(), rises.new_tensor([torch.inf])]).flip(0)
        ranked = (rises[touched].sort().values, rises[~touched].sort().values)
        detected, alarms = (
            (len(part) - torch.searchsorted(part, levels)).double() / len(part) for part in ranked
        )
        return cls(float(levels[(detected - alarms).argmax()]), idle)

    def touched(self, touches: Touches) -> Tensor:
        """Return which windows are touched, (B,), bool."""
        return rise(touches, self.idle) >= self.minimum


def gates(threshold: ContactThreshold, task: Task) -> dict[str, Gate]:
    """Return the gates by name: ``none`` lets all through; ``learned`` only where the task has a gate."""
    gates: dict[str, Gate] = {
        "none": lambda touches, probabilities: torch.ones(len(touches), dtype=torch.bool),
        "threshold": lambda touches, probabilities: threshold.touched(touches),
    }
    if task.gate is not None:
        gate = task.names.index(task.gate)
        gates["learned"] = lambda touches, probabilities: probabilities[:, gate] > 0.5
    return gates


# Evaluation on windows.


@dataclass(frozen=True)
class Alarms:
    """The alarms on sliding windows over a stream.

    Attributes:
        idle_hours: time in which the window showed no touch.
        false: alarms that began in that time; consecutive alarms count once.
        dangerous: number of dangerous touches.
        found: those that raised an alarm while the window showed them.
        safe: number of safe touches.
        raised: those that raised an alarm.
    """

    idle_hours: float
    false: int
    dangerous: int
    found: int
    safe: int
    raised: int

    @property
    def per_hour(self) -> float:
        """False alarms per hour without touch."""
        return self.false / self.idle_hours if self.idle_hours else float("nan")

    @property
    def range(self) -> tuple[float, float]:
        """95 % confidence interval of the rate per hour, exact for independent events (Garwood, 1936)."""
        from scipy.stats import chi2

        if not self.idle_hours:
            return float("nan"), float("nan")
        low = chi2.ppf(0.025, 2 * self.false) / 2 if self.false else 0.0
        return float(low) / self.idle_hours, float(chi2.ppf(0.975, 2 * self.false + 2)) / 2 / self.idle_hours


def count_alarms(alarm: Tensor, gesture: Tensor, dangerous: Tensor, hours: float) -> Alarms:
    """Return the alarms of W consecutive windows.

    Args:
        alarm: (W,), bool.
        gesture: (W,), the touch in each window, as an index into ``dangerous``; -1: none.
        dangerous: (G,), bool, of each touch.
        hours: time from one window to the next.
    """
    idle = gesture < 0
    wrong = alarm & idle
    began = wrong & ~torch.cat([torch.zeros(1, dtype=torch.bool), wrong[:-1]])
    seen, raised = torch.zeros(2, len(dangerous), dtype=torch.bool)
    seen[gesture[~idle]] = True
    raised[gesture[alarm & ~idle]] = True
    return Alarms(
        idle_hours=float(idle.sum()) * hours,
        false=int(began.sum()),
        dangerous=int((seen & dangerous).sum()),
        found=int((raised & dangerous).sum()),
        safe=int((seen & ~dangerous).sum()),
        raised=int((raised & ~dangerous).sum()),
    )


@dataclass(frozen=True)
class Bin:
    """Windows that show a similar fraction of a touch.

    Attributes:
        name: such as ``0.2-0.4``, upper end included; ``whole`` for windows with a whole touch.
        count: number of windows.
        accuracy: of each label.
        majority: accuracy of always predicting the majority class, of each label.
    """

    name: str
    count: int
    accuracy: dict[str, float]
    majority: dict[str, float]

    @property
    def overall(self) -> float:
        """Accuracy averaged over the labels."""
        return fmean(self.accuracy.values())


@dataclass(frozen=True)
class WindowReport:
    """Result of an evaluation on sliding windows.

    Attributes:
        bins: accuracy by the fraction of the touch in the window.
        gates: gate -> (2, 2) counts of windows: truth idle and touched down, predicted across.
        threshold: of the gate by threshold, N.
        alarms: gate -> alarms on the long stream.
        hours: length of that stream.
        lengths: length of a window, s -> overall accuracy, or why the learner does not accept such windows.
        point: operating point of the alarm.
    """

    bins: list[Bin]
    gates: dict[str, Tensor]
    threshold: float
    alarms: dict[str, Alarms]
    hours: float
    lengths: dict[float, float | str]
    point: OperatingPoint

    def metrics(self) -> dict[str, float]:
        """Return all values under names that MLflow accepts."""
        whole = {
            "stream/hours": self.hours,
            "gate/threshold/least": self.threshold,
            "alarms/threshold": self.point.threshold,
        }
        bins = {
            f"share/{entry.name}/{name}/accuracy": value
            for entry in self.bins
            for name, value in (*entry.accuracy.items(), ("overall", entry.overall))
        }
        gates = {f"gate/{g}/accuracy": float(n.diag().sum() / n.sum()) for g, n in self.gates.items()}
        alarms = {
            f"alarms/{gate}/{name}": value
            for gate, its in self.alarms.items()
            for name, value in (
                ("false_per_hour", its.per_hour),
                ("found", its.found / max(its.dangerous, 1)),
                ("raised_by_safe", its.raised / max(its.safe, 1)),
            )
        }
        lengths = {
            f"window/{window:g}/overall/accuracy": value
            for window, value in self.lengths.items()
            if not isinstance(value, str)
        }
        return whole | bins | gates | alarms | lengths


def evaluate_windows(
    learner: Predictor,
    device: AbstractDevice,
    settings: StreamSettings,
    point: OperatingPoint,
) -> WindowReport:
    """Evaluate a learner on windows of test streams of its device.

    Args:
        learner: trained learner.
        device: its device.
        settings: the streams and windows to test.
        point: operating point of the alarm.

    Raises:
        InputError: the device has no streams.
    """
    device = device.simulated(f"streams are simulated, {type(device).__name__} has none")
    # One device records the whole stream, and its baseline is known as after a tare.
    streamed = device.replace(stream=True, randomise=False)
    known = streamed.touches("validation")
    touched = known.known_labels[:, -1] > 0.5
    threshold = ContactThreshold.tuned(rise(known, streamed.idle), touched, streamed.idle)
    all_gates = gates(threshold, device.task)
    recording = streamed.recording("test")
    touches, labels = recording.touches, recording.touches.known_labels
    probabilities = learner.probabilities(touches)
    answers = {name: gate(touches, probabilities) for name, gate in all_gates.items() if name != "none"}
    return WindowReport(
        bin_by_fraction(probabilities, labels, recording.parameters["share"], device.task),
        {name: count_confusions(gate[:, None].float(), labels[:, -1:])[0] for name, gate in answers.items()},
        threshold.minimum,
        _listen(learner, streamed, device.task, all_gates, settings, point),
        settings.hours,
        {window: _measure_length(learner, device, window) for window in settings.windows},
        point,
    )


def bin_by_fraction(
    probabilities: Tensor,
    labels: Tensor,
    fraction: Tensor,
    task: Task,
    edges: Sequence[float] = (0.2, 0.4, 0.6, 0.8),
) -> list[Bin]:
    """Return accuracies by the fraction of the touch in the window, for windows that show a touch.

    Args:
        probabilities: (W, L), probabilities of the labels of ``task``.
        labels: (W, 5), of ``TOUCH_OR_NOT``.
        fraction: (W,), fraction of the touch in the window; 0 without touch.
        task: task of the learner.
        edges: of the bins, fractions of the touch.
    """
    names = TOUCH_OR_NOT.gated
    truth = labels[:, : len(names)] > 0.5
    right = (probabilities[:, [task.names.index(name) for name in names]] > 0.5) == truth
    group = torch.bucketize(fraction, torch.tensor(edges)).where(fraction < 1, len(edges) + 1)
    ends = [0.0, *edges, 1.0]
    titles = [*(f"{low:g}-{high:g}" for low, high in pairwise(ends)), "whole"]
    bins = []
    for number, title in enumerate(titles):
        inside = (group == number) & (fraction > 0)
        if inside.any():
            yes = truth[inside].float().mean(0)
            fractions = right[inside].float().mean(0).tolist(), torch.maximum(yes, 1 - yes).tolist()
            tables = (dict(zip(names, values, strict=True)) for values in fractions)
            bins.append(Bin(title, int(inside.sum()), *tables))
    return bins


def _listen(
    learner: Predictor,
    device: Simulated,
    task: Task,
    all_gates: dict[str, Gate],
    settings: StreamSettings,
    point: OperatingPoint,
) -> dict[str, Alarms]:
    """Return the alarms of each gate on sliding windows over a long stream."""
    rate = device.model_rate
    frames = max(round(settings.hours * 3600 * rate), device.window)
    gap = [_frames(seconds, rate, "gap") for seconds in settings.gap]
    stride = _frames(settings.stride, rate, "stride")
    stream = device.simulate_stream(frames, gap)
    starts = torch.arange(0, frames - device.window + 1, stride)
    dangerous = task.names.index(LABEL)
    raised: dict[str, list[Tensor]] = {name: [] for name in all_gates}
    for part in starts.split(1024):
        touches = stream.cut(part, device.window).touches
        probabilities = learner.probabilities(touches)
        for name, gate in all_gates.items():
            raised[name].append(point.alarm(probabilities[:, dangerous]) & gate(touches, probabilities))
    gesture = stream.timeline.window_content(starts, device.window)[0]
    truth = stream.timeline.movie.labels[:, TOUCH_OR_NOT.names.index(ALARM)] > 0.5
    return {
        name: count_alarms(torch.cat(parts), gesture, truth, hours=stride / rate / 3600)
        for name, parts in raised.items()
    }


def _frames(seconds: float, rate: float, name: str) -> int:
    """Return a duration in frames at a rate, Hz; InputError if it is shorter than a frame."""
    frames = round(seconds * rate)
    if not frames:
        raise InputError(
            f"study.measure.{name}={seconds:g} s is no frame at touch.rate={rate:g} Hz: "
            f"give at least {1 / rate:g}"
        )
    return frames


def _measure_length(learner: Predictor, device: Simulated, window: float) -> float | str:
    """Return the overall accuracy on test touches in windows of another length, s, or why there is none.

    All lengths have the same touches with other onsets; windows that are shorter than the longest press have
    shorter presses.
    """
    settings = device.sampler.settings
    try:
        press = settings.press[0], min(settings.press[1], window)
        longer = device.replace(touch=replace(settings, window=window, press=press)).touches("test")
        metrics = compute_metrics(learner.probabilities(longer), longer.known_labels, device.task)
    except InputError as reason:
        return str(reason)
    return metrics["overall/accuracy"]
