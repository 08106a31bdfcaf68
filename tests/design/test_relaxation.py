"""The bound is above the optimum that exhaustive search finds, and close to it."""

from itertools import combinations

import numpy as np
import pytest

from skin.design.placement import given, mutual_information, upper_bound

SEEDS = range(6)
SITES = 12


def covariance(seed, width=0.03):
    """Return a smooth covariance (C, C) in units of the noise."""
    draw = np.random.default_rng(seed)
    places, size = draw.uniform(0, 0.1, (SITES, 2)), draw.uniform(1, 5, SITES)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return 20 * np.outer(size, size) * np.exp(-((apart / width) ** 2))


def optimum(signal, count, fixed=()):
    """Return the largest information of all choices."""
    rest = [site for site in range(SITES) if site not in fixed]
    return max(mutual_information(signal, [*fixed, *some]) for some in combinations(rest, count - len(fixed)))


@pytest.mark.parametrize("width", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("count", [1, 4, 11])
@pytest.mark.parametrize("seed", SEEDS)
def test_bound_is_above_the_optimum_and_close(seed, count, width):
    signal = covariance(seed, width)
    best, bound = optimum(signal, count), upper_bound(signal, count)
    assert best <= bound + 1e-9
    assert bound <= 1.03 * best


@pytest.mark.parametrize("seed", SEEDS)
def test_bound_holds_with_sensors_that_stay(seed):
    signal, fixed = covariance(seed), [3, 7]
    best, bound = optimum(signal, 5, fixed), upper_bound(signal, 5, fixed)
    assert best <= bound + 1e-9
    assert bound <= 1.03 * best


def test_bound_without_a_choice_is_the_information():
    signal = covariance(0)
    for count, fixed in [(2, [3, 7]), (SITES, [3, 7]), (SITES, [])]:
        sites = fixed if count == 2 else range(SITES)
        assert upper_bound(signal, count, fixed) == pytest.approx(mutual_information(signal, sites), rel=1e-9)


def test_bound_holds_wherever_the_search_stops():
    signal = covariance(0)
    best = optimum(signal, 8)
    bounds = [upper_bound(signal, 8, gap=gap) for gap in (1.0, 1e-2, 1e-4)]
    assert all(best <= bound + 1e-9 for bound in bounds)
    assert bounds[0] > bounds[1] >= bounds[2]


def test_bound_of_one_sensor_is_that_of_the_best_site():
    """A relaxation without a limit on the rank is far above it, because it spreads the sensor."""
    signal = covariance(0)
    best = optimum(signal, 1)
    assert upper_bound(signal, 1) <= 1.005 * best
    assert np.linalg.slogdet(np.eye(SITES) + signal / SITES)[1] / 2 > 3 * best


def test_order_of_sites_changes_nothing():
    signal, order = covariance(1), np.random.default_rng(0).permutation(SITES)
    shuffled = signal[np.ix_(order, order)]
    assert upper_bound(shuffled, 6) == pytest.approx(upper_bound(signal, 6), rel=1e-6)


def test_information_adds_up_over_what_is_given():
    signal = covariance(2)
    rest = np.delete(np.arange(SITES), [3, 7])
    both = mutual_information(signal, [3, 7, *rest[[1, 4]]])
    known = mutual_information(signal, [3, 7]) + mutual_information(given(signal, [3, 7]), [1, 4])
    assert both == pytest.approx(known, rel=1e-9)
