"""Touched or not, against brute force."""

import pytest
import torch
from sklearn.metrics import balanced_accuracy_score

from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.streams import ContactThreshold, gates, rise
from skin.touch.labels import TOUCH, TOUCH_OR_NOT


def touches(readings, valid=None):
    valid = torch.ones_like(readings, dtype=torch.bool) if valid is None else valid
    return Touches(readings, valid, torch.zeros(readings.shape[2], 3), None, 10.0)


@pytest.fixture
def noisy():
    return 0.05 * torch.randn(40, 30, 5, generator=torch.Generator().manual_seed(0))


def test_the_rise_is_the_largest_reading_above_what_the_untouched_skin_reads(noisy):
    idle = torch.tensor([3.0, -2.0, 0.5, 10.0, 0.0])
    found = rise(touches(noisy + idle), idle)
    for window, value in zip(noisy, found, strict=True):
        assert value.item() == pytest.approx(max(max(row) for row in window.tolist()), abs=1e-5)


def test_a_sensor_that_means_nothing_does_not_rise(noisy):
    broken = noisy.clone()
    broken[:, 10, 4] = 50
    valid = torch.ones_like(broken, dtype=torch.bool)
    valid[:, :, 4] = False
    torch.testing.assert_close(rise(touches(broken, valid)), rise(touches(noisy[..., :4])))


@pytest.mark.parametrize("seed", range(4))
def test_no_threshold_tells_better_than_the_tuned_one(seed):
    generator = torch.Generator().manual_seed(seed)
    touched = torch.rand(80, generator=generator) < 0.8
    rises = (torch.rand(80, generator=generator) + 0.6 * touched).round(decimals=2)  # with ties
    tuned = ContactThreshold.tuned(rises, touched)
    best = max(balanced_accuracy_score(touched, rises >= cut) for cut in rises.tolist())
    assert balanced_accuracy_score(touched, rises >= tuned.minimum) == pytest.approx(best)


def test_windows_that_are_all_alike_tune_nothing():
    with pytest.raises(InputError, match=r"data.gestures"):
        ContactThreshold.tuned(torch.rand(5), torch.ones(5, dtype=torch.bool))


def test_only_a_task_with_a_gate_has_a_learned_one(noisy):
    assert list(gates(ContactThreshold(0.3), TOUCH)) == ["none", "threshold"]
    noisy[3, 5, 1] += 2
    found = gates(ContactThreshold(0.5), TOUCH_OR_NOT)
    probabilities = torch.zeros(40, 5)
    probabilities[7, 4] = 0.6
    open_at = lambda gate: gate(touches(noisy), probabilities).nonzero().flatten().tolist()  # noqa: E731
    said = {name: open_at(gate) for name, gate in found.items()}
    assert said == {"none": list(range(40)), "threshold": [3], "learned": [7]}
