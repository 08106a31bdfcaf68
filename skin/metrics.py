"""How good probabilities are: per label, and overall as the report counts it."""

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

__all__ = ["confusion", "metrics", "recall_at"]


def metrics(probabilities: Tensor, labels: Tensor, task: Task, false_alarm_rate: float) -> dict[str, float]:
    """Return accuracy, balanced accuracy, calibration error and recalls.

    Args:
        probabilities: (B, L).
        labels: (B, L), 0 or 1.
        task: what the labels mean.
        false_alarm_rate: share of false alarms at which the recall of ``dangerous`` is read.

    Returns:
        ``<label>/accuracy``, ``/balanced_accuracy`` and ``/ece`` for each label of a binary task,
        ``dangerous/recall``, and ``overall/accuracy``: the mean of the labels' accuracies (report, 3.2); an
        exclusive task has only this. Where the task has a gate, the other labels are measured on the touches
        in which it is open, and the gate itself is no part of the overall.
    """
    if task.kind == "exclusive":
        right = multiclass_accuracy(probabilities, labels.argmax(1), len(task), average="micro")
        return {"overall/accuracy": float(right)}
    values: dict[str, float] = {}
    pairs = _pairs(probabilities, labels, task)
    for name, (chance, label) in zip(task.names, pairs, strict=True):
        recall, specificity = binary_recall(chance, label), binary_specificity(chance, label)
        values[f"{name}/accuracy"] = float(((chance > 0.5) == (label > 0)).float().mean())
        values[f"{name}/balanced_accuracy"] = float((recall + specificity) / 2)
        values[f"{name}/ece"] = float(binary_calibration_error(chance, label, n_bins=15))
        if name == "dangerous":
            values[f"{name}/recall"] = recall_at(false_alarm_rate, chance, label)
    for metric in ("accuracy", "balanced_accuracy", "ece"):
        each = [values[f"{name}/{metric}"] for name in task.gated]
        values[f"overall/{metric}"] = sum(each) / len(each)
    return values


def recall_at(false_alarm_rate: float, chance: Tensor, label: Tensor) -> float:
    """Return the largest share of true cases found by a threshold that raises at most so many false alarms.

    Args:
        false_alarm_rate: largest share of the false cases that may be called true.
        chance: (B,), probabilities.
        label: (B,), 0 or 1, integer.
    """
    false_alarms, recall, _ = binary_roc(chance, label)
    return float(recall[false_alarms <= false_alarm_rate].max())


def confusion(probabilities: Tensor, labels: Tensor, task: Task | None = None) -> Tensor:
    """Return counts (L, 2, 2) of probabilities and labels (B, L): true class down, predicted across.

    With a task that has a gate, each label is counted where it means something.
    """
    pairs = _pairs(probabilities, labels, task)
    return torch.stack([binary_confusion_matrix(chance, label) for chance, label in pairs])


def _pairs(probabilities: Tensor, labels: Tensor, task: Task | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the probabilities and labels (B',) of each label, of the touches in which it means something."""
    counts = torch.ones_like(labels, dtype=torch.bool) if task is None else task.counts(labels)
    for chance, label, counted in zip(probabilities.T, labels.long().T, counts.T, strict=True):
        yield chance[counted], label[counted]
