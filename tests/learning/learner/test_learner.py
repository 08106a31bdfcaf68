"""What every learner must do; rules against brute force, averages of learners, and boosted trees."""

import os
from functools import partial

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from skin.core.files import CONF
from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics
from skin.learning.boosted_trees import BoostedTrees
from skin.learning.data import TouchData
from skin.learning.learner import Ensemble, Rules, _threshold
from skin.learning.representation import Readings
from skin.touch.labels import TOUCH_SLIDING, Task


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
    whole = Ensemble({"few": partial(BoostedTrees, 5), "many": partial(BoostedTrees, 20)})
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


OPTIONS = sorted(path.stem for path in (CONF / "learner").glob("*.yaml"))
DENSE = ["representation=readings", "model=mlp", "fusion=early", "optimizer.lr=0.01", "trainer.max_epochs=15"]
CHEAP = {
    "network": DENSE,
    "boosted_trees": ["learner.rounds=20"],
    "chosen": ["learner.folds=2", "learner.members.extra_trees.trees=30"],
    "extra_trees": ["learner.trees=30"],
    "ensemble": [*DENSE, "learner.members.features.rounds=20", "learner.copies.network=2"],
}
SEVERAL = {"chosen", "ensemble"}


@pytest.fixture(params=OPTIONS)
def made(request, configured, made_up_device, tmp_path, monkeypatch):
    """Return a function that makes the learner, its data, and the device; in an empty folder."""
    monkeypatch.chdir(tmp_path)
    config = configured(f"learner={request.param}", *CHEAP.get(request.param, []))
    data = TouchData(made_up_device, instantiate(config.representation), 32)
    return lambda: instantiate(config.learner, seed=0), data, made_up_device


@pytest.fixture(scope="module")
def trained():
    """Return learners that have learnt, by option: a training takes seconds."""
    return {}


@pytest.fixture
def fitted(request, made, trained):
    """Return a learner that has learnt, its data, and the device."""
    make, data, device = made
    option = request.node.callspec.params["made"]
    if option not in trained:
        trained[option] = make()
        trained[option].fit(data)
    return trained[option], data, device


def test_it_learns(fitted):
    learner, _, device = fitted
    touches = device.touches("test")
    result = learner.probabilities(touches)
    assert result.shape == (40, 4)
    assert ((result >= 0) & (result <= 1)).all()
    right = ((result > 0.5) == (touches.labels > 0.5)).float().mean(dim=0)
    assert right.mean() > 0.8
    assert right.min() > 0.6


def test_touches_do_not_see_each_other(fitted):
    learner, _, device = fitted
    touches = device.touches("test")
    torch.testing.assert_close(learner.probabilities(touches[3:5]), learner.probabilities(touches)[3:5])


def test_it_reloads(made, fitted, tmp_path):
    learner, data, device = fitted
    path = learner.save(tmp_path)
    other = made[0]()
    other.load(data, path)
    touches = device.touches("test")
    assert torch.equal(other.probabilities(touches), learner.probabilities(touches))
    assert other.parameters == learner.parameters


def test_the_same_seed_gives_the_same_learner_without_a_file_and_a_trace_in_the_random_state(made, fitted):
    learner, data, device = fitted
    again, state = made[0](), torch.get_rng_state()
    again.fit(data)
    assert torch.equal(torch.get_rng_state(), state)
    assert os.listdir() == []
    touches = device.touches("test")
    torch.testing.assert_close(again.probabilities(touches), learner.probabilities(touches))


class Sliding(AbstractDevice):
    """Yields bumps that slide over 16 sensors, 6 mm a frame, every way; each fourth one goes nowhere."""

    task, size, rate = TOUCH_SLIDING, (0.16, 0.16), 10.0

    def touches(self, split: str, epoch: int = 0) -> Touches:
        """Return 320 touches to train on, 80 else."""
        generator = torch.Generator().manual_seed(sum(map(ord, split)))
        count = 320 if split == "train" else 80
        angle = 2 * torch.pi * torch.rand(count, generator=generator)
        goes = (torch.arange(count) % 4 > 0).float()
        cosines = torch.stack([angle.cos(), angle.sin()], dim=1) * goes[:, None]
        sites = torch.cartesian_prod(torch.linspace(0.02, 0.14, 4), torch.linspace(0.02, 0.14, 4))
        middle = 0.08 + 0.02 * torch.randn(count, 1, 2, generator=generator)
        way = middle + 0.006 * (torch.arange(10) - 4.5)[:, None] * cosines[:, None]
        readings = 3 * torch.exp(-((torch.cdist(way, sites[None]) / 0.03) ** 2))
        readings[:, :2] = readings[:, -2:] = 0
        labels = torch.rand(count, 4, generator=generator).round()
        labels[:, 1] = goes
        positions = torch.cat([sites, torch.full((16, 1), 0.005)], dim=1)
        labels = torch.cat([labels, cosines], dim=1)
        return Touches(readings, torch.ones_like(readings, dtype=torch.bool), positions, labels, self.rate)


def by_option(slow: str):
    """Choose the options of ``made``: those that train several learners are slow."""
    marks = {name: pytest.mark.slow(slow) for name in SEVERAL}
    options = [pytest.param(name, marks=marks.get(name, ())) for name in OPTIONS]
    return pytest.mark.parametrize("made", options, indirect=True)


@by_option("trains several learners, as the other cases of them do")
def test_a_direction_is_learnt_or_refused_by_name(made, configured, tmp_path):
    device = Sliding()
    learner = made[0]()
    data = TouchData(device, instantiate(configured("representation=readings").representation), 32)
    if isinstance(learner, Rules):
        with pytest.raises(InputError, match=r"got big, .*slide_x, slide_y: use learner=boosted_trees"):
            learner.fit(data)
        return
    learner.fit(data)
    touches = device.touches("test")
    result = learner.probabilities(touches)
    assert result.shape == (80, 6)
    found = compute_metrics(result, touches.labels, device.task)
    assert found["direction/degrees"] < 30
    assert found["direction/accuracy"] > 0.8
    other = made[0]()
    other.load(data, learner.save(tmp_path))
    assert torch.equal(other.probabilities(touches), result)


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
