"""Metrics of probabilities, per label and overall as the report counts it; outcomes in one byte."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.touch.labels import PLACE, Task, target_unit

OUTCOMES = "outcomes.npy"
"""Name of the file of a run that holds the outcomes of its test gestures."""
_MOST_LABELS = 6
_ALARM, _DANGEROUS = 1 << 6, 1 << 7


def compute_metrics(
    probabilities: Tensor, labels: Tensor, task: Task, point: OperatingPoint | None = None
) -> dict[str, float]:
    """Return accuracy, balanced accuracy, calibration error, and recall and false-alarm rate of the alarm.

    Args:
        probabilities: (B, L); for a direction the mean cosines.
        labels: (B, L), 0 or 1; for a direction the cosines; NaN where unknown, which does not count.
        task: meaning of the labels.
        point: operating point of the alarm; None: no metrics of the alarm.

    Returns:
        ``<label>/accuracy``, ``/balanced_accuracy`` and ``/ece`` for each label of a binary task, and
        ``overall/accuracy``, the mean of the labels' accuracies (report, 3.2); an exclusive task has only
        this. Accuracies use a threshold of 0.5. An operating point adds ``dangerous/alarm_recall`` and
        ``dangerous/false_alarm_rate`` at its threshold. Where the task has a gate, the other labels are
        evaluated on the touches for which it is true, and the gate does not count in the overall values. A
        direction adds ``direction/degrees``, the mean absolute error, and ``direction/accuracy``, the
        fraction of errors up to 45 degrees, on the touches that have one (random guesses: 90 and .25); both
        do not count in the overall values. A regression has ``<target>/rms_mm``, ``/rms_N`` or ``/rms``, the
        root of the mean square error, the same of ``place`` for x and y together, and ``overall/r2``, the
        mean over the targets of the fraction of the variance that is predicted. Values are NaN where the
        touches do not define them: a recall needs touches with and without the label.
    """
    alarm: dict[str, float] = {}
    if point is not None:
        reached = point.reached(probabilities, labels, task)
        alarm |= {
            f"{LABEL}/alarm_recall": reached.recall,
            f"{LABEL}/false_alarm_rate": reached.false_alarm_rate,
        }
    if task.kind == "regression":
        return _errors(probabilities, labels, task)
    if task.kind == "exclusive":
        rows = task.counts(labels)[:, 0]
        right = probabilities[rows].argmax(1) == labels[rows].argmax(1)
        return {"overall/accuracy": float(right.float().mean())} | alarm
    values: dict[str, float] = {}
    pairs = _pairs(probabilities, labels, task)
    for name, (probability, label) in zip(task.binary, pairs, strict=True):
        right = ((probability > 0.5) == (label > 0)).float()
        values[f"{name}/accuracy"] = float(right.mean())
        recall, specificity = right[label > 0].mean(), right[label == 0].mean()  # nan of none
        values[f"{name}/balanced_accuracy"] = float((recall + specificity) / 2)
        values[f"{name}/ece"] = calibration_error(probability, label)
    # A label that is unknown in all test touches does not count in the overall values.
    unknown = {name for name, column in zip(task.names, labels.T, strict=True) if column.isnan().all()}
    for metric in ("accuracy", "balanced_accuracy", "ece"):
        scores = [values[f"{name}/{metric}"] for name in task.gated if name not in unknown]
        values[f"overall/{metric}"] = sum(scores) / len(scores) if scores else math.nan
    if task.direction:
        degrees = measure_angles(probabilities, labels, task)
        values["direction/degrees"] = float(degrees.mean())
        values["direction/accuracy"] = float((degrees <= 45).float().mean())
    return values | alarm


def _errors(predicted: Tensor, labels: Tensor, task: Task) -> dict[str, float]:
    """Return the metrics of a regression for predicted and true targets (B, L), NaN where unknown."""
    square, values = (predicted - labels).double().square(), dict[str, float]()
    pairs = [(name, square[:, number]) for number, name in enumerate(task.names)]
    if set(PLACE) <= set(task.names):
        pairs.append(("place", square[:, [task.names.index(name) for name in PLACE]].sum(dim=1)))
    for name, column in pairs:
        unit = target_unit(PLACE[0] if name == "place" else name)
        suffix, factor = {"m": ("rms_mm", 1e3), "N": ("rms_N", 1.0)}.get(unit, ("rms", 1.0))
        values[f"{name}/{suffix}"] = factor * float(column.nanmean().sqrt())
    spread = (labels - labels.nanmean(dim=0)).double().square().nanmean(dim=0)
    values["overall/r2"] = float((1 - square.nanmean(dim=0) / spread).nanmean())
    return values


def calibration_error(probability: Tensor, label: Tensor, bins: int = 15) -> float:
    """Return the expected calibration error in bins of equal numbers of touches; NaN without touches.

    It is the mean distance between the mean probability of a bin and the fraction of true labels in it
    (Nguyen and O'Connor, 2015).

    Args:
        probability: (B,), probabilities.
        label: (B,), 0 or 1.
        bins: their number.
    """
    if not len(probability):
        return math.nan
    edges = probability.double().quantile(torch.linspace(0, 1, bins + 1, dtype=torch.float64))[1:-1]
    # Equal probabilities share a bin.
    group = torch.bucketize(probability.double(), edges.unique())
    gaps = torch.zeros(bins, dtype=torch.float64).index_add_(0, group, probability.double() - label)
    return float(gaps.abs().sum()) / len(probability)


def measure_angles(probabilities: Tensor, labels: Tensor, task: Task) -> Tensor:
    """Return the angles (B',) between predicted and true directions, degrees, of the touches that have one.

    Cosines of 0 and 0 give no direction; they count as 90 degrees, the mean error of random guesses.
    """
    rows = task.counts(labels)[:, -1]
    (x, y), (cos, sin) = probabilities[rows, -2:].double().T, labels[rows, -2:].double().T
    angle = torch.atan2(x * sin - y * cos, x * cos + y * sin).abs() * 180 / math.pi
    return angle.where((x != 0) | (y != 0), 90)


def count_confusions(probabilities: Tensor, labels: Tensor, task: Task | None = None) -> Tensor:
    """Return confusion matrices (L, 2, 2) of probabilities and labels (B, L), true class in rows.

    If the task has a gate, each label is counted where it is defined. A direction has no matrix.
    """
    pairs = _pairs(probabilities, labels, task)
    cells = (2 * label + (probability > 0.5) for probability, label in pairs)
    return torch.stack([cell.bincount(minlength=4).view(2, 2) for cell in cells])


def _pairs(probabilities: Tensor, labels: Tensor, task: Task | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the probabilities and labels (B',) of each label, for the touches for which it is defined."""
    counts = torch.ones_like(labels, dtype=torch.bool) if task is None else task.counts(labels)
    for i in range(probabilities.shape[1] if task is None else len(task.binary)):
        yield probabilities[counts[:, i], i], labels[counts[:, i], i].long()


def encode(
    probabilities: Tensor, labels: Tensor, task: Task, point: OperatingPoint | None = None
) -> np.ndarray | None:
    """Return the outcomes of gestures, (B,), uint8, for :func:`decode`.

    Bit i is set where label i is wrong at a threshold of 0.5, bit 6 where the alarm is raised, and bit 7
    where the gesture is dangerous.

    Args:
        probabilities: (B, L).
        labels: (B, L), 0 or 1.
        task: meaning of the labels.
        point: operating point of the alarm; None: no alarm is raised.

    Returns:
        None for labels that are not binary, or not always defined and known, or more than 6.
    """
    undefined = task.gate or task.direction or bool(labels.isnan().any())
    if task.kind != "binary" or undefined or len(task) > _MOST_LABELS:
        return None
    wrong = ((probabilities > 0.5) != (labels > 0.5)).numpy()
    code = (wrong << np.arange(len(task))).sum(axis=1)
    if LABEL in task.names:
        column = task.names.index(LABEL)
        code += _DANGEROUS * (labels[:, column] > 0.5).numpy()
        if point is not None:
            code += _ALARM * point.alarm(probabilities[:, column]).numpy()
    return code.astype(np.uint8)


def decodable(metric: str, task: Task) -> bool:
    """Return whether :func:`decode` knows a metric."""
    label, _, kind = metric.partition("/")
    scored = label in (*task.names, "overall") and kind == "accuracy"
    return scored or metric in (f"{LABEL}/alarm_recall", f"{LABEL}/false_alarm_rate")


def decode(outcomes: np.ndarray, metric: str, task: Task) -> np.ndarray:
    """Return the contribution of each gesture to a metric, whose mean it is.

    Args:
        outcomes: (..., B), uint8.
        metric: ``<label>/accuracy``, ``overall/accuracy``, ``dangerous/alarm_recall`` or
            ``dangerous/false_alarm_rate``.
        task: meaning of the labels.

    Returns:
        (..., B), float64; NaN for gestures that do not count: safe ones for a recall, for example.

    Raises:
        ValueError: another metric.
    """
    if not decodable(metric, task):
        raise ValueError(f"outcomes do not tell {metric}")
    alarm, dangerous = (outcomes & _ALARM) > 0, (outcomes & _DANGEROUS) > 0
    if metric == f"{LABEL}/alarm_recall":
        return np.where(dangerous, alarm, np.nan)
    if metric == f"{LABEL}/false_alarm_rate":
        return np.where(dangerous, np.nan, alarm)
    label = metric.partition("/")[0]
    names = task.names if label == "overall" else (label,)
    right: np.ndarray = np.mean([(outcomes >> task.names.index(name) & 1) == 0 for name in names], axis=0)
    return right


def vote(outcomes: np.ndarray) -> np.ndarray:
    """Return the outcomes of what several models decide together, (B,), by a majority for each label.

    A tie is a wrong answer, and no alarm.

    Args:
        outcomes: (M, B), uint8, of M models on the same gestures.
    """
    bits = np.arange(8)
    fractions = (outcomes[..., None] >> bits & 1).mean(axis=0)
    decided = np.where(1 << bits == _ALARM, fractions > 0.5, fractions >= 0.5)
    return (decided << bits).sum(axis=-1).astype(np.uint8)


def disagreement(outcomes: np.ndarray) -> float:
    """Return the fraction of gestures for which models (M, B) differ in a label."""
    wrong = outcomes & ((1 << _MOST_LABELS) - 1)
    return float((wrong != wrong[0]).any(axis=0).mean())
