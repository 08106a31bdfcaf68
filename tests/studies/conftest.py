"""A naive device with much noise, the prior of its gestures, and gestures without noise."""

import pytest

from experiments.studies.gesture_prior import GesturePrior
from skin.build import build_device

NOISE = 8.0  # N: leaves many explanations of each touch


@pytest.fixture(scope="package")
def noisy_device(configured):
    return build_device(configured("simulator=naive", "data.gestures=20", f"device.noise={NOISE}"))


@pytest.fixture(scope="package")
def prior(noisy_device):
    return GesturePrior(noisy_device, draws=300)


@pytest.fixture(scope="package")
def drawn(noisy_device):
    """Return gestures of the device without noise, drawn as in a training."""
    return noisy_device.replace(noise=0.0, test_gestures=8000).recording("test", complete=False)
