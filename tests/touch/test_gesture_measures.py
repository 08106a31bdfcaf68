"""Labels of movies typed out by hand."""

import torch

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
