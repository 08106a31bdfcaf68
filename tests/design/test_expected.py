"""The expected posterior agrees with estimates of `skin.Posterior`, and its derivatives with differences."""

from functools import cache, partial

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.design.drawing import print_blind_places
from skin.design.expected import ExpectedPosterior, Sensitivity, local_covariance, sensitivity
from skin.inference.candidates import FingertipPrior, disc_readings
from skin.inference.noise import Noise
from skin.inference.posterior import Posterior
from skin.mechanics.geometry import Fingertip
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid
from tests.budget import free

ECOFLEX = {"name": "EcoFlex 00-30", "young": 170e3, "poisson": 0.49}
BODY = Sheet((0.12, 0.08), (24, 16), [{"material": ECOFLEX, "thickness": 0.02}])


@cache
def solid():
    with free():
        return Solid(BODY, Grid(2, 3, depth=0.0195).sensors(BODY), divisions=3)


def design(**settings):
    return ExpectedPosterior(**{"forces": (5.0,), "touches": 256, **settings})


def rms(values):
    return np.sqrt((values**2).mean())


def per_axis(errors):
    return np.sqrt((errors**2).mean(-1))


def standard_error(values, statistic):
    rng = np.random.default_rng(1)
    return np.std([statistic(rng.choice(values, len(values))) for _ in range(300)])


@cache
def monte_carlo(count=300):
    """Return errors of place, m, radius, m, and force, relative, and which touches raise a sensor."""
    rng = np.random.default_rng(11)
    prior = FingertipPrior(5.0, numbers=(0, 1, 0, 0), large=0)
    noise = Noise(0.05, 10, clip=10.0)
    discs = np.column_stack([rng.uniform(0, 1, (count, 2)) * BODY.size, rng.uniform(0.004, 0.012, count)])
    force = 5 * np.exp(0.5 * rng.standard_normal(count))
    true = disc_readings(solid(), BODY, discs, prior.rim) * force[:, None]
    readings = true + np.sqrt(noise.floor) * rng.standard_normal(true.shape)
    with free():
        estimates = Posterior(solid(), noise, BODY, prior, contacts=1).estimate(readings)
    contacts = [estimate.contacts[0] for estimate in estimates]
    position = per_axis(np.array([contact.position for contact in contacts]) - discs[:, :2])
    radius = np.abs([contact.radius for contact in contacts] - discs[:, 2])
    relative = np.abs([contact.force for contact in contacts] - force) / force
    return position, radius, relative, (true > 3 * noise.frame).any(1)


def test_findings_are_those_of_estimates_of_other_touches():
    (finding,) = design().find(solid(), BODY)
    position, radius, relative, raised = monte_carlo()
    pairs = [
        (finding.place_m, position, rms),
        (finding.place_median_m, position, np.median),
        (finding.place_90_m, position, lambda values: np.quantile(values, 0.9)),
        (finding.place_raised_m, position[raised], rms),
        (finding.radius_m, radius, np.median),
        (finding.force_relative, relative, np.median),
        (finding.blind_share, ~raised, np.mean),
    ]
    for value, sample, statistic in pairs:
        # Both are samples, of about the same number.
        assert value == pytest.approx(statistic(sample), abs=3 * 2**0.5 * standard_error(sample, statistic))


def test_the_posterior_says_how_far_it_errs_and_the_map_shows_where():
    expected = design(touches=400)
    (trials,) = expected.trials(solid(), BODY).values()
    errors = per_axis(trials.means[:, :2] - trials.touches[:, :2])
    assert 0.7 < (errors**2).mean() / (trials.deviation**2).mean() < 1.4
    shown = expected.expected_map(trials, BODY)
    assert shown.shape == BODY.shape
    assert rms(shown) == pytest.approx(rms(trials.deviation), rel=0.1)
    # Actual errors are larger where the map is high.
    column, row = (trials.touches[:, :2] / np.array(BODY.cell)).astype(int).T
    near = shown[row, column]
    high = near > np.median(near)
    assert rms(errors[high]) > 1.2 * rms(errors[~high])


def test_a_map_shows_from_which_force_a_touch_is_felt(capsys):
    sensors, forces = Grid(2, 3, depth=0.0195).sensors(BODY), (20.0, 0.1, 5.0)
    expected = design(forces=forces)
    places = np.array([[0.04, 0.04], [0.02, 0.02]])  # in the middle between four sensors, and above one
    readings = disc_readings(solid(), BODY, np.column_stack([places, [0.008, 0.008]]), expected.rim).max(1)
    unfelt = expected.count_unfelt(solid(), BODY, places)
    assert unfelt.tolist() == [sum(force * reading <= 0.15 for force in forces) for reading in readings]
    assert unfelt.tolist() == [3, 1]
    print_blind_places(BODY, sensors, forces, lambda where: expected.count_unfelt(solid(), BODY, where))
    *rows, named = capsys.readouterr().out.splitlines()[2:]
    cells = [row.split() for row in rows]
    assert {len(row) for row in cells} == {20}
    shown = [[row[3], row[10], row[16]] for row in cells if "s0" in row or "s3" in row]
    assert shown == [["s0", "s1", "s2"], ["s3", "s4", "s5"]]
    assert {text for row in cells for text in row if text[0] != "s"} == {"5", "20", "##"}
    assert named == "A fingertip of 5 N is not felt between sensors 0, 1, 3, 4; 1, 2, 4, 5."


def test_the_map_has_no_value_where_no_touch_is():
    expected = design(touches=32, margin=0.02)
    (trials,) = expected.trials(solid(), BODY).values()
    shown = expected.expected_map(trials, BODY)
    assert np.isnan(shown[:4]).all()
    assert np.isnan(shown[:, -4:]).all()
    assert np.isfinite(shown[4:-4, 4:-4]).all()
    assert (trials.touches[:, :2] >= 0.02).all()


@pytest.mark.parametrize(("setting", "values"), [("noise", (0.02, 0.5)), ("gain", (0.0, 0.3))])
def test_noise_and_unknown_gains_cost_precision(setting, values):
    less, more = (design(touches=128, **{setting: value}).find(solid(), BODY)[0] for value in values)
    assert less.place_median_m < more.place_median_m
    assert less.force_relative < more.force_relative


STACK = [
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
    body = sheet(STACK)
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
    body = sheet(STACK)
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
