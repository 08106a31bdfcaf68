"""The outcome of a gesture in one byte."""

import numpy as np
import pytest
import torch

from skin.evaluation.metrics import metrics
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.outcomes import decode, encode
from skin.labels import TOUCH, TOUCH_OR_NOT, TOUCH_SLIDING, Task

POINT = OperatingPoint(0.7, 0.02, 64, 1, 0)


def test_means_over_gestures_are_the_metrics():
    generator = torch.Generator().manual_seed(2)
    chances = torch.rand(500, 4, generator=generator)
    labels = (torch.rand(500, 4, generator=generator) > 0.4).float()
    known = metrics(chances, labels, TOUCH, POINT)
    codes = encode(chances, labels, TOUCH, POINT)
    assert codes.dtype == np.uint8
    for metric in (
        "overall/accuracy", "big/accuracy", "dangerous/accuracy", "dangerous/alarm_recall",
        "dangerous/false_alarm_rate",
    ):  # fmt: skip
        assert np.nanmean(decode(codes, metric, TOUCH)) == pytest.approx(known[metric], abs=1e-6), metric
    for metric in ("overall/ece", "made_up/accuracy", "dangerous/degrees"):
        with pytest.raises(ValueError, match=metric):
            decode(codes, metric, TOUCH)


@pytest.mark.parametrize("task", [TOUCH_OR_NOT, TOUCH_SLIDING, Task(("a", "b", "c"), "exclusive")])
def test_other_labels_have_no_outcomes(task):
    assert encode(torch.rand(3, len(task)), torch.ones(3, len(task)), task) is None
