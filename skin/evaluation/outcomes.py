"""What a learner says about each test gesture, in one byte, for paired comparisons."""

import numpy as np
from torch import Tensor

from skin.evaluation.operating_point import LABEL, OperatingPoint
from skin.labels import Task

OUTCOMES = "outcomes.npy"
"""Name of the file of a run that holds the outcomes of its test gestures."""

_LABELS = 6
_ALARM, _DANGEROUS = 1 << 6, 1 << 7


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
        None for labels that are not binary or not always defined, or more than 6.
    """
    if task.kind != "binary" or task.gate or task.direction or len(task) > _LABELS:
        return None
    wrong = ((probabilities > 0.5) != (labels > 0.5)).numpy()
    code = (wrong << np.arange(len(task))).sum(axis=1)
    if LABEL in task.names:
        place = task.names.index(LABEL)
        code += _DANGEROUS * (labels[:, place] > 0.5).numpy()
        if point is not None:
            code += _ALARM * point.alarm(probabilities[:, place]).numpy()
    return code.astype(np.uint8)


def decodable(metric: str, task: Task) -> bool:
    """Return whether :func:`decode` knows a metric."""
    label, _, kind = metric.partition("/")
    known = label in (*task.names, "overall") and kind == "accuracy"
    return known or metric in (f"{LABEL}/alarm_recall", f"{LABEL}/false_alarm_rate")


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
    shares = (outcomes[..., None] >> bits & 1).mean(axis=0)
    decided = np.where(1 << bits == _ALARM, shares > 0.5, shares >= 0.5)
    return (decided << bits).sum(axis=-1).astype(np.uint8)


def disagreement(outcomes: np.ndarray) -> float:
    """Return the share of gestures for which models (M, B) differ in a label."""
    wrong = outcomes & ((1 << _LABELS) - 1)
    return float((wrong != wrong[0]).any(axis=0).mean())
