"""Boosted trees."""

import zipfile
from pathlib import Path

import pytest
import torch

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.boosted_trees import BoostedTrees
from skin.learning.data import TouchData
from skin.learning.representation import Readings
from skin.touch.labels import Task


def test_exclusive_probabilities_sum_to_one(made_up_device):
    made_up_device.task = Task(("a", "b", "c", "d"), "exclusive")
    features = BoostedTrees(rounds=5)
    features.fit(TouchData(made_up_device, Readings))
    total = features.probabilities(made_up_device.touches("test")).sum(dim=1)
    torch.testing.assert_close(total, torch.ones(40))


def test_validation_chooses_the_number_of_trees(made_up_device):
    few, many = BoostedTrees(rounds=4), BoostedTrees(rounds=400)
    for features in (few, many):
        features.fit(TouchData(made_up_device, Readings))
    assert few.parameters < many.parameters
    assert all(model.n_iter_ < 400 for model in many.learned[0])


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


def test_what_is_stored_predicts_the_same_bits_without_a_pickle(made_up_device, tmp_path):
    features, again = BoostedTrees(rounds=20), BoostedTrees()
    data = TouchData(made_up_device, Readings)
    features.fit(data)
    path = features.save(tmp_path)
    with zipfile.ZipFile(path) as archive:
        assert {Path(name).suffix for name in archive.namelist()} == {".json", ".npy"}
    again.load(data, path)
    assert again.parameters == features.parameters
    touches = made_up_device.touches("test")
    assert torch.equal(again.probabilities(touches), features.probabilities(touches))


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
