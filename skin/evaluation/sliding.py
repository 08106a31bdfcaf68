"""Evaluation on windows that slide over a stream: part of a touch, a whole one, or none."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.classification import binary_confusion_matrix

from skin.device.base import AbstractDevice, AbstractSimulated
from skin.errors import InputError
from skin.evaluation.alarm import Alarms, count_alarms
from skin.evaluation.course import Course
from skin.evaluation.metrics import metrics
from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.evaluation.report import Answers
from skin.labels import TOUCH_OR_NOT, Task
from skin.signal.contact_threshold import ContactThreshold, Gate, gates, rise

_CHUNK = 1024
_EDGES = (0.2, 0.4, 0.6, 0.8)


@dataclass(frozen=True)
class Bin:
    """Windows that show about the same share of a touch.

    Attributes:
        name: as ``0.2-0.4``, the upper end included; ``whole`` for those that show all of it.
        count: of windows.
        accuracy: of each label.
        majority: what always giving the commoner answer would reach, of each label.
    """

    name: str
    count: int
    accuracy: dict[str, float]
    majority: dict[str, float]


@dataclass(frozen=True)
class Sliding:
    """What was found.

    Attributes:
        bins: accuracy against the share of the touch that a window shows.
        gates: gate -> (2, 2) counts of windows: idle and touched down, said to be idle and touched across.
        threshold: of the gate by threshold, N.
        alarms: gate -> alarms on the long stream.
        hours: its length.
        lengths: frames of a window -> overall accuracy, or why the learner takes no such window.
        streamed: whether the learner was trained on windows of streams.
        point: where the alarm is raised.
    """

    bins: list[Bin]
    gates: dict[str, Tensor]
    threshold: float
    alarms: dict[str, Alarms]
    hours: float
    lengths: dict[int, float | str]
    streamed: bool
    point: OperatingPoint

    def metrics(self) -> dict[str, float]:
        """Return every figure by a name that MLflow takes."""
        values: dict[str, float] = {
            "stream/hours": self.hours,
            "gate/threshold/least": self.threshold,
            "alarms/threshold": self.point.threshold,
        }
        for one in self.bins:
            values |= {f"share/{one.name}/{name}/accuracy": value for name, value in one.accuracy.items()}
        for gate, counts in self.gates.items():
            values[f"gate/{gate}/accuracy"] = float(counts.diag().sum() / counts.sum())
        for gate, alarms in self.alarms.items():
            values[f"alarms/{gate}/false_per_hour"] = alarms.per_hour
            values[f"alarms/{gate}/found"] = alarms.found / max(alarms.dangerous, 1)
            values[f"alarms/{gate}/raised_by_safe"] = alarms.raised / max(alarms.safe, 1)
        for window, value in self.lengths.items():
            values |= {} if isinstance(value, str) else {f"window/{window}/overall/accuracy": value}
        return values


def slide(
    learner: Answers,
    device: AbstractDevice,
    course: Course,
    point: OperatingPoint,
    track: Callable[..., Any] = iter,
) -> Sliding:
    """Try a learner on windows of test streams, as its device would feel them.

    Args:
        learner: trained.
        device: that it was trained on.
        course: what to try.
        point: where the learner raises the alarm.
        track: wraps the chunks of the long stream, to show how far it is, as ``rich.progress.track``.

    Raises:
        InputError: a device that has no streams.
    """
    device = device.simulated(f"streams are simulated, {type(device).__name__} has none")
    # One device feels the whole stream, and its baseline is known as after a tare.
    streamed = device.replace(stream=True, randomise=False)
    threshold = _tuned(streamed)
    all_gates = gates(threshold, device.task)
    recording = streamed.recording("test")
    touches, labels = recording.touches, recording.touches.labels
    assert labels is not None
    chances = learner.probabilities(touches)
    said = {name: gate(touches, chances) for name, gate in all_gates.items() if name != "none"}
    return Sliding(
        bins(chances, labels, recording.parameters["share"], device.task),
        {name: binary_confusion_matrix(answer.long(), labels[:, -1].long()) for name, answer in said.items()},
        threshold.least,
        _listen(learner, streamed, device.task, all_gates, course, point, track),
        course.hours,
        {window: _length(learner, device, window) for window in course.windows},
        device.stream,
        point,
    )


def _tuned(device: AbstractSimulated) -> ContactThreshold:
    """Return the threshold that tells touched windows from idle ones, tuned on the validation split."""
    known, idle = device.touches("validation"), device.idle
    assert known.labels is not None
    return ContactThreshold.tuned(rise(known, idle), known.labels[:, -1] > 0.5, idle)


def bins(chances: Tensor, labels: Tensor, share: Tensor, task: Task) -> list[Bin]:
    """Return accuracies by the share that is seen, of the windows that show a touch.

    Args:
        chances: (W, L), probabilities of the labels of ``task``.
        labels: (W, 5), of ``TOUCH_OR_NOT``.
        share: (W,), part of the touch that is seen; 0 without touch.
        task: what the learner says.
    """
    names = TOUCH_OR_NOT.gated
    truth = labels[:, : len(names)] > 0.5
    right = (chances[:, [task.names.index(name) for name in names]] > 0.5) == truth
    group = torch.bucketize(share, torch.tensor(_EDGES)).where(share < 1, len(_EDGES) + 1)
    ends = [0.0, *_EDGES, 1.0]
    titles = [*(f"{low:g}-{high:g}" for low, high in pairwise(ends)), "whole"]
    found = []
    for number, title in enumerate(titles):
        here = (group == number) & (share > 0)
        if here.any():
            yes = truth[here].float().mean(0)
            shares = right[here].float().mean(0).tolist(), torch.maximum(yes, 1 - yes).tolist()
            each = (dict(zip(names, values, strict=True)) for values in shares)
            found.append(Bin(title, int(here.sum()), *each))
    return found


def _listen(
    learner: Answers,
    device: AbstractSimulated,
    task: Task,
    all_gates: dict[str, Gate],
    course: Course,
    point: OperatingPoint,
    track: Callable[..., Any],
) -> dict[str, Alarms]:
    """Return the alarms of each gate while a window slides over a long stream."""
    frames = max(round(course.hours * 3600 * device.rate), device.window)
    strip = device.strip(frames, course.gap)
    starts = torch.arange(0, frames - device.window + 1, course.stride)
    dangerous = task.names.index(LABEL)
    heard: dict[str, list[Tensor]] = {name: [] for name in all_gates}
    for part in track(starts.split(_CHUNK)):
        touches = strip.cut(part, device.window).touches
        chances = learner.probabilities(touches)
        for name, gate in all_gates.items():
            heard[name].append(point.alarm(chances[:, dangerous]) & gate(touches, chances))
    gesture = strip.timeline.look(starts, device.window).gesture
    truth = strip.timeline.movie.labels[:, TOUCH_OR_NOT.names.index("dangerous")] > 0.5
    hours = course.stride / device.rate / 3600
    return {name: count_alarms(torch.cat(said), gesture, truth, hours) for name, said in heard.items()}


def _length(learner: Answers, device: AbstractSimulated, window: int) -> float | str:
    """Return the overall accuracy on test touches in windows of another length, or why there is none.

    The touches are those of the other lengths, begun elsewhere; a window that the longest press does not fit
    in has shorter presses.
    """
    settings = device.sampler.settings
    try:
        press = settings.press[0], min(settings.press[1], window)
        other = device.replace(touch=replace(settings, window=window, press=press)).touches("test")
        assert other.labels is not None
        found = metrics(learner.probabilities(other), other.labels, device.task)
    except InputError as reason:
        return str(reason)
    return found["overall/accuracy"]
