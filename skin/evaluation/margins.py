"""Errors of a learner by distance from the class boundary and by strength of the touch."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from scipy.stats import binomtest
from torch import Tensor

from skin.device.base import AbstractDevice
from skin.evaluation.metrics import compute_metrics
from skin.evaluation.operating_point import LABEL, OperatingPoint, Predictor, Reached
from skin.learning.features import above_idle
from skin.touch.labels import TOUCH, Thresholds
from skin.touch.movie import Measures

ALARM_NAME = "alarm"
"""Name of the prediction "dangerous" at the operating point; the label itself uses a threshold of 0.5."""

_SHARES = (0, 0.5, 0.8, 0.9, 0.95, 1, 1.05, 1.1, 1.25, 2, torch.inf)  # of the threshold
_STRENGTHS = (0, 0.3, 0.5, 1, 2, 5, torch.inf)  # N; a touch of 0.3 N is six times the noise


@dataclass(frozen=True)
class Span:
    """The touches whose measure, relative to its threshold, lies in (low, high].

    Attributes:
        low: lower end.
        high: upper end; the label holds above 1.
        mean: mean relative measure.
        count: number of touches.
        said: number of touches for which the learner predicts the label.
    """

    low: float
    high: float
    mean: float
    count: int
    said: int

    @property
    def wrong(self) -> int:
        """Number of wrong predictions."""
        return self.said if self.high <= 1 else self.count - self.said

    @property
    def range(self) -> tuple[float, float]:
        """95 % confidence interval of the predicted fraction, exact (Clopper and Pearson, 1934)."""
        low, high = binomtest(self.said, self.count).proportion_ci(0.95)
        return float(low), float(high)


@dataclass(frozen=True)
class Faint:
    """The touches whose largest reading above the idle level lies in (low, high].

    Attributes:
        low: lower end, N.
        high: upper end, N.
        count: number of touches.
        wrong: label -> number of wrong predictions.
    """

    low: float
    high: float
    count: int
    wrong: dict[str, int]


@dataclass(frozen=True)
class MarginReport:
    """Result of :func:`measure_margins`.

    Attributes:
        spans: label, or ``ALARM`` -> its spans in ascending order.
        faint: by strength, ascending.
        point: operating point of ``ALARM``.
        reached: its alarms.
        metrics: of all touches (:func:`skin.evaluation.metrics.compute_metrics`).
    """

    spans: dict[str, list[Span]]
    faint: list[Faint]
    point: OperatingPoint
    reached: Reached
    metrics: dict[str, float]


def measure_margins(
    learner: Predictor, device: AbstractDevice, gestures: int, point: OperatingPoint
) -> MarginReport:
    """Return a learner's errors on test touches by the measures that define the labels, and by strength.

    Args:
        learner: trained on the labels of ``TOUCH``, and possibly others.
        device: its device, or another.
        gestures: number of test touches.
        point: operating point of the alarm.

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
    measures = Measures(*(parameters[name] for name in Measures._fields))
    settings = simulation.sampler.settings
    fractions = _fractions(measures, settings.thresholds, settings.frames.duration)
    fractions[:, TOUCH.names.index(LABEL)] = parameters.get("excess", fractions[:, TOUCH.names.index(LABEL)])
    spans = {name: find_spans(predicted[:, n], fractions[:, n]) for n, name in enumerate(TOUCH.names)}
    danger = TOUCH.names.index(LABEL)
    spans[ALARM_NAME] = find_spans(point.alarm(probabilities[:, danger]), fractions[:, danger])
    wrong = predicted != (labels > 0.5)
    faint = [
        Faint(
            low,
            high,
            int(inside.sum()),
            dict(zip(TOUCH.names, wrong[inside].sum(dim=0).tolist(), strict=True)),
        )
        for low, high, inside in _split_ranges(_STRENGTHS, above_idle(touches).amax(dim=(1, 2)))
    ]
    overall = compute_metrics(probabilities, labels, TOUCH, point)
    return MarginReport(spans, faint, point, point.reached(probabilities, labels, TOUCH), overall)


def find_spans(predicted: Tensor, fractions: Tensor) -> list[Span]:
    """Return the spans that are not empty.

    Args:
        predicted: (B,), bool, whether the learner predicts the label.
        fractions: (B,), measure divided by its threshold.
    """
    return [
        Span(low, high, float(fractions[inside].mean()), int(inside.sum()), int(predicted[inside].sum()))
        for low, high, inside in _split_ranges(_SHARES, fractions)
    ]


def _fractions(measures: Measures, thresholds: Thresholds, longest_tap: int) -> Tensor:
    """Return each measure divided by its threshold, (B, 4), in the order of ``TOUCH``."""
    pairs = (
        (measures.area, thresholds.area),
        (measures.travel, thresholds.travel),
        (measures.frames, longest_tap),
        (measures.pressure, thresholds.pressure),
    )
    return torch.stack([measure / threshold for measure, threshold in pairs], dim=1)


def _split_ranges(edges: Sequence[float], values: Tensor) -> Iterator[tuple[float, float, Tensor]]:
    """Yield each range (low, high] that holds some of the values (B,), and which, bool; 0 is in the first."""
    for low, high in pairwise(edges):
        inside = (values <= high) & ((values > low) | (low == 0))
        if inside.any():
            yield low, high, inside
