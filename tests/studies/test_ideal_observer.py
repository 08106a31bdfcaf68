"""The errors of an ideal observer against plain Monte Carlo, and at the ends of the noise."""

import numpy as np
import pytest
import torch

from experiments.studies.gesture_prior import GesturePrior
from experiments.studies.ideal_observer import IdealObserver
from experiments.studies.posterior_samples import Samples, next_share
from skin.build import build_device
from skin.errors import InputError

_NOISE = 8.0  # N: leaves many explanations of each touch


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "data.gestures=20", f"device.noise={_NOISE}"))


@pytest.fixture(scope="module")
def prior(device):
    return GesturePrior(device, draws=300)


@pytest.fixture(scope="module")
def drawn(device):
    """Return gestures of the device without noise, drawn as in a training."""
    return device.replace(noise=0.0, test_gestures=8000).recording("test", complete=False)


def test_the_pool_and_its_density_agree(prior):
    log, labels, readings = prior.evaluate(prior.pool)
    assert np.isfinite(log).all()
    assert labels.mean(axis=0) == pytest.approx(0.5, abs=0.05)
    torch.testing.assert_close(readings, prior.readings, rtol=1e-4, atol=1e-4)


def test_weights_make_the_pool_as_the_gestures_of_the_device(prior, drawn):
    weights = np.exp(prior.weights) / np.exp(prior.weights).sum()
    effective = 1 / (weights**2).sum()
    assert weights @ prior.evaluate(prior.pool)[1] == pytest.approx(0.5, abs=0.005)
    for name in ("area", "peak", "duration", "onset"):
        expected = drawn.parameters[name].double().numpy()
        error = expected.std() / np.sqrt(effective) + 1e-9
        assert weights @ prior.pool[name] == pytest.approx(expected.mean(), abs=4 * error), name


@pytest.mark.slow
def test_moves_keep_the_prior_where_readings_say_nothing(device, drawn):
    vague = GesturePrior(device.replace(noise=1e5), draws=300)
    samples = Samples(vague, vague.readings[:60], 64, np.random.default_rng(0))
    before = samples._state["x"].copy()
    for _ in range(60):
        samples._move(np.arange(60))
    assert (samples._state["x"] != before).mean() > 0.9
    assert samples._labels.mean(axis=(0, 1)) == pytest.approx(0.5, abs=0.04)
    for name in ("area", "peak", "duration", "onset", "shape"):
        expected = drawn.parameters[name].double().numpy()
        assert samples._state[name].mean() == pytest.approx(expected.mean(), rel=0.05, abs=1e-9), name


@pytest.mark.slow
def test_probabilities_agree_with_importance_sampling_from_the_device(prior, drawn):
    count, random = 60, np.random.default_rng(0)
    readings, labels = drawn.touches.readings, drawn.touches.labels.numpy() > 0.5
    error = torch.from_numpy(random.standard_normal(readings[:count].shape)).float()
    measured, others = readings[:count] + _NOISE * error, readings[count:].flatten(1).double()
    apart = torch.cdist(measured.flatten(1).double(), others).square().numpy() / _NOISE**2
    weights = np.exp(-0.5 * (apart - apart.min(axis=1, keepdims=True)))
    weights /= weights.sum(axis=1, keepdims=True)
    expected, effective = weights @ labels[count:], 1 / (weights**2).sum(axis=1)
    found = Samples(prior, measured, 64, random).run(4)
    known = effective > 100
    assert known.sum() > 20
    share = expected[known].clip(0.01, 0.99)
    error = np.sqrt(share * (1 - share) * (1 / effective[known, None] + 1 / 64))
    apart = (found - expected)[known] / error
    assert np.abs(apart.mean(axis=0)).max() < 4 / np.sqrt(known.sum())
    assert np.sqrt((apart**2).mean()) < 1.5


def test_readings_with_little_noise_leave_little_doubt(device):
    prior = GesturePrior(device.replace(noise=0.03), draws=40)
    known, labels, misfit = IdealObserver(touches=16, samples=32, moves=4).posterior(prior)
    assert np.abs(known - labels).mean() < 0.02
    assert misfit == pytest.approx(1, abs=0.25)


def test_the_share_keeps_as_many_samples_effective_as_wanted():
    fit = np.random.default_rng(0).normal(0, 50, 100)
    share = next_share(fit, 0.01, 60)
    weights = np.exp((share - 0.01) * fit)
    assert weights.sum() ** 2 / (weights**2).sum() == pytest.approx(60, rel=0.01)
    assert next_share(fit * 1e-3, 0.01, 60) == 1.0


@pytest.mark.parametrize("overrides", [["profile=rough"], ["data.stream=true"]])
def test_other_densities_are_refused(configured, overrides):
    device = build_device(configured("simulator=fem", "data.gestures=20", *overrides))
    with pytest.raises(InputError, match="the density of"):
        GesturePrior(device)
