"""Boosted trees."""

import pytest
import torch

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.boosted_trees import BoostedTrees
from skin.learning.data import TouchData
from skin.learning.representation import Readings
from skin.touch.labels import Task


def relabel(device, change):
    """Change the labels of a device by a function of them and the split, in place."""
    touches = device.touches

    def changed(split, epoch=0):
        drawn = touches(split)
        change(drawn.labels, split)
        return drawn

    device.touches = changed


def test_labels_that_cannot_be_learned_are_refused(made_up_device):
    def constant(labels, split):
        labels[:, 2] = 1

    relabel(made_up_device, constant)
    with pytest.raises(InputError, match="the same label press"):
        BoostedTrees(rounds=2).fit(TouchData(made_up_device, Readings))

    def without_direction(labels, split):
        labels[:, 2:] = (torch.arange(len(labels)) % 2)[:, None] * 2 - 1 if split == "train" else 0

    made_up_device.task = Task(("a", "b", "x", "y"), direction=True)
    relabel(made_up_device, without_direction)
    with pytest.raises(InputError, match="no validation touch has a label x: give more touches"):
        BoostedTrees(rounds=2).fit(TouchData(made_up_device, Readings))


def test_trees_do_not_learn_from_unknown_labels(made_up_device):
    """Trees with labels that are unknown are those that were trained without these touches."""
    touches = made_up_device.touches

    def fitted(change) -> torch.Tensor:
        made_up_device.touches = lambda split, epoch=0: change(touches(split))
        trees = BoostedTrees(rounds=5)
        trees.fit(TouchData(made_up_device, Readings))
        return trees.probabilities(touches("test"))

    def hidden(whole: Touches) -> Touches:
        labels = whole.labels.clone()
        labels[::3] = torch.nan
        return Touches(whole.readings, whole.valid, whole.positions, labels, whole.rate)

    def shortened(whole: Touches) -> Touches:
        return whole[torch.arange(len(whole)) % 3 > 0]

    assert torch.equal(fitted(hidden), fitted(shortened))
