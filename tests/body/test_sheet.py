"""The sheet: its geometry, the area under a footprint, and what is refused."""

import numpy as np
import pytest

from skin.body.base import Sensors
from skin.body.sheet import Sheet
from skin.errors import InputError

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


def sheet(**changes) -> Sheet:
    return Sheet(**{"size": [0.16, 0.08], "cells": [8, 6], "layers": LAYERS, **changes})


def test_interfaces_run_from_the_table_up():
    body = sheet(layers=[*LAYERS, {"material": "EcoFlex 00-30", "thickness": 0.002}])
    assert body.interfaces == pytest.approx((0.007, 0.002, 0.0))
    assert body.sensor_depth == 0.002
    assert body.thickness == pytest.approx(0.017)


def test_footprint_mean_is_the_integral_of_a_fine_raster():
    """Independent answer: sample the footprint on a raster much finer than the cells."""
    body = sheet(cells=[7, 5])
    rng = np.random.default_rng(0)
    pressure = rng.uniform(size=body.shape)
    positions = np.column_stack([rng.uniform(0.02, 0.14, 6), rng.uniform(0.02, 0.06, 6), np.zeros(6)])
    means = body.footprints(Sensors(positions, (0.03, 0.02))) @ pressure.ravel()
    steps = (np.arange(400) + 0.5) / 400 - 0.5
    for mean, (x, y, _) in zip(means, positions, strict=True):
        columns = ((x + 0.03 * steps) / body.cell[0]).astype(int)
        rows = ((y + 0.02 * steps) / body.cell[1]).astype(int)
        assert mean == pytest.approx(pressure[np.ix_(rows, columns)].mean(), abs=5e-3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"size": [0.16, 0]}, r"body.size=\[0.16, 0\] must be greater than 0"),
        ({"size": [0.16]}, r"body.size=\[0.16\] has too few entries"),
        ({"size": [float("nan"), 0.1]}, "body.size=.* must be a finite number"),
        ({"size": ["0.16", 0.1]}, "body.size=.* must be a valid number, not text"),
        ({"size": [True, 0.1]}, "body.size=.* must be a valid number"),
        ({"cells": [1, 8]}, r"body.cells=\[1, 8\] must be greater than or equal to 2"),
        ({"cells": [8.5, 8]}, "body.cells=.* must be a whole number"),
        ({"cells": [8.0, 8]}, "body.cells=.* must be a whole number"),
        ({"layers": []}, "at least one layer"),
        ({"layers": [{"material": "EcoFlex 00-30"}]}, "body.layers.0 needs thickness, got material"),
        ({"layers": [LAYERS[0], LAYERS[1] | {"thickness": -1}]}, "body.layers.1.thickness=-1 must"),
        ({"layers": [{"material": "rubber", "thickness": 0.01}]}, "unknown material rubber"),
    ],
)
def test_what_is_no_sheet_is_refused_by_name(changes, says):
    with pytest.raises(InputError, match=says):
        sheet(**changes)


def test_a_mesh_too_fine_for_memory_is_refused_with_an_estimate():
    with pytest.raises(InputError, match=r"body.cells=\[1000000,1000000\] needs about .* GB.*32,32"):
        sheet(cells=[1_000_000, 1_000_000])
