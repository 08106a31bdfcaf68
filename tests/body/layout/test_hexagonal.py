"""The hexagonal layout."""

import numpy as np
import pytest

from skin.body.layout import Hexagonal
from skin.body.sheet import Sheet
from skin.errors import InputError

LAYERS = [{"material": "EcoFlex 00-30", "thickness": 0.005}]


def test_an_inner_sensor_has_six_neighbours_at_equal_distances():
    pitch = 0.02
    body = Sheet([6 * pitch, 5 * pitch * np.sqrt(3) / 2], [12, 10], LAYERS)
    positions = Hexagonal(5, 6).sensors(body).positions[:, :2]
    middle = positions[2 * 6 + 3]
    distances = np.sort(np.linalg.norm(positions - middle, axis=1))[1:8]
    np.testing.assert_allclose(distances[:6], pitch, rtol=1e-9)
    assert distances[6] > 1.5 * pitch


def test_no_row_is_refused():
    with pytest.raises(InputError, match=r"layout\.rows"):
        Hexagonal(rows=0)
