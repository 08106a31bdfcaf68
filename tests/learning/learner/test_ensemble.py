"""Averages of learners."""

import pytest
import torch
from hydra.utils import instantiate

from skin.errors import InputError
from skin.learning.boosted_trees import BoostedTrees
from skin.learning.data import TouchData
from skin.learning.learner import Ensemble


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
