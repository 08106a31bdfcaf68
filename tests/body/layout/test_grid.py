"""The regular grid."""

import numpy as np
import pytest

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.errors import InputError

BODY = Sheet([0.16, 0.08], [4, 4], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


def test_sensors_stand_in_the_middle_of_equal_tiles():
    positions = Grid(rows=2, columns=4).sensors(BODY).positions
    np.testing.assert_allclose(positions[:, 0], [0.02, 0.06, 0.10, 0.14] * 2)
    np.testing.assert_allclose(positions[:, 1], [0.02] * 4 + [0.06] * 4)


def test_neighbours_are_tilted_along_different_axes():
    normals = Grid(rows=3, columns=6, tilt=0.4).sensors(BODY).normals.reshape(3, 6, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
    np.testing.assert_allclose(normals[..., 2], np.cos(0.4))
    np.testing.assert_allclose(normals[0, 0], [np.sin(0.4), 0, np.cos(0.4)], atol=1e-15)
    for row in range(2):
        for column in range(5):
            four = normals[row : row + 2, column : column + 2].reshape(4, 3)
            assert len({tuple(np.round(one, 6)) for one in four}) == 4
            np.testing.assert_allclose(four.sum(axis=0)[:2], 0, atol=1e-15)


def test_three_axes_are_three_sensors_at_each_site():
    sensors, sites = Grid(2, 3, tilt=0.3, axes="three").sensors(BODY), Grid(2, 3, tilt=0.3).sensors(BODY)
    np.testing.assert_array_equal(sensors.positions, sites.positions.repeat(3, axis=0))
    frames = sensors.measured.reshape(-1, 3, 3)
    np.testing.assert_array_equal(frames[:, 2], sites.normals)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"tilt": -0.1}, "layout.tilt=-0.1 must be greater than or equal to 0"),
        ({"tilt": np.pi / 2}, "layout.tilt=1.57.* must be less than 1.57"),
        ({"tilt": float("nan")}, "layout.tilt=nan must be a finite number"),
        ({"tilt": "much"}, "layout.tilt=much must be a valid number"),
        ({"rows": 0}, "layout.rows=0 must be greater than 0: as in layout.rows=5"),
        ({"columns": 2.5}, "layout.columns=2.5 must be a whole number"),
        ({"footprint": [0.01, 0]}, "layout.footprint=.* must be greater than 0"),
        ({"footprint": [0.01]}, "layout.footprint=.* has too few entries"),
    ],
)
def test_what_is_no_grid_is_refused(options, says):
    with pytest.raises(InputError, match=says):
        Grid(**options).sensors(BODY)
