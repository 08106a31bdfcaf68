"""Movies: those of the published numbers, labels typed out by hand, and two gestures at the same time."""

import hashlib

import numpy as np
import pytest
import torch

from skin.body.layout import Grid, Scattered
from skin.body.sheet import Sheet
from skin.core.rng import Stream, generator
from skin.device.touches import draw_timeline
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.gestures import GestureSettings, TouchSampler
from skin.touch.movie import add_second
from tests.touch.movie_labels import movie_labels

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
SENSORS = Grid(5, 5).sensors(BODY)


def content(movie):
    """Return a hash of movies, of whole numbers and of places to a micrometre: alike on every processor."""
    known = movie.parameters
    positions = torch.stack([known[name] for name in ("x", "y", "net_x", "net_y")]).double().numpy()
    whole = (movie.labels, movie.index, known["shape"], known["duration"], known["onset"], known["frames"])
    values = [values.numpy() for values in whole] + [np.round(1e6 * positions)]
    return hashlib.sha256(b"".join(one.astype(np.int64).tobytes() for one in values)).hexdigest()[:16]


@pytest.mark.parametrize(("padded", "expected"), [(True, "1dae3ead7e41041b"), (False, "1a29a25f89bf9452")])
def test_400_gestures_are_those_of_the_published_numbers(padded, expected):
    sampler = TouchSampler(BODY, BODY.footprints(SENSORS), Prescribed(), GestureSettings(), padded)
    movie = sampler.sample(400, generator(Stream.BUDGET, 0, 1))
    assert movie.index.shape == (400, 30)
    assert content(movie) == expected


def test_a_stream_is_that_of_the_published_numbers():
    sampler = TouchSampler(BODY, BODY.footprints(SENSORS), Prescribed(), GestureSettings())
    timeline = draw_timeline(sampler, 2000, (10, 60), generator(Stream.BUDGET, 0, 2))
    assert len(timeline.begin) > 30
    assert content(timeline.movie) == "0949cc88db13cbcf"
    assert timeline.begin[:6].tolist() == [49, 118, 158, 192, 239, 267]


CELL = (0.01, 0.02)
# Two sensors on a sheet of 10 x 10 cells: one over a whole cell, one over four quarters.
FOOTPRINTS = torch.zeros(2, 10, 10)
FOOTPRINTS[0, 2, 3] = 1
FOOTPRINTS[1, 6:8, 6:8] = 0.25


def labels(movie: torch.Tensor) -> list[bool]:
    return movie_labels(movie[None], FOOTPRINTS.flatten(1), CELL)[0].bool().tolist()


def movie(frames: range, rows=slice(0, 3), columns=slice(0, 10), pressure=1e3, slide=0) -> torch.Tensor:
    result = torch.zeros(12, 10, 10)
    for step, frame in enumerate(frames):
        start, stop, _ = columns.indices(10)
        result[frame, rows, start + step * slide : stop + step * slide] = pressure
    return result


def test_area_counts_cells_above_two_percent_of_the_gestures_peak():
    faint = movie(range(2))
    faint[0, 5, 5] = 0.019e3
    assert not labels(faint)[0]
    faint[0, 5, 5] = 0.021e3
    assert labels(faint)[0]
    faint[1, 0, 0] = 2e3  # now 0.021e3 is below 2 % of the peak, in another frame
    assert not labels(faint)[0]


def test_dangerous_is_a_mean_over_a_footprint():
    point = torch.zeros(12, 10, 10)
    point[4, 5, 5] = 1e6  # between the sensors
    assert not labels(point)[3]
    point[4, 2, 3] = 90.4e3
    assert not labels(point)[3]
    point[4, 2, 3] = 90.6e3
    assert labels(point)[3]
    corner = torch.zeros(12, 10, 10)
    corner[4, 6, 6] = 4 * 90.4e3
    assert not labels(corner)[3]
    corner[4, 6, 6] = 4 * 90.6e3
    assert labels(corner)[3]


COARSE = Sheet([0.16, 0.16], [16, 16], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
WEIGHTS = COARSE.footprints(Scattered(4, 4, seed=0).sensors(COARSE))


def sample(count=240, **settings):
    sampler = TouchSampler(COARSE, WEIGHTS, Prescribed(), GestureSettings.of(settings))
    return sampler.sample(count, np.random.default_rng(3))


@pytest.fixture(scope="module")
def single():
    return sample()


@pytest.fixture(scope="module")
def paired(single):
    return add_second(single, 0.5, 0.02, np.random.default_rng(4))


def test_a_pair_is_the_sum_of_two_gestures_side_by_side(single, paired):
    rows = torch.nonzero(paired.parameters["contacts"] == 2)[:, 0]
    first, both = single.pressure()[rows].double(), paired.pressure()[rows].double()
    second = both - first
    assert (second > -1).all()  # Pa, of 1e5
    pressed = [(part > 0.02 * part.amax()).any(dim=1) for part in (first, second)]
    assert not (pressed[0] & pressed[1]).any()
    touched = [part.amax(dim=(2, 3)) > 100 for part in (first, second)]
    assert (touched[0] & touched[1]).any(dim=1).all()  # at the same time
    union = (touched[0] | touched[1]).int()
    onset, duration = (paired.parameters[name][rows].long() for name in ("onset", "duration"))
    assert torch.equal(union.argmax(dim=1), onset)
    assert torch.equal(union.sum(dim=1), duration)
    total = both.sum(dim=(2, 3)) * COARSE.cell[0] * COARSE.cell[1]
    torch.testing.assert_close(paired.force[rows].double(), total, rtol=1e-4, atol=1e-3)


def test_a_label_holds_if_it_holds_for_one_of_the_two(single, paired):
    """Big and dangerous are measured again; dynamic and press are those of the longer or the moving one."""
    assert torch.equal(paired.labels, single.labels)
    rows = paired.parameters["contacts"] == 2
    sensors = paired.pressure().flatten(2) @ torch.as_tensor(WEIGHTS.T).float()
    assert torch.equal(sensors.amax(dim=(1, 2)) > 90.5e3, single.labels[:, 3] == 1)
    for name, column, limit in (("area", 0, 0.3), ("frames", 2, 3), ("pressure", 3, 90.5e3)):
        assert torch.equal(paired.parameters[name][rows] > limit, single.labels[rows, column] == 1)


def test_what_does_not_add_up_is_refused():
    with pytest.raises(InputError, match=r"touch\.shear=0"):
        sample(second=0.5, shear=0.3)

    class Rigid(Prescribed):
        proportional = False

    with pytest.raises(InputError, match="contact=prescribed"):
        GestureSettings(second=0.5).sampler(COARSE, WEIGHTS, Rigid(), True, None)
    with pytest.raises(InputError, match="limit of force together"):
        sample(second=0.5, limits={"force": {"limit": 65, "unit": "N", "source": "a table"}})
