"""How good probabilities are: per label, and overall as the report counts it."""

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
        exclusive task has only this.
    """
    if task.kind == "exclusive":
        right = multiclass_accuracy(probabilities, labels.argmax(1), len(task), average="micro")
        return {"overall/accuracy": float(right)}
    values: dict[str, float] = {}
    for name, chance, label in zip(task.names, *_columns(probabilities, labels), strict=True):
        recall, specificity = binary_recall(chance, label), binary_specificity(chance, label)
        values[f"{name}/accuracy"] = float(((chance > 0.5) == (label > 0)).float().mean())
        values[f"{name}/balanced_accuracy"] = float((recall + specificity) / 2)
        values[f"{name}/ece"] = float(binary_calibration_error(chance, label, n_bins=15))
        if name == "dangerous":
            values[f"{name}/recall"] = recall_at(false_alarm_rate, chance, label)
    for metric in ("accuracy", "balanced_accuracy", "ece"):
        each = [values[f"{name}/{metric}"] for name in task.names]
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


def confusion(probabilities: Tensor, labels: Tensor) -> Tensor:
    """Return counts (L, 2, 2) of probabilities and labels (B, L): true class down, predicted across."""
    pairs = zip(*_columns(probabilities, labels), strict=True)
    return torch.stack([binary_confusion_matrix(chance, label) for chance, label in pairs])


def _columns(probabilities: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return both with one contiguous row per label."""
    return probabilities.T.contiguous(), labels.long().T.contiguous()
