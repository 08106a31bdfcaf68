"""Errors of a learner by distance from the class boundary and by strength of the touch."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import pandas as pd
import torch
from scipy.stats import binomtest
from torch import Tensor

from skin.device.base import AbstractDevice
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import LABEL, OperatingPoint, Predictor, Reached
from skin.learning.features import above_idle
from skin.touch.labels import TOUCH

ALARM_NAME = "alarm"
"""Name of the prediction "dangerous" at the operating point; the label itself uses a threshold of 0.5."""

_SHARES = (0, 0.5, 0.8, 0.9, 0.95, 1, 1.05, 1.1, 1.25, 2, torch.inf)  # of the threshold
_STRENGTHS = (0, 0.3, 0.5, 1, 2, 5, torch.inf)  # N; a touch of 0.3 N is six times the noise


def measure_margins(
    learner: Predictor, device: AbstractDevice, gestures: int, point: OperatingPoint
) -> tuple[pd.DataFrame, Reached]:
    """Return a learner's errors on test touches by the measures that define the labels, and by strength.

    Args:
        learner: trained on the labels of ``TOUCH``, and possibly others.
        device: its device, or another.
        gestures: number of test touches.
        point: operating point of the alarm.

    Returns:
        Rows of :func:`span_rows` for each label and ``ALARM_NAME``, and for each label rows by the largest
        reading above the idle level, N, with ``wrong`` alone; ``attrs["metrics"]`` of all touches
        (:func:`skin.evaluation.metrics.compute_metrics`). And the alarms.

    Raises:
        InputError: the device is not simulated, so that the measures are not known.
    """
    simulation = device.simulated(
        f"only simulated touches are known well enough, {type(device).__name__} has none"
    )
    recording = simulation.replace(test_gestures=gestures, stream=False, direction=False).recording(
        "test", complete=False
    )
    touches, labels = recording.touches, recording.touches.known_labels
    columns = [device.task.names.index(name) for name in TOUCH.names]
    probabilities = learner.probabilities(touches)[:, columns]
    predicted, parameters = probabilities > 0.5, recording.parameters
    settings, thresholds = simulation.sampler.settings, simulation.sampler.settings.thresholds
    limits = thresholds.area, thresholds.travel, settings.frames.duration, thresholds.pressure
    measures = ("area", "travel", "frames", "pressure")  # in the order of TOUCH
    fractions = [parameters[name] / limit for name, limit in zip(measures, limits, strict=True)]
    danger = TOUCH.names.index(LABEL)
    fractions[danger] = parameters.get("excess", fractions[danger])
    said = [*predicted.T, point.alarm(probabilities[:, danger])]
    names, fractions = [*TOUCH.names, ALARM_NAME], [*fractions, fractions[danger]]
    rows = [row for each in zip(names, said, fractions, strict=True) for row in span_rows(*each)]
    strengths = [*_split_ranges(_STRENGTHS, above_idle(touches).amax(dim=(1, 2)))]
    rows += [
        {"label": name, "by": "reading", "low": str(low), "high": str(high), "touches": int(inside.sum()),
         "said": "", "wrong": int(wrong[inside].sum())}
        for name, wrong in zip(TOUCH.names, (predicted != (labels > 0.5)).T, strict=True)
        for low, high, inside in strengths
    ]  # fmt: skip
    frame = pd.DataFrame(rows)
    frame.attrs["metrics"] = compute_metrics(probabilities, labels, TOUCH, point)
    return frame, point.reached(probabilities, labels, TOUCH)


def span_rows(name: str, said: Tensor, fractions: Tensor) -> Iterator[dict[str, Any]]:
    """Yield a row for each range of the measure that holds some touches; the label holds above 1.

    Its values: ``low`` and ``high`` end, as texts; number of ``touches``, of those ``said`` to have the
    label, as a text, and of the ``wrong``; ``mean`` of the measure; ``lower`` and ``upper`` end of the 95 %
    confidence interval of said over touches, exact (Clopper and Pearson, 1934).

    Args:
        name: of the label.
        said: (B,), bool, whether the learner predicts it.
        fractions: (B,), measure divided by its threshold.
    """
    for low, high, inside in _split_ranges(_SHARES, fractions):
        touches, yes = int(inside.sum()), int(said[inside].sum())
        lower, upper = binomtest(yes, touches).proportion_ci(0.95)
        yield {
            "label": name, "by": "threshold", "low": str(low), "high": str(high), "touches": touches,
            "said": str(yes), "wrong": yes if high <= 1 else touches - yes,
            "mean": float(fractions[inside].mean()), "lower": float(lower), "upper": float(upper),
        }  # fmt: skip


def _split_ranges(edges: Sequence[float], values: Tensor) -> Iterator[tuple[float, float, Tensor]]:
    """Yield each range (low, high] that holds some of the values (B,), and which, bool; 0 is in the first."""
    for low, high in pairwise(edges):
        inside = (values <= high) & ((values > low) | (low == 0))
        if inside.any():
            yield low, high, inside
