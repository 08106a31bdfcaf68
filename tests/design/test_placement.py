"""Sites lie outside of keep-out zones; the chosen ones are compared with exhaustive search."""

from itertools import combinations

import numpy as np
import pytest
from PIL import Image

from skin.body.base import Sheet
from skin.design.placement import candidate_sites, exchange, greedy, keep_out, mutual_information, too_near
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


LAYERS = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
SIZE = (0.12, 0.06)
SHEET = Sheet(SIZE, [24, 12], LAYERS)
FOOTPRINT = (0.01, 0.01)


def positions(**settings):
    return candidate_sites(SHEET, FOOTPRINT, 0.0, **settings).positions[:, :2]


def test_sites_are_cells_with_room_for_a_footprint():
    found = positions()
    x, y = (np.unique(found[:, axis].round(6)) for axis in (0, 1))
    assert x == pytest.approx(np.arange(0.0075, 0.115, 0.005))
    assert y == pytest.approx(np.arange(0.0075, 0.055, 0.005))
    assert len(found) == len(x) * len(y)
    assert found[:2] == pytest.approx(np.array([[0.0075, 0.0075], [0.0125, 0.0075]]))


@pytest.mark.parametrize(
    ("raster", "counts"), [(0.02, (6, 3)), ((0.03, 0.02), (4, 3)), ([0.05, 0.05], (2, 1))]
)
def test_a_raster_is_centred(raster, counts):
    found = positions(raster=raster)
    pitches = raster if isinstance(raster, tuple | list) else (raster, raster)
    for axis in (0, 1):
        lines = np.unique(found[:, axis].round(6))
        assert len(lines) == counts[axis]
        assert np.diff(lines) == pytest.approx(pitches[axis], abs=2e-6)
        assert lines.mean() == pytest.approx(SIZE[axis] / 2, abs=1e-6)


def test_no_footprint_lies_in_a_polygon():
    triangle = [(0.0, 0.0), (0.04, 0.0), (0.0, 0.04)]
    box = [(0.1, 0.03), (0.12, 0.03), (0.12, 0.06), (0.1, 0.06)]
    found = positions(forbidden=keep_out([triangle, box], SIZE))
    upper_left = found - 0.005
    # The corner of the footprint that is nearest to a zone, with 0.5 mm for the pixels of its outline.
    assert (upper_left.sum(axis=1) > 0.04 - 0.002).all()
    lower_right = found + 0.005
    assert not (lower_right > np.array([0.1005, 0.0305])).all(axis=1).any()
    rest = positions()
    free = ((rest - 0.005).sum(axis=1) > 0.04) & ~(rest + 0.005 > np.array([0.1, 0.03]) + 1e-9).all(axis=1)
    assert {tuple(one) for one in rest[free].round(6)} <= {tuple(one) for one in found.round(6)}


def test_dark_pixels_of_a_picture_forbid_sites(tmp_path):
    pixels = np.full((60, 120), 255, dtype=np.uint8)
    pixels[:, :60] = 20
    Image.fromarray(pixels).save(tmp_path / "left.png")
    found = positions(forbidden=keep_out(str(tmp_path / "left.png"), SIZE))
    assert len(found) == 10 * 10
    assert found[:, 0].min() == pytest.approx(0.0675)


def test_transparent_pixels_forbid_nothing(tmp_path):
    Image.new("RGBA", (120, 60), (0, 0, 0, 0)).save(tmp_path / "clear.png")
    assert not keep_out(str(tmp_path / "clear.png"), SIZE).any()


def test_a_picture_of_another_aspect_is_refused(tmp_path):
    Image.new("L", (60, 60), 255).save(tmp_path / "square.png")
    match = r"60 x 60 pixels, but the surface has 0\.12 x 0\.06 m: give a picture"
    with pytest.raises(InputError, match=match):
        keep_out(str(tmp_path / "square.png"), SIZE)
    Image.new("L", (61, 30), 255).save(tmp_path / "near.png")
    assert keep_out(str(tmp_path / "near.png"), SIZE).shape == (30, 61)


@pytest.mark.parametrize(("content", "reason"), [(None, "no picture"), (b"no picture", "cannot read")])
def test_what_is_no_picture_is_refused(tmp_path, content, reason):
    path = tmp_path / "x.png"
    if content:
        path.write_bytes(content)
    with pytest.raises(InputError, match=reason):
        keep_out(str(path), SIZE)


def test_a_polygon_needs_three_corners():
    with pytest.raises(InputError, match=r"polygon 2 of design\.keep_out has 2 corners"):
        keep_out([[(0, 0), (0.1, 0), (0, 0.1)], [(0, 0), (0.1, 0.1)]], SIZE)


def test_no_site_left_is_refused():
    everything = [[(-0.01, -0.01), (0.13, -0.01), (0.13, 0.07), (-0.01, 0.07)]]
    with pytest.raises(InputError, match="no site is left"):
        positions(forbidden=keep_out(everything, SIZE))
    with pytest.raises(InputError, match="no site is left"):
        positions(raster=0.2)
