"""Labels of movies typed out by hand."""

import torch

from skin.touch.movie import measure_gestures, sliding
from tests.touch.movie_labels import movie_labels

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


def test_big_is_more_than_three_tenths():
    exactly = movie(range(2))
    assert not labels(exactly)[0]
    exactly[1, 5, 5] = 1e3
    assert labels(exactly)[0]


def test_area_counts_cells_above_two_percent_of_the_gestures_peak():
    faint = movie(range(2))
    faint[0, 5, 5] = 0.019e3
    assert not labels(faint)[0]
    faint[0, 5, 5] = 0.021e3
    assert labels(faint)[0]
    faint[1, 0, 0] = 2e3  # now 0.021e3 is below 2 % of the peak, in another frame
    assert not labels(faint)[0]


def test_press_is_more_than_three_consecutive_frames():
    assert not labels(movie(range(3)))[2]
    assert labels(movie(range(5, 9)))[2]
    interrupted = movie(range(6))
    interrupted[3] = 0
    assert not labels(interrupted)[2]


def test_dynamic_is_a_centre_that_moves():
    small = {"rows": slice(2, 4), "columns": slice(0, 2)}
    assert not labels(movie(range(3), **small))[1]
    assert labels(movie(range(3), **small, slide=1))[1]


def test_a_force_that_grows_is_not_dynamic():
    growing = movie(range(5)) * torch.linspace(0.1, 1, 12)[:, None, None]
    assert not labels(growing)[1]


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


def test_an_empty_movie_has_no_label():
    assert labels(torch.zeros(12, 10, 10)) == [False] * 4


def test_a_factorised_movie_measures_as_its_dense_one():
    generator = torch.Generator().manual_seed(0)
    frames = (
        torch.rand(3, 10, 10, generator=generator) * 1e5 * (torch.rand(3, 10, 10, generator=generator) > 0.7)
    )
    index = torch.tensor([[0, 0, 1, 1, 0], [2, 2, 2, 2, 2]])
    scale = torch.tensor([[0, 0.5, 1, 0.01, 0], [0.2, 1, 0, 1, 0.3]])
    short = measure_gestures(frames, index, scale, FOOTPRINTS.flatten(1), CELL)
    dense = (frames[index] * scale[..., None, None]).flatten(0, 1)
    every = torch.arange(10).view(2, 5)
    full = measure_gestures(dense, every, torch.ones(2, 5), FOOTPRINTS.flatten(1), CELL)
    for one, other in zip(short, full, strict=True):
        torch.testing.assert_close(one, other)


def test_a_direction_is_from_the_first_place_to_the_last():
    net = torch.tensor([[0.03, 0.04], [0.0, -0.02], [0.01, 0.0], [0.0099, 0.0], [0.0, 0.0]])
    way = torch.tensor([0.05, 0.03, 0.02, 0.02, 0.0])
    expected = torch.tensor([[0.6, 0.8], [0.0, -1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    torch.testing.assert_close(sliding(net, way), expected)
