"""The labels that an ideal observer finds."""

import numpy as np
import pytest

from experiments.studies.gesture_prior import GesturePrior
from experiments.studies.ideal_observer import IdealObserver


def test_readings_with_little_noise_leave_little_doubt(noisy_device):
    prior = GesturePrior(noisy_device.replace(noise=0.03), draws=40)
    known, labels, misfit = IdealObserver(touches=16, samples=32, moves=4).posterior(prior)
    assert np.abs(known - labels).mean() < 0.02
    assert misfit == pytest.approx(1, abs=0.25)
