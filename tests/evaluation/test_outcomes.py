"""The outcome of a gesture in one byte."""

import numpy as np
import pytest
import torch

from skin.evaluation.metrics import metrics
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.outcomes import decode, disagreement, encode, vote
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


@pytest.mark.parametrize("members", [3, 5])
def test_a_vote_is_the_outcome_of_the_answers_of_most_models(members):
    """By the answers themselves; the alarm by the models' own alarms."""
    generator = torch.Generator().manual_seed(members)
    chances = torch.rand(members, 400, 4, generator=generator)
    labels = (torch.rand(400, 4, generator=generator) > 0.4).float()
    codes = np.stack([encode(one, labels, TOUCH, POINT) for one in chances])
    found, answers = vote(codes), (chances > 0.5).float().mean(0)
    known = metrics(answers, labels, TOUCH)
    for label in ("overall", *TOUCH.names):
        assert decode(found, f"{label}/accuracy", TOUCH).mean() == pytest.approx(known[f"{label}/accuracy"])
    alarms = (chances[..., TOUCH.names.index("dangerous")] > POINT.threshold).float().mean(0) > 0.5
    dangerous = labels[:, TOUCH.names.index("dangerous")] > 0.5
    recall = np.nanmean(decode(found, "dangerous/alarm_recall", TOUCH))
    assert recall == pytest.approx(float(alarms[dangerous].float().mean()))
    differ = ((chances > 0.5).any(0) & ~(chances > 0.5).all(0)).any(1)
    assert disagreement(codes) == pytest.approx(float(differ.float().mean()))


def test_a_tie_is_a_wrong_answer_and_no_alarm():
    labels = torch.ones(2, 4)
    right, wrong = labels.clone(), labels.clone()
    wrong[0] = 0
    codes = np.stack([encode(one, labels, TOUCH, POINT) for one in (right, wrong)])
    assert decode(vote(codes), "overall/accuracy", TOUCH).tolist() == [0, 1]
    assert decode(vote(codes), "dangerous/alarm_recall", TOUCH).tolist() == [0, 1]
