"""Peers fit and apply a model in another process; the fits of that against scikit-learn."""

import gc
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator

from experiments.peers import PYTHON
from experiments.peers.rocket import Rocket
from experiments.peers.worker import platt
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.touch.labels import TOUCH_SLIDING


@pytest.fixture
def data(configured, made_up_device):
    return TouchData(made_up_device, instantiate(configured().representation), 32)


@pytest.fixture
def fitted(own_python, data):
    learner = Rocket(transform="flat")
    learner.fit(data)
    return learner


def test_it_learns_and_a_stored_model_predicts_the_same(fitted, data, tmp_path):
    touches = data.touches("test")
    expected = fitted.probabilities(touches)
    assert ((expected > 0.5) == (touches.labels > 0.5)).float().mean() > 0.7
    assert fitted.seconds_per_epoch > 0
    path = fitted.save(tmp_path)
    with np.load(path, allow_pickle=False) as arrays:
        assert {array.dtype.kind for array in arrays.values()} == {"f"}
    other = Rocket(transform="flat")
    other.load(data, path)
    assert other.parameters == fitted.parameters
    torch.testing.assert_close(other.probabilities(touches), expected)


def test_touches_of_another_shape_are_refused(fitted, data):
    touches = data.touches("test")
    parts = {"readings": touches.readings[..., 1:], "valid": touches.valid[..., 1:]}
    fewer = replace(touches, **parts, positions=touches.positions[1:])
    with pytest.raises(InputError, match="as many sensors and frames"):
        fitted.probabilities(fewer)
    with pytest.raises(RuntimeError, match="fit or load"):
        Rocket().probabilities(touches)


def test_a_model_of_other_labels_is_refused(fitted, data, tmp_path):
    path = fitted.save(tmp_path)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {name: arrays[name][..., :3] for name in ("weights", "bias")})
    with pytest.raises(ValueError, match="3 labels, not big, dynamic, press, dangerous"):
        Rocket(transform="flat").load(data, path)


@pytest.mark.parametrize(
    ("arrays", "error", "message"),
    [
        ({"weights": np.zeros((3, 4))}, RuntimeError, r"KeyError.*first"),
        ({"first": np.array([{}], dtype=object)}, ValueError, "Object arrays cannot be loaded"),
    ],
)
def test_a_damaged_file_is_refused_and_an_error_passed_on(own_python, data, tmp_path, arrays, error, message):
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(error, match=message):
        Rocket(transform="flat").load(data, tmp_path / "model.npz")


def test_without_its_environment_it_says_what_builds_it(monkeypatch, data, tmp_path):
    monkeypatch.setenv(PYTHON, str(tmp_path / "none"))
    with pytest.raises(InputError, match="none: make peers builds it"):
        Rocket().check(data)


def test_labels_that_it_cannot_learn_are_refused(own_python, data, monkeypatch):
    monkeypatch.setattr(data, "task", TOUCH_SLIDING)
    with pytest.raises(InputError, match="leave out"):
        Rocket().check(data)


def test_the_process_ends_with_the_learner(own_python, data):
    learner = Rocket(transform="flat")
    learner.fit(data)
    process = learner._process
    del learner
    gc.collect()
    assert process.poll() is not None


def test_a_worker_that_dies_is_reported(fitted, data):
    fitted._process.kill()
    fitted._process.wait()
    with pytest.raises(InputError, match="ended with exit code -9"):
        fitted.probabilities(data.touches("test"))


def test_a_channel_is_a_sensor_and_what_is_not_valid_is_0():
    readings = torch.randn(2, 10, 4, generator=torch.Generator().manual_seed(0))
    valid = torch.ones_like(readings, dtype=torch.bool)
    valid[..., 0] = False
    found = Rocket().inputs(Touches(readings, valid, torch.zeros(4, 3), None, 10.0))
    assert torch.equal(found[:, 1:], readings[..., 1:].mT)
    assert not found[:, 0].any()


@pytest.fixture
def own_python(monkeypatch):
    """Run the worker in this environment, which has all that a ridge without kernels needs."""
    monkeypatch.setenv(PYTHON, sys.executable)


class Scores(ClassifierMixin, BaseEstimator):
    """A classifier whose score is its only feature."""

    def fit(self, x, y):
        self.classes_ = np.array([0, 1])
        return self

    def decision_function(self, x):
        return x[:, 0]

    def predict(self, x):
        return (x[:, 0] > 0).astype(int)


def probability(curve, score):
    return 1 / (1 + np.exp(-(curve[0] * score + curve[1])))


def test_scores_become_probabilities_by_platt_scaling():
    random = np.random.default_rng(0)
    truth = random.integers(0, 2, 300)
    score = truth + 0.4 * random.standard_normal(300)
    theirs = CalibratedClassifierCV(FrozenEstimator(Scores().fit(None, None)), method="sigmoid")
    theirs.fit(score[:, None], truth)
    # Both search for the minimum of the same smooth loss.
    expected = theirs.predict_proba(score[:, None])[:, 1]
    assert probability(platt(score, truth), score) == pytest.approx(expected, abs=2e-3)


def test_scores_that_separate_the_classes_stay_finite_and_in_order():
    score = np.linspace(-1, 1, 40)
    found = probability(platt(score, (score > 0).astype(int)), score)
    assert (np.diff(found) > 0).all()
    assert 0 < found[0] < 0.1 < 0.9 < found[-1] < 1
