"""The chosen sites are compared with exhaustive search."""

from itertools import combinations

import numpy as np
import pytest

from skin.design.placement import exchange, greedy, mutual_information, too_near
from skin.errors import InputError

SEEDS = range(8)


def problem(seed, sites=12):
    """Return places (C, 2), m, and a smooth covariance over them in units of the noise."""
    draw = np.random.default_rng(seed)
    positions = draw.uniform(0, 0.1, (sites, 2))
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    size = draw.uniform(1, 5, sites)
    return positions, 20 * np.outer(size, size) * np.exp(-((apart / 0.03) ** 2))


def alone(sites):
    return np.eye(sites, dtype=bool)


def placed(signal, count, near, fixed=()):
    return exchange(signal, greedy(signal, count, near, fixed), near, len(fixed))


def optimum(signal, count, near, fixed=()):
    rest = [site for site in range(len(signal)) if site not in fixed]
    values = [-np.inf]
    for some in combinations(rest, count - len(fixed)):
        sites = [*fixed, *some]
        admissible = not any(near[one, two] for one, two in combinations(sites, 2))
        values += [mutual_information(signal, sites)] if admissible else []
    return max(values)


@pytest.mark.parametrize("seed", SEEDS)
def test_gain_is_the_difference_of_log_determinants(seed):
    _, signal = problem(seed)
    chosen = greedy(signal, 5, alone(12))
    for number in range(5):
        before = chosen[:number]
        values = {site: mutual_information(signal, [*before, site]) for site in set(range(12)) - set(before)}
        best = pytest.approx(max(values.values()), rel=1e-12)
        assert mutual_information(signal, chosen[: number + 1]) == best
    matrix = np.eye(5) + signal[np.ix_(chosen, chosen)]
    assert mutual_information(signal, chosen) == pytest.approx(0.5 * np.log(np.linalg.det(matrix)), rel=1e-9)


@pytest.mark.parametrize("distance", [0.0, 0.02])
@pytest.mark.parametrize("seed", SEEDS)
def test_reaches_the_optimum_of_exhaustive_search(seed, distance):
    positions, signal = problem(seed)
    near = too_near(positions, distance)
    chosen = placed(signal, 4, near)
    assert len(set(chosen)) == 4
    assert not any(near[one, two] for one, two in combinations(chosen, 2))
    assert mutual_information(signal, chosen) >= 0.97 * optimum(signal, 4, near)


@pytest.mark.parametrize("seed", SEEDS)
def test_exchanges_end_where_no_single_move_gains(seed):
    _, signal = problem(seed)
    chosen = exchange(signal, [0, 1, 2, 3], alone(12))
    best = mutual_information(signal, chosen)
    assert best >= mutual_information(signal, [0, 1, 2, 3])
    for number in range(4):
        others = chosen[:number] + chosen[number + 1 :]
        assert all(mutual_information(signal, [*others, site]) <= best + 1e-6 for site in range(12))


@pytest.mark.parametrize("seed", SEEDS)
def test_order_of_candidates_changes_nothing(seed):
    positions, signal = problem(seed, sites=30)
    near = too_near(positions, 0.015)
    order = np.random.default_rng(100 + seed).permutation(30)
    chosen = placed(signal, 6, near)
    again = placed(signal[np.ix_(order, order)], 6, near[np.ix_(order, order)])
    assert [order[site] for site in again] == chosen


def test_first_of_equal_sites_is_taken():
    assert greedy(np.diag([1.0, 2.0, 2.0, 2.0 * (1 - 1e-12)]), 2, alone(4)) == [1, 2]


def test_fixed_sites_stay_and_may_be_near_each_other():
    positions, signal = problem(1)
    near = too_near(positions, 0.02)
    near[3, 7] = near[7, 3] = True
    chosen = placed(signal, 4, near, [3, 7])
    assert chosen[:2] == [3, 7]
    assert not near[np.ix_(chosen[2:], [3, 7])].any()


def test_says_how_many_fit():
    positions = np.column_stack([np.linspace(0, 0.1, 11), np.zeros(11)])
    with pytest.raises(InputError, match=r"only 2 of 4 sensors fit.*design\.distance"):
        greedy(np.eye(11), 4, too_near(positions, 0.06))


def test_distance_that_is_just_reached_is_enough():
    positions = np.array([[0.0, 0.0], [3 * 0.004, 0.0], [0.0119, 0.0]])
    assert too_near(positions, 0.012)[0].tolist() == [True, False, True]
