"""Samples of the posterior against the prior and against importance sampling."""

import numpy as np
import pytest
import torch

from experiments.studies.gesture_prior import GesturePrior
from experiments.studies.posterior_samples import Samples, next_share
from tests.studies.conftest import NOISE


@pytest.mark.slow
def test_moves_keep_the_prior_where_readings_say_nothing(noisy_device, drawn):
    vague = GesturePrior(noisy_device.replace(noise=1e5), draws=300)
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
    measured, others = readings[:count] + NOISE * error, readings[count:].flatten(1).double()
    apart = torch.cdist(measured.flatten(1).double(), others).square().numpy() / NOISE**2
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


def test_the_share_keeps_as_many_samples_effective_as_wanted():
    fit = np.random.default_rng(0).normal(0, 50, 100)
    share = next_share(fit, 0.01, 60)
    weights = np.exp((share - 0.01) * fit)
    assert weights.sum() ** 2 / (weights**2).sum() == pytest.approx(60, rel=0.01)
    assert next_share(fit * 1e-3, 0.01, 60) == 1.0
