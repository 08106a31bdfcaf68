"""What every learner must do."""

import os
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate

from skin.device.base import AbstractDevice
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics
from skin.learning.data import TouchData
from skin.learning.learner import Rules
from skin.touch.labels import TOUCH_SLIDING

OPTIONS = sorted(path.stem for path in (Path(__file__).parents[3] / "conf" / "learner").glob("*.yaml"))
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


def test_the_same_seed_gives_the_same_learner(made, fitted):
    learner, data, device = fitted
    again = made[0]()
    again.fit(data)
    touches = device.touches("test")
    torch.testing.assert_close(again.probabilities(touches), learner.probabilities(touches))


def test_it_leaves_no_file_and_no_trace_in_the_random_state(made):
    make, data, _ = made
    state = torch.get_rng_state()
    make().fit(data)
    assert torch.equal(torch.get_rng_state(), state)
    assert os.listdir() == []


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
