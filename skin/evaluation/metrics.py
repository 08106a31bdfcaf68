"""How good probabilities are: per label, and overall as the report counts it."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torchmetrics.functional.classification import (
    binary_calibration_error,
    binary_confusion_matrix,
    binary_recall,
    binary_roc,
    binary_specificity,
    multiclass_accuracy,
)

from skin.labels import Task

__all__ = ["alarm_level", "angles", "confusion", "metrics", "recall_at"]


def metrics(probabilities: Tensor, labels: Tensor, task: Task, false_alarm_rate: float) -> dict[str, float]:
    """Return accuracy, balanced accuracy, calibration error and recalls.

    Args:
        probabilities: (B, L); of a direction the mean cosines.
        labels: (B, L), 0 or 1; of a direction the cosines.
        task: what the labels mean.
        false_alarm_rate: share of false alarms at which the recall of ``dangerous`` is read.

    Returns:
        ``<label>/accuracy``, ``/balanced_accuracy`` and ``/ece`` for each label of a binary task,
        ``dangerous/recall``, and ``overall/accuracy``: the mean of the labels' accuracies (report, 3.2); an
        exclusive task has only this. Where the task has a gate, the other labels are measured on the touches
        in which it is open, and the gate itself is no part of the overall. Where it has a direction, there
        are ``direction/degrees``, the mean size of the error, and ``direction/accuracy``, the share of errors
        up to 45 degrees, of the touches that have one (blind guesses: 90 and .25); no part of the overall.
        NaN where the touches do not define a value: a recall needs touches with the label and without.
    """
    if task.kind == "exclusive":
        right = multiclass_accuracy(probabilities, labels.argmax(1), len(task), average="micro")
        return {"overall/accuracy": float(right)}
    values: dict[str, float] = {}
    pairs = _pairs(probabilities, labels, task)
    for name, (chance, label) in zip(task.binary, pairs, strict=True):
        values[f"{name}/accuracy"] = float(((chance > 0.5) == (label > 0)).float().mean())
        values[f"{name}/balanced_accuracy"] = math.nan
        if _both(label):
            recall, specificity = binary_recall(chance, label), binary_specificity(chance, label)
            values[f"{name}/balanced_accuracy"] = float((recall + specificity) / 2)
        values[f"{name}/ece"] = float(binary_calibration_error(chance, label, n_bins=15))
        if name == "dangerous":
            values[f"{name}/recall"] = recall_at(false_alarm_rate, chance, label)
    for metric in ("accuracy", "balanced_accuracy", "ece"):
        each = [values[f"{name}/{metric}"] for name in task.gated]
        values[f"overall/{metric}"] = sum(each) / len(each)
    if task.direction:
        degrees = angles(probabilities, labels, task)
        values["direction/degrees"] = float(degrees.mean())
        values["direction/accuracy"] = float((degrees <= 45).float().mean())
    return values


def angles(probabilities: Tensor, labels: Tensor, task: Task) -> Tensor:
    """Return the angles (B',) between predicted and true directions, degrees, of the touches that have one.

    Cosines of 0 and 0 say nothing: 90 degrees, as a blind guess is wrong on average.
    """
    rows = task.counts(labels)[:, -1]
    (x, y), (cos, sin) = probabilities[rows, -2:].double().T, labels[rows, -2:].double().T
    angle = torch.atan2(x * sin - y * cos, x * cos + y * sin).abs() * 180 / math.pi
    return angle.where((x != 0) | (y != 0), 90)


def recall_at(false_alarm_rate: float, chance: Tensor, label: Tensor) -> float:
    """Return the largest share of true cases found by a threshold that raises at most so many false alarms.

    Args:
        false_alarm_rate: largest share of the false cases that may be called true.
        chance: (B,), probabilities.
        label: (B,), 0 or 1, integer.

    Returns:
        NaN where all labels are alike.
    """
    if not _both(label):
        return math.nan
    false_alarms, recall, _ = binary_roc(chance, label)
    return float(recall[false_alarms <= false_alarm_rate].max())


def _both(label: Tensor) -> bool:
    """Return whether a label (B,) is there in some touches and not in others."""
    return bool(label.any()) and not bool(label.all())


def alarm_level(false_alarm_rate: float, chance: Tensor, label: Tensor) -> float:
    """Return the probability from which on alarms are raised to reach :func:`recall_at`; same arguments."""
    false_alarms, _, levels = binary_roc(chance, label)
    return float(levels[false_alarms <= false_alarm_rate].min())


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
