"""The local precision follows from correct derivatives, and estimates have it where three sensors respond."""

import numpy as np
import pytest
import torch
from scipy.stats import chi2

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
THICK = [{"material": {"name": "EcoFlex 00-30", "young": 170e3, "poisson": 0.49}, "thickness": 0.02}]


def sheet(layers):
    return Sheet([0.12, 0.12], [16, 16], layers)


def touches(count, seed, force=1.0):
    """Return touches at least 20 mm from the edges, (count, 4)."""
    fractions = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    positions, radii = 0.02 + 0.08 * fractions[:, :2], 0.004 + 0.008 * fractions[:, 2:]
    return torch.cat([positions, radii, torch.full((count, 1), force, dtype=torch.float64)], dim=1)


@pytest.mark.parametrize(
    "make",
    [
        lambda body, sensors: Naive(body, sensors),
        lambda body, sensors: PlatesAndBeams(body, sensors),
        lambda body, sensors: PlatesAndBeams(body, sensors, reading="interface"),
        lambda body, sensors: Solid(body, sensors, divisions=2),
    ],
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


def estimate(simulator, fingertip, readings, start, noise, centre, priors):
    """Return the most probable parameters (B, 4) for readings (B, S): Levenberg-Marquardt from a start."""
    scale = priors

    def cost(position):
        missed = (simulator.press(fingertip(position)).readings - readings) / deviation
        return missed.square().sum(1) + ((position - centre) / scale).square().sum(1)

    deviation = noise.frame / noise.frames**0.5
    found, damping = start.clone(), torch.full((len(start), 1, 1), 1e-2, dtype=torch.float64)
    best = cost(found)
    for _ in range(15):
        now = sensitivity(simulator, fingertip, found)
        slopes = now.slopes * scale / deviation
        missed = (now.readings - readings) / deviation
        normal = slopes.mT @ slopes + torch.eye(4)
        towards = (slopes.mT @ missed[..., None])[..., 0] + (found - centre) / scale
        step = torch.linalg.solve(
            normal + damping * torch.diag_embed(normal.diagonal(dim1=1, dim2=2)), towards
        )
        tried = found - step * scale
        tried[:, 2:] = tried[:, 2:].clamp(min=1e-4)
        value = cost(tried)
        better = value < best
        found, best = torch.where(better[:, None], tried, found), torch.where(better, value, best)
        damping = torch.where(better[:, None, None], damping / 3, damping * 4)
    return found


@pytest.mark.slow("200 touches with four noises each")
def test_the_most_probable_place_has_the_local_precision():
    """200 touches that raise three sensors above five standard deviations, four noises each."""
    body, force, draws = sheet(THICK), 20.0, 4
    sensors = Grid(5, 5, depth=0.0195).sensors(body)
    simulator, noise = Solid(body, sensors, divisions=3), Noise(0.05, 10)
    fingertip = Fingertip(body, 0.0015, simulator.smooth)
    given = touches(2000, 2, force)
    felt = sensitivity(simulator, fingertip, given)
    clear = (felt.readings > 5 * noise.frame).sum(1) >= 3
    given, felt = given[clear][:200], Sensitivity(felt.readings[clear][:200], felt.slopes[clear][:200])
    assert len(given) == 200
    centre = torch.tensor([0.06, 0.06, 0.008, force], dtype=torch.float64)
    priors = torch.tensor([0.12 / 12**0.5, 0.12 / 12**0.5, 0.008 / 12**0.5, force / 2], dtype=torch.float64)
    variances = local_covariance(felt, noise, priors).diagonal(dim1=1, dim2=2)
    generator = torch.Generator().manual_seed(3)
    true = given.repeat_interleave(draws, 0)
    scatter = torch.randn(len(true), len(sensors), generator=generator, dtype=torch.float64)
    readings = felt.readings.repeat_interleave(draws, 0) + scatter * noise.frame / noise.frames**0.5
    found = estimate(simulator, fingertip, readings, true, noise, centre, priors)
    error = (found - true).square().unflatten(0, (200, draws)).mean(1)
    position = (error[:, :2].mean(1) / variances[:, :2].mean(1)).sqrt()
    # Medians of the root of the mean of eight and of four squared normal values: 0.96 and 0.92, not 1.
    normal = [(chi2(number).median() / number) ** 0.5 for number in (2 * draws, draws)]
    assert 0.9 < position.median() / normal[0] < 1.3
    assert 0.9 < (error[:, 3] / variances[:, 3]).sqrt().median() / normal[1] < 1.3
