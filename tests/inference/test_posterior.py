"""The posterior of contacts against brute force, calibration, and what devices do to readings."""

from copy import copy
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.special import expit, log_ndtr
from scipy.stats import kstest

import skin
from skin import Arm, FingertipPrior, Grid, InputError, Noise, PlatesAndBeams, Posterior, Sheet, Solid
from skin.inference.candidates import CandidateReadings, disc_readings
from skin.inference.posterior import ContactEstimate, FrameEstimate
from skin.mechanics.simulator.naive import Naive

SOFT = {"material": "EcoFlex 00-30"}
DEEP = Sheet((0.16, 0.16), (16, 16), [SOFT | {"thickness": 0.03}])
FIRM = {"material": "Dragon Skin 10 Medium", "thickness": 0.01}
THIN = Sheet((0.16, 0.16), (24, 24), [FIRM, SOFT | {"thickness": 0.005}])
SMALL = Sheet((0.08, 0.08), (8, 8), DEEP.layers)
NOISE = Noise(0.05, frames=10)
SINGLE = FingertipPrior(numbers=(0.0, 1.0, 0.0, 0.0), large=0.0)


@pytest.fixture(scope="module", autouse=True)
def shared_candidates():
    """Readings of candidates, which take seconds, once for each skin and kind of fingertip."""
    known = {}

    def candidates(simulator, body, prior):
        key = (simulator, prior.radii, prior.rim)
        if key not in known:
            known[key] = CandidateReadings(simulator, body, prior)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("skin.inference.posterior.CandidateReadings", candidates)
        for thin, body in enumerate((DEEP, THIN)):
            candidates(solid(bool(thin)), body, FingertipPrior())
        yield


def sensors_of(body, depth, side=5):
    return Grid(side, side, (0.01, 0.01), depth=depth).sensors(body)


@cache
def solid(thin=False):
    body, depth = (THIN, None) if thin else (DEEP, 0.0295)
    return Solid(body, sensors_of(body, depth), poisson={"Dragon Skin 10 Medium": 0.49})


@cache
def posterior(thin=False, noise=NOISE, prior=None, contacts=3):
    return Posterior(solid(thin), noise, THIN if thin else DEEP, prior, contacts)


def draw(count, seed, number=1, margin=0.0, apart=0.0):
    """Return contacts (count, number, 4) of the default prior: x, y, radius, m, and force, N."""
    rng, touches = np.random.default_rng(seed), []
    while len(touches) < count:
        positions = rng.uniform(margin, 0.16 - margin, (number, 2))
        radius, force = rng.uniform(0.004, 0.012, number), 5 * np.exp(0.5 * rng.standard_normal(number))
        distance = np.linalg.norm(positions[:, None] - positions, axis=2)[np.triu_indices(number, 1)]
        if (distance >= apart).all():
            touches.append(np.column_stack([positions, radius, force]))
    return np.array(touches)


def true_readings(touches, thin=False):
    """Return the true readings (count, 25), N."""
    flat = touches.reshape(-1, 4)
    body = THIN if thin else DEEP
    readings = disc_readings(solid(thin), body, flat[:, :3], FingertipPrior().rim) * flat[:, 3:]
    return readings.reshape(*touches.shape[:2], -1).sum(1)


def measure(readings, noise, seed):
    rng = np.random.default_rng(seed)
    scaled = readings * (1 + noise.gain * rng.standard_normal(readings.shape))
    return scaled + np.sqrt(noise.floor) * rng.standard_normal(readings.shape)


def moments(contact):
    mean = [*contact.position, contact.radius, contact.force]
    spread = [*contact.position_deviation, contact.radius_deviation, contact.force_deviation]
    return np.array(mean), np.array(spread)


def brute_force(readings, thin, noise, contact, count, seed=0):
    """Return mean and deviation (4,) by importance samples near the posterior, and their effective number.

    The last result is by how much the deviations of both halves of the samples differ, relative.
    """
    prior, rng = FingertipPrior(), np.random.default_rng(seed)
    mean, spread = moments(contact)
    centre = np.array([*mean[:2], np.log(mean[3])])
    wide = 1.6 * np.maximum([*spread[:2], spread[3] / mean[3]], [1e-4, 1e-4, 1e-3])
    # A third of the samples are from the prior, which has all modes.
    points, radius = centre + wide * rng.standard_normal((count, 3)), rng.uniform(*prior.radii, count)
    third = count // 3
    points[:third, :2] = rng.uniform(0, 0.16, (third, 2))
    points[:third, 2] = np.log(prior.force) + prior.spread * rng.standard_normal(third)
    near = np.exp(-0.5 * (((points - centre) / wide) ** 2).sum(1)) / wide.prod() / (2 * np.pi) ** 1.5
    density = -0.5 * ((points[:, 2] - np.log(prior.force)) / prior.spread) ** 2
    far = np.exp(density) / (prior.spread * np.sqrt(2 * np.pi) * 0.16**2)
    force = np.exp(points[:, 2])
    inside = ((points[:, :2] > 0) & (points[:, :2] < 0.16)).all(1)
    proposal = np.log(2 / 3 * near + np.where(inside, far / 3, 0))
    discs = np.column_stack([points[:, :2].clip(0, 0.16), radius])
    true = disc_readings(solid(thin), THIN if thin else DEEP, discs, prior.rim) * force[:, None]
    variance = noise.floor + (noise.gain * true) ** 2
    clips = readings >= noise.clip
    terms = -0.5 * ((readings - true) ** 2 / variance + np.log(variance))
    terms = np.where(clips, log_ndtr((true - noise.clip) / np.sqrt(variance)), terms)
    logs = np.where(inside, terms.sum(1) + density - proposal, -np.inf)
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    values = np.column_stack([discs, force])
    average, spread = _moments(weight, values)
    halves = [_moments(weight[part], values[part])[1] for part in (slice(0, None, 2), slice(1, None, 2))]
    differ = np.abs(halves[0] / halves[1] - 1).max()
    return average, spread, 1 / (weight**2).sum(), differ


def _moments(weight, values):
    average = weight @ values / weight.sum()
    return average, np.sqrt(weight @ (values - average) ** 2 / weight.sum())


def test_a_region_holds_what_it_says():
    """Boxes are up to 1.8 deviations long; what was uniform over each held 88 % in place of 90."""
    prior, touches, fractions = FingertipPrior(), draw(16, 4, margin=0.03), []
    for readings in measure(true_readings(touches), NOISE, 3):
        estimate = posterior(contacts=1).estimate(readings)
        (contact,) = estimate.contacts
        spread = 6 * contact.position_deviation
        x, y = np.linspace(contact.position - spread, contact.position + spread, 41).T
        radii = np.linspace(*prior.radii, 5)
        grid = np.stack(np.meshgrid(x, y, radii, indexing="ij"), -1).reshape(-1, 3)
        grid[:, :2] = grid[:, :2].clip(0, 0.16)
        table = posterior(contacts=1).candidates.at(grid)[:, 0, 0].astype(float)
        score = np.linspace(-4, 4, 61)
        force = prior.force * np.exp(prior.spread * score)
        fit = np.outer(table @ readings, force) - np.outer((table**2).sum(1), force**2) / 2
        mass = np.exp(fit / NOISE.floor - score**2 / 2 - (fit / NOISE.floor - score**2 / 2).max()).sum(1)
        region = contact.region()
        within = np.abs(grid[:, None, :2] - region.cells) <= region.width / 2
        fractions.append(mass[within.all(2).any(1)].sum() / mass.sum())
    assert np.mean(fractions) == pytest.approx(0.9, abs=0.012)


@pytest.mark.slow("integrates over all contacts by brute force")
@pytest.mark.parametrize(
    ("thin", "noise"),
    [(False, NOISE), (True, NOISE), (False, Noise(0.05, 10, gain=0.02)), (True, Noise(0.05, clip=1.0))],
)
def test_a_contact_agrees_with_brute_force(thin, noise):
    touches = draw(60, seed=3, margin=0.02)
    true = true_readings(touches, thin)
    estimated, compared = posterior(thin, noise, SINGLE), False
    for row in np.flatnonzero((true > 0.15).any(1))[:16]:
        readings = measure(true[row], noise, row)
        (contact,) = estimated.estimate(readings).contacts
        mean, spread, effective, differ = brute_force(readings, thin, noise, contact, 400_000, row)
        # A rare second mode with few samples says nothing of its weight.
        if effective < 5000 or differ > 0.03:
            continue
        assert (np.abs(moments(contact)[0] - mean) <= 0.1 * spread).all()
        assert moments(contact)[1] == pytest.approx(spread, rel=0.05)
        compared = True
        break
    assert compared


@pytest.mark.parametrize(("thin", "noise"), [(False, NOISE), (True, Noise(0.05, 10, gain=0.05, offset=0.02))])
def test_truth_drawn_from_the_prior_has_uniform_ranks(thin, noise):
    touches = draw(150, seed=8)
    readings = measure(true_readings(touches, thin), noise, seed=9)
    contacts = [estimate.contacts[0] for estimate in posterior(thin, noise, SINGLE).estimate(readings)]
    ranks = [position_ranks(contact, touch[0]) for contact, touch in zip(contacts, touches, strict=True)]
    for column in np.array(ranks).T:
        assert kstest(column, "uniform").pvalue > 0.01
    held = np.mean([c.region().contains(t[0, :2]) for c, t in zip(contacts, touches, strict=True)])
    assert 0.83 <= held <= 0.96  # 90 % of 150, within 3 standard deviations


def position_ranks(contact: ContactEstimate, touch):
    """Return the probability below the truth along x and y."""
    low = contact.positions - contact.widths / 2
    fraction = ((touch[:2] - low) / contact.widths).clip(0, 1)
    return contact.weights.sum(1) @ fraction


def same(first: FrameEstimate, second: FrameEstimate) -> bool:
    pairs = zip(first.contacts, second.contacts, strict=True)
    alike = (first.number, *first.probabilities) == (second.number, *second.probabilities)
    return alike and all(np.array_equal(moments(a), moments(b)) for a, b in pairs)


def test_a_contact_is_told_as_one_and_where_it_is():
    touches = draw(60, seed=1, margin=0.03)
    true = true_readings(touches)
    rows = (true > 0.15).any(1)
    estimates = posterior().estimate(measure(true, NOISE, 2)[rows])
    assert np.mean([estimate.number == 1 for estimate in estimates]) >= 0.97
    assert np.mean([estimate.fingertip for estimate in estimates]) >= 0.95
    error = [e.contacts[0].position - t[0, :2] for e, t in zip(estimates, touches[rows], strict=True)]
    assert np.sqrt(np.square(error).mean()) < 2.5e-3
    force = [e.contacts[0].force / t[0, 3] - 1 for e, t in zip(estimates, touches[rows], strict=True)]
    assert np.median(np.abs(force)) < 0.08


def test_two_contacts_are_told_apart():
    touches = draw(20, seed=4, number=2, margin=0.03, apart=0.064)
    estimates = posterior().estimate(measure(true_readings(touches), NOISE, 5))
    right = [row for row, estimate in enumerate(estimates) if estimate.number == 2]
    assert len(right) >= 19
    errors = []
    for row in right:
        contacts = estimates[row].contacts
        positions = np.array([contact.position for contact in contacts])
        errors.append(np.linalg.norm(touches[row][:, None, :2] - positions, axis=2).min(1))
        # Two places that exchange their order would be averaged, half of their distance from either.
        assert max(contact.position_deviation.max() for contact in contacts) < 0.015
    assert np.sqrt(np.square(errors).mean() / 2) < 3e-3


def test_contacts_that_no_sensor_feels_are_as_likely_as_brute_force_says():
    body = Sheet((0.15, 0.15), (24, 24), THIN.layers)
    simulator, noise = Naive(body, Grid(3, 4).sensors(body)), Noise(0.05, frames=10, gain=0.1)
    prior = FingertipPrior(large=0.0)
    rng, count = np.random.default_rng(0), 20_000
    discs = np.column_stack([*rng.uniform(0, 0.15, (2, 3 * count)), rng.uniform(*prior.radii, 3 * count)])
    force = prior.force * np.exp(prior.spread * rng.standard_normal(3 * count))
    readings = [disc_readings(simulator, body, some, prior.rim) for some in np.array_split(discs, 30)]
    alone = (np.concatenate(readings) * force[:, None]).reshape(3, count, 12)
    subject = Posterior(simulator, noise, body, prior)
    for _ in range(4):
        seen = rng.normal(scale=np.sqrt(noise.floor), size=12)
        ratios = [1.0]
        for touched in np.cumsum(alone, axis=0):
            variance = noise.floor + (noise.gain * touched) ** 2
            misfit = (seen - touched) ** 2 / variance + np.log(variance / noise.floor)
            ratios.append(np.exp(0.5 * (seen**2 / noise.floor - misfit).sum(1)).mean())
        expected = np.array(ratios) * prior.numbers
        assert subject.estimate(seen).probabilities == pytest.approx(expected / expected.sum(), abs=0.03)


@pytest.mark.parametrize("thin", [False, True])
def test_a_bar_is_no_fingertip(thin):
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0.04, 0.12, 21), np.linspace(0.06, 0.084, 7)))
    chain = np.stack([x, y, np.full(x.size, 0.004), np.full(x.size, 0.6)], axis=1)
    estimate = posterior(thin).estimate(measure(true_readings(chain[None], thin), NOISE, 22)[0])
    assert not estimate.fingertip
    assert estimate.large > 0.9


def test_frames_alone_and_together_give_the_same_bits():
    touches = np.concatenate([draw(3, 11, 2, 0.03, 0.05), np.repeat(draw(3, 12, margin=0.03), 2, 1)])
    readings = measure(true_readings(touches), NOISE, 13)
    together = posterior().estimate(readings)
    assert all(map(same, map(posterior().estimate, readings), together))


def test_the_order_of_sensors_does_not_matter():
    order = np.random.default_rng(0).permutation(9)
    sensors = sensors_of(SMALL, 0.0295, 3)
    shuffled = type(sensors)(sensors.positions[order], sensors.footprint, sensors.normals[order])
    skin, other = (Solid(SMALL, where, divisions=1) for where in (sensors, shuffled))
    discs = np.array([(0.03, 0.05, 0.008), (0.05, 0.03, 0.006), (0.045, 0.045, 0.01)])
    readings = measure(5 * disc_readings(skin, SMALL, discs, FingertipPrior().rim), NOISE, 15)
    ordered, mixed = (Posterior(one, NOISE, SMALL, contacts=2) for one in (skin, other))
    for row in readings:
        first, second = ordered.estimate(row), mixed.estimate(row[order])
        assert first.number == second.number
        for a, b in zip(first.contacts, second.contacts, strict=True):
            np.testing.assert_allclose(moments(a)[0], moments(b)[0], rtol=1e-3)
            np.testing.assert_allclose(moments(a)[1], moments(b)[1], rtol=1e-2)


def test_an_invalid_sensor_counts_for_nothing():
    readings = measure(true_readings(draw(1, 16, margin=0.05)), NOISE, 17)[0]
    valid = np.arange(25) != readings.argmax()
    worse = np.where(valid, readings, 99.0)
    clean, spoilt = posterior().estimate(readings, valid), posterior().estimate(worse, valid)
    assert same(clean, spoilt)
    assert same(clean, posterior().estimate(np.where(valid, readings, np.nan)))
    whole = posterior().estimate(readings)
    assert clean.contacts[0].position_deviation.max() > whole.contacts[0].position_deviation.max()


@pytest.mark.parametrize("make", [partial(Noise, 0.05, offset=np.nan), partial(FingertipPrior, large=np.nan)])
def test_a_number_without_meaning_is_refused(make):
    with pytest.raises(InputError, match="of 0 or more"):
        make()


def test_a_sensor_that_clips_says_at_least_so_much():
    touch = np.array([[[0.08, 0.08, 0.008, 40.0]]])
    true = true_readings(touch, thin=True)[0]
    noise = Noise(0.05, 10, clip=float(true.max() / 2))
    prior = FingertipPrior(force=20.0)
    readings = np.minimum(measure(true, noise, 18), noise.clip)
    (contact,) = posterior(True, noise, prior).estimate(readings).contacts
    beyond = np.where(readings < noise.clip, readings, np.inf)
    assert posterior(True, noise, prior).estimate(beyond).contacts[0].force == contact.force
    blind = posterior(True, noise, prior).estimate(readings, readings < noise.clip).contacts
    assert np.linalg.norm(contact.position - touch[0, 0, :2]) < 0.006
    assert contact.force > 20
    assert not blind or blind[0].position_deviation.max() > contact.position_deviation.max()


def test_touches_that_clip_a_sensor_are_held_as_often_as_said():
    """The most probable force ignored them: regions held 72 %, and intervals of the pressure 79."""
    noise, prior, touches = Noise(0.05, 10, clip=6.0), replace(SINGLE, force=10.0), draw(8000, seed=7)
    touches[..., 3] *= 2
    true = true_readings(touches, thin=True)
    rows = np.flatnonzero((true > noise.clip).any(1))
    estimates = posterior(True, noise, prior).estimate(np.minimum(measure(true[rows], noise, 9), noise.clip))
    pairs = [(each.contacts[0], touch[0]) for each, touch in zip(estimates, touches[rows], strict=True)]
    assert 0.83 <= np.mean([contact.region().contains(touch[:2]) for contact, touch in pairs]) <= 1
    peaks = [(contact.peak_interval, prior.peak(touch[2]) * touch[3]) for contact, touch in pairs]
    assert 0.83 <= np.mean([low < peak < high for (low, high), peak in peaks]) <= 1


def test_a_force_far_above_the_prior_is_held_or_said_to_be_beyond_the_range():
    touches = draw(9, seed=2, margin=0.03)
    touches[..., 3] = 150.0
    noise, true = Noise(0.05, 10, clip=1.0), true_readings(touches, thin=True)
    for row in np.flatnonzero((true > noise.clip).any(1)):
        clipped = posterior(True, noise).estimate(np.minimum(measure(true[row], noise, 3), noise.clip))
        for estimate in (clipped, posterior(True, prior=SINGLE).estimate(measure(true[row], NOISE, 3))):
            held = any(each.region().contains(touches[row, 0, :2]) for each in estimate.contacts)
            assert held or "beyond the range of " in estimate.unknown
    assert "beyond the range of the prior" in posterior(True, prior=SINGLE).estimate(true[0]).unknown
    assert posterior(True, noise).estimate(np.minimum(true[0] / 300, 0.9)).unknown is None


def test_frames_of_a_touch_tell_more_together():
    touches = draw(1, 19, margin=0.05)
    frames = np.concatenate([measure(true_readings(touches), Noise(0.05), seed) for seed in range(10)])
    alone = posterior(noise=Noise(0.05)).estimate(frames[0])
    together = posterior(noise=Noise(0.05)).estimate_touch(frames)
    assert together.contacts[0].region().area < 0.5 * alone.contacts[0].region().area
    mean = posterior().estimate(frames.mean(0))
    np.testing.assert_allclose(together.contacts[0].position, mean.contacts[0].position, rtol=1e-9)
    peaked = true_readings(touches) * np.r_[np.full(9, 0.2), 1.0][:, None]  # clips in its last frame alone
    clip = 0.7 * peaked.max()
    clipped = posterior(noise=Noise(0.02, clip=clip)).estimate_touch(np.minimum(peaked, clip)).contacts[0]
    assert abs(clipped.force - 0.28 * touches[0, 0, 3]) < 2.5 * clipped.force_deviation


def test_two_sensors_say_what_cannot_be_known():
    sensors = sensors_of(SMALL, 0.0295, 3)
    two = type(sensors)(sensors.positions[[3, 5]], sensors.footprint)
    subject = Posterior(Solid(SMALL, two, divisions=1), NOISE, SMALL)
    estimate = subject.estimate(np.array([0.3, 0.0]))
    assert "cannot be separated" in estimate.unknown
    assert estimate.number >= 1
    assert estimate.contacts[0].region().area > 5e-4
    nothing = subject.estimate(np.array([np.nan, np.nan]))
    assert "nothing is known" in nothing.unknown


def test_a_limit_of_pressure_has_a_probability():
    touch = np.array([[[0.08, 0.08, 0.008, 10.0]]])
    estimate = posterior().estimate(measure(true_readings(touch), NOISE, 21)[0])
    limits = [estimate.exceeds(limit) for limit in (1e3, 50e3, 1e6)]
    assert limits[0] == pytest.approx(1)
    assert limits[2] < 0.01
    assert limits == sorted(limits, reverse=True)
    # Where no touch is most probable, there may be one.
    nothing = posterior(True, Noise(1.0), FingertipPrior(force=10.0)).estimate(np.zeros(25))
    assert (nothing.number, nothing.contacts) == (0, ())
    assert nothing.given[1][0].exceeds(90e3) > nothing.exceeds(90e3) > 0.1


def test_the_pressure_of_a_disc_that_the_edge_cuts_is_that_of_its_rest():
    touches = draw(12, 23, margin=0.02)
    touches[:, 0, 0] = np.linspace(0, 0.012, 12)
    x, y = np.meshgrid(*2 * [np.arange(1e-4, 0.03, 2e-4)])
    readings, ratios = measure(true_readings(touches), precise := Noise(0.001), 5), []
    for (contact,), reading in zip(touches, readings, strict=True):
        pressure = expit((contact[2] - np.hypot(x - contact[0], y - 0.015)) / FingertipPrior().rim)
        true = contact[3] * pressure.max() / pressure.sum() / 2e-4**2
        (found,) = posterior(noise=precise, prior=SINGLE, contacts=1).estimate(reading).contacts
        ratios.append([found.peak / true, *np.array(found.peak_interval) / true])
    peak, low, high = np.transpose(ratios)
    assert np.median(peak) == pytest.approx(1, abs=0.1)
    assert ((low < 1) & (high > 1)).sum() >= 9


def test_a_number_that_is_improbable_is_passed_over():
    rng, prior = np.random.default_rng(2), FingertipPrior(numbers=(0.6, 0.3, 0.01, 0.09))
    middle, angle = rng.uniform(0.03, 0.13, (12, 2)), rng.uniform(0, 6.28, 12)
    away = 0.004 * np.column_stack([np.cos(angle), np.sin(angle)])
    pairs = np.stack([middle + away, middle - away], 1)  # nearer to each other than sensors
    touches = np.concatenate([pairs, np.broadcast_to([0.008, 4.0], pairs.shape)], 2)
    estimates = posterior(prior=prior).estimate(measure(true_readings(touches), NOISE, 6))
    assert [len(each.contacts) for each in estimates] == [each.number for each in estimates]


def test_every_simulator_that_adds_up_and_an_arm_work():
    sheet, touch = Sheet((0.08, 0.08), (16, 16), THIN.layers), np.array([[0.035, 0.043, 0.008]])
    sensors = sensors_of(sheet, None, 3)
    firm = FIRM | {"material": {"name": "Dragon Skin 10 Medium", "poisson": 0.49}}
    layers = [firm, SOFT | {"thickness": 0.005}]
    arm = Arm(radius=0.05, length=0.08, angle=1.6, cells=(8, 8), layers=layers)
    skins = [
        (PlatesAndBeams(sheet, sensors, reading="interface"), sheet, 3),
        (PlatesAndBeams(sheet, sensors), sheet, 1),
        (Naive(sheet, sensors), sheet, 3),
        (Solid(arm, sensors_of(arm, None, 3)), arm, 3),
    ]
    for simulator, body, maximum in skins:
        readings = 8 * disc_readings(simulator, body, touch, 0.0015)[0]
        estimate = Posterior(simulator, NOISE, body, FingertipPrior(large=0.0), maximum).estimate(readings)
        assert estimate.number == 1
        assert np.linalg.norm(estimate.contacts[0].position - touch[0, :2]) < 0.012


def test_errors_are_one_sentence():
    body, sensors = SMALL, sensors_of(SMALL, None, 3)
    with pytest.raises(skin.InputError, match="a standard deviation above 0 N"):
        Noise(0.0)
    with pytest.raises(skin.InputError, match=r"the described one and includes it.*thickness=\[1.1,1.3\]"):
        Noise(0.05, thickness=(1.1, 1.3))
    with pytest.raises(skin.InputError, match="needs the mechanics of a skin"):
        Posterior(None, NOISE, body)
    with pytest.raises(skin.InputError, match="1 to 3 contacts"):
        Posterior(solid(), NOISE, DEEP, contacts=4)
    with pytest.raises(skin.InputError, match="do not add up"):
        Posterior(PlatesAndBeams(body, sensors), NOISE, body)
    with pytest.raises(skin.InputError, match="this skin has 25 sensors"):
        posterior().estimate(np.zeros(24))


@pytest.fixture(scope="module")
def three_axes():
    """Return a skin of 3 x 3 sites, its posterior, and readings of touches with friction (120, 27)."""
    sensors = Grid(3, 3, (0.01, 0.01), depth=0.0295, axes="three").sensors(SMALL)
    simulator, prior = Solid(SMALL, sensors, divisions=4), replace(SINGLE, friction=0.8)
    rng = np.random.default_rng(8)
    touches = np.column_stack([draw(120, 8)[:, 0, :2] / 2, draw(120, 8)[:, 0, 2:]])
    score = rng.standard_normal((120, 2))
    rows = disc_readings(simulator, SMALL, touches[:, :3], prior.rim, 0.8 / np.sqrt(6)).reshape(120, 3, 27)
    true = touches[:, 3:] * (rows[:, 0] + np.einsum("nl,nls->ns", score, rows[:, 1:]))
    force = np.column_stack([touches[:, 3:] * score * 0.8 / np.sqrt(6), touches[:, 3]])
    return Posterior(simulator, NOISE, SMALL, prior), touches, force, measure(true, NOISE, 9)


def test_three_axes_tell_the_vector_of_the_force(three_axes):
    """Errors in deviations have a mean square of 1, regions hold 90 % of the positions."""
    posterior, touches, force, readings = three_axes
    contacts = [estimate.contacts[0] for estimate in posterior.estimate(readings)]
    means = np.array([[*each.position, *each.tangential, each.force] for each in contacts])
    deviations = [[*c.position_deviation, *c.tangential_deviation, c.force_deviation] for c in contacts]
    errors = (means - np.column_stack([touches[:, :2], force])) / np.array(deviations)
    assert np.sqrt((errors**2).mean(0)) == pytest.approx(np.ones(5), abs=0.2)
    inside = np.mean([c.region().contains(touch[:2]) for c, touch in zip(contacts, touches, strict=True)])
    assert inside == pytest.approx(0.9, abs=0.08)
    assert np.median(np.abs(means[:, 2:4] - force[:, :2])) < 0.5 * np.median(np.abs(force[:, :2]))
    limited = np.arange(27) == 4  # along the surface: at which of its limits is unknown
    assert same(posterior.estimate(readings[0], None, limited), posterior.estimate(readings[0], ~limited))


def test_precise_readings_of_three_axes_have_finite_regions(three_axes):
    posterior, touches, force, _ = three_axes
    rows, noise = posterior.candidates.at(touches[:, :3])[:, 0], Noise(0.002, 10, gain=0.02, position=0.001)
    tangent = force[:, :2] / posterior.candidates.friction
    true = force[:, 2:] * rows[:, 0] + np.einsum("nl,nls->ns", tangent, rows[:, 1:])
    posterior = copy(posterior)
    posterior.assume(posterior.candidates, noise)
    contacts = [each.contacts[0] for each in posterior.estimate(measure(true, noise, 9)[:60])]
    inside = [c.region().contains(touch[:2]) for c, touch in zip(contacts, touches, strict=False)]
    assert np.mean(inside) > 0.8


def test_friction_needs_a_simulator_that_has_it(three_axes):
    body, sensors = SMALL, sensors_of(SMALL, None, 3)
    with pytest.raises(skin.InputError, match=r"friction of 0 or more.* friction=-1"):
        FingertipPrior(friction=-1)
    with pytest.raises(skin.InputError, match="friction needs a simulator with tangential forces"):
        Posterior(Naive(body, sensors), NOISE, body, FingertipPrior(friction=0.8))
    estimate = Posterior(Naive(body, sensors), NOISE, body, SINGLE).estimate(np.ones(9))
    assert estimate.contacts[0].tangential is None
