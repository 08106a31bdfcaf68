"""Rules against brute force, and averages of learners."""

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from skin.errors import InputError
from skin.learning.boosted_trees import BoostedTrees
from skin.learning.data import TouchData
from skin.learning.learner import Ensemble, _threshold


@pytest.mark.parametrize("seed", range(5))
def test_the_threshold_is_the_best_of_all(seed):
    random = np.random.default_rng(seed)
    truth = random.integers(0, 2, 60).astype(float)
    scores = np.round(random.normal(size=60) + truth, 1)  # with ties
    accuracy, threshold = _threshold(scores, truth)
    assert accuracy == pytest.approx(((scores > threshold) == truth).mean())
    between = np.unique(scores)[:-1] + 0.05
    assert accuracy == pytest.approx(max(((scores > cut) == truth).mean() for cut in between))


def test_it_says_the_mean_of_what_its_members_say(configured, made_up_device):
    data = TouchData(made_up_device, instantiate(configured("representation=readings").representation), 32)
    whole = Ensemble(
        {"few": lambda seed: BoostedTrees(5, seed=seed), "many": lambda seed: BoostedTrees(20, seed=seed)}
    )
    whole.fit(data)
    touches = made_up_device.touches("test")
    each = []
    for number, rounds in enumerate((5, 20)):
        member = BoostedTrees(rounds, seed=number)
        member.fit(data)
        each.append(member.probabilities(touches))
    torch.testing.assert_close(whole.probabilities(touches), (each[0] + each[1]) / 2)


def test_copies_have_seeds_of_their_own():
    seeds = []

    def make(seed):
        seeds.append(seed)
        return BoostedTrees(seed=seed)

    Ensemble({"trees": make}, {"trees": 3}, seed=2)
    assert seeds == [2000, 2001, 2002]


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="no member"):
        Ensemble({"trees": BoostedTrees}, {"trees": 0})
    with pytest.raises(InputError, match="copies names net"):
        Ensemble({"trees": BoostedTrees}, {"net": 1})
