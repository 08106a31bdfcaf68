"""Metrics against scikit-learn and against counting."""

import math

import numpy as np
import pytest
import torch
from sklearn.metrics import accuracy_score, balanced_accuracy_score, confusion_matrix

from skin.evaluation import metrics
from skin.evaluation.metrics import compute_metrics, count_confusions, decode, encode
from skin.evaluation.operating_point import OperatingPoint
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, TOUCH_SLIDING, Task

POINT = OperatingPoint(0.7, 0.02, 64, 1, 0)


@pytest.fixture
def scored():
    """Return probabilities (400, 4) that lean towards labels (400, 4); one label is rare."""
    generator = torch.Generator().manual_seed(0)
    labels = (torch.rand(400, 4, generator=generator) < torch.tensor([0.5, 0.1, 0.5, 0.4])).float()
    noise = torch.randn(400, 4, generator=generator)
    return (2 * labels - 1 + 1.5 * noise).sigmoid(), labels


def test_accuracies_and_confusions_are_those_of_scikit_learn_and_overall_their_mean(scored):
    probabilities, labels = scored
    found, counts = compute_metrics(probabilities, labels, TOUCH), count_confusions(probabilities, labels)
    for i, name in enumerate(TOUCH.names):
        truth, said = labels[:, i], probabilities[:, i] > 0.5
        assert found[f"{name}/accuracy"] == pytest.approx(accuracy_score(truth, said))
        assert found[f"{name}/balanced_accuracy"] == pytest.approx(balanced_accuracy_score(truth, said))
        assert (counts[i].numpy() == confusion_matrix(truth, said)).all()
    each = [found[f"{name}/accuracy"] for name in TOUCH.names]
    assert found["overall/accuracy"] == pytest.approx(sum(each) / 4)


def test_a_gate_leaves_the_other_labels_to_the_touches_it_lets_through(scored):
    probabilities, labels = scored
    touched = torch.arange(400) % 3 > 0
    said = torch.where(torch.arange(400) % 4 > 0, 0.9, 0.2)
    labels = torch.cat([labels * touched[:, None], touched[:, None].float()], dim=1)
    found = compute_metrics(torch.cat([probabilities, said[:, None]], dim=1), labels, TOUCH_OR_NOT)
    alone = compute_metrics(probabilities[touched], labels[touched, :4], TOUCH)
    gate = {name: value for name, value in found.items() if name.startswith("touch/")}
    assert {name: value for name, value in found.items() if name not in gate} == alone
    assert gate["touch/accuracy"] == pytest.approx(accuracy_score(touched, said > 0.5))
    counts = count_confusions(torch.cat([probabilities, said[:, None]], dim=1), labels, TOUCH_OR_NOT)
    assert counts.sum(dim=(1, 2)).tolist() == [int(touched.sum())] * 4 + [400]
    assert torch.equal(counts[:4], count_confusions(probabilities[touched], labels[touched, :4]))


def test_angles_are_measured_on_touches_that_have_a_direction(scored):
    probabilities, labels = scored
    truth, error = torch.linspace(-3, 3, 400), torch.linspace(-4, 4, 400)
    slides = torch.stack([truth.cos(), truth.sin()], dim=1)
    slides[::3] = 0
    said = 0.3 * torch.stack([(truth + error).cos(), (truth + error).sin()], dim=1)
    given = torch.cat([probabilities, said], 1), torch.cat([labels, slides], 1)
    found = compute_metrics(*given, TOUCH_SLIDING)
    # The short way round; -3 + -4 and 3 + 4 pass behind the back.
    sizes = [min(abs(one), 2 * math.pi - abs(one)) for n, one in enumerate(error.tolist()) if n % 3]
    assert found["direction/degrees"] == pytest.approx(math.degrees(sum(sizes) / len(sizes)), rel=1e-5)
    within = sum(size <= math.pi / 4 for size in sizes) / len(sizes)
    assert found["direction/accuracy"] == pytest.approx(within)
    alone = compute_metrics(probabilities, labels, TOUCH)
    assert {name: found[name] for name in alone} == alone
    assert len(found) == len(alone) + 2
    # No direction is as wrong as a blind guess.
    label = torch.tensor([[1.0, 0.0]]).repeat(1, 3)
    assert metrics.measure_angles(torch.zeros(1, 6), label, TOUCH_SLIDING).tolist() == [90.0]


def test_calibration_error_in_bins_of_equal_numbers_is_that_of_plain_python():
    generator = torch.Generator().manual_seed(4)
    probability = torch.rand(1500, generator=generator) ** 3
    label = (torch.rand(1500, generator=generator) < 0.8 * probability).long()
    pairs = sorted(zip(probability.tolist(), label.tolist(), strict=True))
    gaps = []
    for start in range(0, 1500, 100):
        part = pairs[start : start + 100]
        gaps.append(abs(sum(said for said, _ in part) - sum(true for _, true in part)))
    assert metrics.calibration_error(probability, label) == pytest.approx(sum(gaps) / 1500, abs=1e-3)
    assert metrics.calibration_error(probability, (probability > 0.5).long()) > 0.1
    # Equal probabilities share a bin.
    assert metrics.calibration_error(torch.full((100,), 0.5), torch.tensor([1, 0] * 50)) < 1e-9


def test_means_over_gestures_are_the_metrics():
    generator = torch.Generator().manual_seed(2)
    probabilities = torch.rand(500, 4, generator=generator)
    labels = (torch.rand(500, 4, generator=generator) > 0.4).float()
    known = compute_metrics(probabilities, labels, TOUCH, POINT)
    codes = encode(probabilities, labels, TOUCH, POINT)
    assert codes.dtype == np.uint8
    dangerous = (f"dangerous/{kind}" for kind in ("accuracy", "alarm_recall", "false_alarm_rate"))
    for metric in ("overall/accuracy", "big/accuracy", *dangerous):
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
    probabilities = torch.rand(members, 400, 4, generator=generator)
    labels = (torch.rand(400, 4, generator=generator) > 0.4).float()
    codes = np.stack([encode(one, labels, TOUCH, POINT) for one in probabilities])
    found, answers = metrics.vote(codes), (probabilities > 0.5).float().mean(0)
    known = compute_metrics(answers, labels, TOUCH)
    for label in ("overall", *TOUCH.names):
        assert decode(found, f"{label}/accuracy", TOUCH).mean() == pytest.approx(known[f"{label}/accuracy"])
    alarms = (probabilities[..., TOUCH.names.index("dangerous")] > POINT.threshold).float().mean(0) > 0.5
    dangerous = labels[:, TOUCH.names.index("dangerous")] > 0.5
    recall = np.nanmean(decode(found, "dangerous/alarm_recall", TOUCH))
    assert recall == pytest.approx(float(alarms[dangerous].float().mean()))
    differ = ((probabilities > 0.5).any(0) & ~(probabilities > 0.5).all(0)).any(1)
    assert metrics.disagreement(codes) == pytest.approx(float(differ.float().mean()))


def test_unknown_labels_do_not_count(scored):
    """Each label is scored on the touches for which it is known, and none where it is never known."""
    probabilities, labels = scored
    part = labels.clone()
    part[100:, 0] = torch.nan
    values = compute_metrics(probabilities, part, TOUCH, POINT)
    first = compute_metrics(probabilities[:100], labels[:100], TOUCH)
    for name in ("accuracy", "balanced_accuracy", "ece"):
        assert values[f"{TOUCH.names[0]}/{name}"] == pytest.approx(first[f"{TOUCH.names[0]}/{name}"])
    assert encode(probabilities, part, TOUCH, POINT) is None
    part[:, 0] = torch.nan
    values = compute_metrics(probabilities, part, TOUCH)
    assert math.isnan(values[f"{TOUCH.names[0]}/accuracy"])
    others = [values[f"{name}/accuracy"] for name in TOUCH.names[1:]]
    assert values["overall/accuracy"] == pytest.approx(sum(others) / 3)
    task = Task(("a", "b", "c", "d"), "exclusive")
    truth = torch.eye(4)[torch.arange(400) % 4]
    truth[50:] = torch.nan
    known = compute_metrics(probabilities[:50], truth[:50], task)
    assert compute_metrics(probabilities, truth, task) == pytest.approx(known)


def test_errors_of_targets_are_in_their_units():
    """Unknown targets do not count."""
    task = Task(("x", "y", "force", "speed"), "regression")
    truth = torch.tensor([[0.0, 0.0, 1.0, 1.0], [0.01, 0.02, 3.0, 2.0], [0.02, 0.01, torch.nan, 3.0]])
    wrong = torch.tensor([[0.003, 0.004, 0.5, 0.0], [-0.003, 0.004, -0.5, 0.0], [0.003, -0.004, 9.0, 0.0]])
    values = compute_metrics(truth.nan_to_num() + wrong, truth, task)
    expected = {"x/rms_mm": 3, "y/rms_mm": 4, "place/rms_mm": 5, "force/rms_N": 0.5, "speed/rms": 0}
    assert {name: values[name] for name in expected} == pytest.approx(expected, abs=1e-5)
    spread = (1e-4 * 2 / 3, 1e-4 * 2 / 3, 1.0)
    fractions = [1 - 9e-6 / spread[0], 1 - 16e-6 / spread[1], 1 - 0.25, 1.0]
    assert values["overall/r2"] == pytest.approx(sum(fractions) / 4, rel=1e-4)
