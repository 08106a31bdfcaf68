"""The pool of gestures against those of the device."""

import numpy as np
import pytest
import torch

from experiments.studies.gesture_prior import GesturePrior
from skin.build import build_device
from skin.errors import InputError


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


@pytest.mark.parametrize("overrides", [["profile=rough"], ["data.stream=true"]])
def test_other_densities_are_refused(configured, overrides):
    device = build_device(configured("simulator=fem", "data.gestures=20", *overrides))
    with pytest.raises(InputError, match="the density of"):
        GesturePrior(device)
