"""Metrics of probabilities: per label, and overall as the report counts it."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torchmetrics.functional.classification import (
    binary_calibration_error,
    binary_confusion_matrix,
    binary_recall,
    binary_specificity,
    multiclass_accuracy,
)

from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.labels import Task


def metrics(
    probabilities: Tensor, labels: Tensor, task: Task, point: OperatingPoint | None = None
) -> dict[str, float]:
    """Return accuracy, balanced accuracy, calibration error and what the alarm reaches.

    Args:
        probabilities: (B, L); of a direction the mean cosines.
        labels: (B, L), 0 or 1; of a direction the cosines.
        task: what the labels mean.
        point: where the alarm is raised; None: nothing is said of the alarm.

    Returns:
        ``<label>/accuracy``, ``/balanced_accuracy`` and ``/ece`` for each label of a binary task, and
        ``overall/accuracy``: the mean of the labels' accuracies (report, 3.2); an exclusive task has only
        this. Accuracies are those of a threshold of 0.5. With an operating point there are
        ``dangerous/alarm_recall`` and ``dangerous/false_alarm_rate`` at its threshold; NaN where no touch is
        dangerous, or none safe. Where the task has a gate, the other labels are measured on the touches
        in which it is open, and the gate itself is no part of the overall. Where it has a direction, there
        are ``direction/degrees``, the mean size of the error, and ``direction/accuracy``, the share of errors
        up to 45 degrees, of the touches that have one (blind guesses: 90 and .25); no part of the overall.
        NaN where the touches do not define a value: a recall needs touches with the label and without.
    """
    alarm: dict[str, float] = {}
    if point is not None:
        reached = point.reached(probabilities, labels, task)
        alarm[f"{LABEL}/alarm_recall"] = reached.recall
        alarm[f"{LABEL}/false_alarm_rate"] = reached.false_alarm_rate
    if task.kind == "exclusive":
        right = multiclass_accuracy(probabilities, labels.argmax(1), len(task), average="micro")
        return {"overall/accuracy": float(right)} | alarm
    values: dict[str, float] = {}
    pairs = _pairs(probabilities, labels, task)
    for name, (chance, label) in zip(task.binary, pairs, strict=True):
        values[f"{name}/accuracy"] = float(((chance > 0.5) == (label > 0)).float().mean())
        values[f"{name}/balanced_accuracy"] = math.nan
        if _both(label):
            recall, specificity = binary_recall(chance, label), binary_specificity(chance, label)
            values[f"{name}/balanced_accuracy"] = float((recall + specificity) / 2)
        values[f"{name}/ece"] = float(binary_calibration_error(chance, label, n_bins=15))
    for metric in ("accuracy", "balanced_accuracy", "ece"):
        each = [values[f"{name}/{metric}"] for name in task.gated]
        values[f"overall/{metric}"] = sum(each) / len(each)
    if task.direction:
        degrees = angles(probabilities, labels, task)
        values["direction/degrees"] = float(degrees.mean())
        values["direction/accuracy"] = float((degrees <= 45).float().mean())
    return values | alarm


def angles(probabilities: Tensor, labels: Tensor, task: Task) -> Tensor:
    """Return the angles (B',) between predicted and true directions, degrees, of the touches that have one.

    Cosines of 0 and 0 say nothing: 90 degrees, as a blind guess is wrong on average.
    """
    rows = task.counts(labels)[:, -1]
    (x, y), (cos, sin) = probabilities[rows, -2:].double().T, labels[rows, -2:].double().T
    angle = torch.atan2(x * sin - y * cos, x * cos + y * sin).abs() * 180 / math.pi
    return angle.where((x != 0) | (y != 0), 90)


def _both(label: Tensor) -> bool:
    """Return whether a label (B,) is there in some touches and not in others."""
    return bool(label.any()) and not bool(label.all())


def confusion(probabilities: Tensor, labels: Tensor, task: Task | None = None) -> Tensor:
    """Return counts (L, 2, 2) of probabilities and labels (B, L): true class down, predicted across.

    With a task that has a gate, each label is counted where it means something. A direction has no counts.
    """
    pairs = _pairs(probabilities, labels, task)
    return torch.stack([binary_confusion_matrix(chance, label) for chance, label in pairs])


def _pairs(probabilities: Tensor, labels: Tensor, task: Task | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the probabilities and labels (B',) of each label, of the touches in which it means something."""
    counts = torch.ones_like(labels, dtype=torch.bool) if task is None else task.counts(labels)
    last = probabilities.shape[1] if task is None else len(task.binary)
    for i in range(last):
        yield probabilities[counts[:, i], i], labels[counts[:, i], i].long()
