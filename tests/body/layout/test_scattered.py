"""The scattered layout, and the file that holds the default one."""

import numpy as np
import pytest

from skin.body.layout import File, Grid, Scattered
from skin.body.sheet import Sheet
from skin.errors import InputError

LAYERS = [{"material": "EcoFlex 00-30", "thickness": thickness} for thickness in (0.010, 0.005)]
BODY = Sheet([0.16, 0.16], [32, 32], LAYERS)


def test_the_shipped_file_is_the_layout_of_seed_0():
    shipped = File("data/layouts/jittered_5x5.csv").sensors(BODY)
    np.testing.assert_array_equal(shipped.positions, Scattered(5, 5, 0.25, seed=0).sensors(BODY).positions)


def test_no_sensor_moves_farther_than_the_jitter():
    wide = Sheet([0.30, 0.16], [8, 8], LAYERS)
    pitch = np.array([0.30 / 6, 0.16 / 4])
    scattered = np.stack([Scattered(4, 6, 0.25, seed).sensors(wide).positions for seed in range(20)])
    moves = np.abs(scattered - Grid(4, 6).sensors(wide).positions)[..., :2]
    assert (moves <= 0.25 * pitch + 1e-6).all()
    assert (moves.max(axis=(0, 1)) > 0.24 * pitch).all()


@pytest.mark.parametrize("jitter", [-0.1, 0.5])
def test_a_jitter_at_which_sensors_could_meet_is_refused(jitter):
    with pytest.raises(InputError, match=r"layout\.jitter=.* must be .*: as in layout.jitter=0\.25"):
        Scattered(jitter=jitter)
