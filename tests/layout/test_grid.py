"""The regular grid."""

import numpy as np
import pytest

from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.layout.grid import Grid

BODY = Sheet([0.16, 0.08], [4, 4], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


def test_sensors_stand_in_the_middle_of_equal_tiles():
    positions = Grid(rows=2, columns=4).sensors(BODY).positions
    np.testing.assert_allclose(positions[:, 0], [0.02, 0.06, 0.10, 0.14] * 2)
    np.testing.assert_allclose(positions[:, 1], [0.02] * 4 + [0.06] * 4)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rows": 0}, "layout.rows must be a whole number of at least 1, got 0"),
        ({"columns": 2.5}, "layout.columns must be a whole number"),
        ({"footprint": [0.01, 0]}, "layout.footprint must be two positive lengths"),
        ({"footprint": [0.01]}, "layout.footprint must be two positive lengths"),
    ],
)
def test_what_is_no_grid_is_refused(options, says):
    with pytest.raises(InputError, match=says):
        Grid(**options).sensors(BODY)
