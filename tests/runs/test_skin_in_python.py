"""A skin that was built in Python has the settings that build it again."""

import numpy as np
import pytest
from hydra.utils import instantiate

from skin.body.base import Arm, Layer, Sheet
from skin.body.layout import File, Grid, Random
from skin.body.material import Material, Relaxation
from skin.runs.build import with_skin
from skin.runs.configuration import Config

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.01},
    Layer(Material("gel", 4e4, 0.49, Relaxation(0.5, 0.3)), 0.004),
]


BODIES = Sheet((0.2, 0.1), (20, 10), LAYERS), Arm((20, 10), LAYERS, radius=0.05, length=0.1, angle=2.0)


@pytest.mark.parametrize("body", BODIES, ids=["sheet", "arm"])
@pytest.mark.parametrize(
    "layout", [Grid(2, 3, (0.008, 0.006), tilt=0.3), Random(5, 1), File("data/layouts/tilted_5x5.csv")]
)
def test_the_settings_build_the_same_skin(body, layout):
    if isinstance(layout, File):
        body = Sheet((0.16, 0.16), (16, 16), LAYERS)
    config = with_skin(Config(seed=1), body, layout)
    assert config.seed == 1
    assert instantiate(config.body) == body
    sensors, expected = instantiate(config.layout).sensors(body), layout.sensors(body)
    np.testing.assert_allclose(sensors.positions, expected.positions)
    np.testing.assert_allclose(sensors.normals, expected.normals)
    assert sensors.footprint == expected.footprint


def test_names_and_files_are_options():
    config = with_skin(Config(), "arm", "sensors.csv")
    assert config.body["_target_"] == "skin.body.arm.Arm"
    assert config.layout == {
        "_target_": "skin.body.layout.File", "_convert_": "all", "path": "sensors.csv",
        "footprint": [0.01, 0.01], "depth": None,
    }  # fmt: skip
    assert with_skin(Config(seed=1), None, None) == Config(seed=1)
