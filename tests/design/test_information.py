"""The local precision follows from correct derivatives, and estimates have it where three sensors respond."""

from functools import partial

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.design.expected import Sensitivity, local_covariance, sensitivity
from skin.inference.noise import Noise
from skin.mechanics.geometry import Fingertip
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid

LAYERS = [
    {"material": {"name": "muscle", "young": 560e3, "poisson": 0.49}, "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


def sheet(layers):
    return Sheet([0.12, 0.12], [16, 16], layers)


def touches(count, seed, force=1.0):
    """Return touches at least 20 mm from the edges, (count, 4)."""
    fractions = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    positions, radii = 0.02 + 0.08 * fractions[:, :2], 0.004 + 0.008 * fractions[:, 2:]
    return torch.cat([positions, radii, torch.full((count, 1), force, dtype=torch.float64)], dim=1)


@pytest.mark.parametrize(
    "make",
    [Naive, PlatesAndBeams, partial(PlatesAndBeams, reading="interface"), partial(Solid, divisions=2)],
    ids=["naive", "equation10", "interface", "solid"],
)
def test_derivatives_are_those_of_differences(make):
    body = sheet(LAYERS)
    simulator = make(body, Grid(4, 4).sensors(body))
    fingertip = Fingertip(body, 0.0015, simulator.smooth)
    given = touches(20, 0, force=2.0)
    found = sensitivity(simulator, fingertip, given)
    assert found.readings.numpy() == pytest.approx(simulator.press(fingertip(given)).readings.numpy())
    for axis, step in enumerate((1e-6, 1e-6, 1e-6, 1e-3)):
        move = torch.zeros(4, dtype=torch.float64)
        move[axis] = step
        above, below = (simulator.press(fingertip(given + sign * move)).readings for sign in (1, -1))
        slopes = ((above - below) / (2 * step)).numpy()
        scale = np.abs(slopes).max()
        assert scale > 0
        assert found.slopes[..., axis].numpy() / scale == pytest.approx(slopes / scale, abs=1e-6)


def test_the_sensitivity_of_another_force_follows_from_that_of_one_newton():
    body = sheet(LAYERS)
    simulator, fingertip = PlatesAndBeams(body, Grid(4, 4).sensors(body)), Fingertip(body, 0.0015)
    scaled = sensitivity(simulator, fingertip, touches(20, 1)).of_force(7.0)
    direct = sensitivity(simulator, fingertip, touches(20, 1, force=7.0))
    torch.testing.assert_close(scaled.readings, direct.readings)
    torch.testing.assert_close(scaled.slopes, direct.slopes)


def test_without_a_reading_the_covariance_is_that_of_the_priors_and_sensors_that_clip_tell_nothing():
    priors = torch.tensor([0.03, 0.04, 0.002, 2.0], dtype=torch.float64)
    slopes = torch.ones(2, 3, 4, dtype=torch.float64)
    readings = torch.full((2, 3), 5.0, dtype=torch.float64)
    for none, noise in (
        (Sensitivity(0 * readings, 0 * slopes), Noise(0.05)),
        (Sensitivity(readings, slopes), Noise(0.05, clip=5.0)),
    ):
        torch.testing.assert_close(local_covariance(none, noise, priors)[0], torch.diag(priors.square()))


def test_more_frames_and_known_gains_lower_the_variance():
    readings = torch.ones(1, 1, dtype=torch.float64)
    slopes = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]], dtype=torch.float64)
    priors = torch.tensor([1.0, 1.0, 1.0, 1e6], dtype=torch.float64)

    def force(**settings):
        variances = local_covariance(Sensitivity(readings, slopes), Noise(0.1, **settings), priors)
        return variances[0, 3, 3].sqrt().item()

    assert force() == pytest.approx(0.1)  # one sensor that reads the force itself
    assert force(frames=4) == pytest.approx(0.05)
    assert force(frames=4, gain=0.12) == pytest.approx(0.13)
