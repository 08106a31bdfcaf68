"""Thresholds against brute force."""

import json

import numpy as np
import pytest

from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.learner import Rules, _threshold
from skin.learning.representation import Readings
from skin.touch.labels import Task


@pytest.mark.parametrize("seed", range(5))
def test_the_threshold_is_the_best_of_all(seed):
    random = np.random.default_rng(seed)
    truth = random.integers(0, 2, 60).astype(float)
    scores = np.round(random.normal(size=60) + truth, 1)  # with ties
    accuracy, threshold = _threshold(scores, truth)
    assert accuracy == pytest.approx(((scores > threshold) == truth).mean())
    between = np.unique(scores)[:-1] + 0.05
    assert accuracy == pytest.approx(max(((scores > cut) == truth).mean() for cut in between))


def test_scores_that_are_all_equal_tell_nothing():
    assert _threshold(np.ones(4), np.array([1.0, 1, 1, 0]))[0] == 0.75


def test_one_half_is_at_the_threshold_and_the_rule_can_be_read(made_up_device, tmp_path):
    rules = Rules()
    rules.fit(TouchData(made_up_device, Readings))
    stored = json.loads(rules.save(tmp_path).read_text())
    assert stored["press"]["measurement"].startswith("longest run")
    assert 2 < stored["press"]["threshold"] < 6
    assert 1 < stored["dangerous"]["threshold"] < 5


def test_other_labels_are_refused(made_up_device):
    made_up_device.task = Task(("grab", "hit"), "exclusive")
    with pytest.raises(InputError, match="got grab, hit: use learner=boosted_trees"):
        Rules().fit(TouchData(made_up_device, Readings))
