"""The random layout."""

import numpy as np
import pytest

from skin.body.layout import Random
from skin.body.sheet import Sheet
from skin.errors import InputError

BODY = Sheet([0.16, 0.08], [32, 16], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("seed", range(5))
def test_footprints_neither_overlap_nor_leave_the_surface(seed):
    positions = Random(25, seed, (0.01, 0.008)).sensors(BODY).positions[:, :2]
    extent = np.array([0.01, 0.008])
    assert positions.shape == (25, 2)
    assert (positions >= extent / 2 - 1e-6).all()
    assert (positions <= np.array(BODY.size) - extent / 2 + 1e-6).all()
    apart = np.abs(positions[:, None] - positions[None]) >= extent
    assert (apart.any(axis=2) | np.eye(25, dtype=bool)).all()


@pytest.mark.parametrize(("count", "footprint"), [(200, (0.01, 0.01)), (1, (0.2, 0.01))])
def test_more_sensors_than_fit_are_refused(count, footprint):
    with pytest.raises(InputError, match=r"layout\.count"):
        Random(count, 0, footprint).sensors(BODY)
