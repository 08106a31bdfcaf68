"""The contract of every layout."""

from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.layout.base import AbstractLayout, Sensors

CONF = Path(__file__).parents[2] / "conf"
OPTIONS = sorted((CONF / "layout").glob("*.yaml"))


@pytest.fixture(scope="module")
def body():
    return instantiate(OmegaConf.load(CONF / "body" / "sheet.yaml"))


@pytest.mark.parametrize("option", OPTIONS, ids=lambda path: path.stem)
def test_every_layout_places_sensors_in_the_body(option, body):
    layout = instantiate(OmegaConf.load(option))
    assert isinstance(layout, AbstractLayout)
    sensors = layout.sensors(body)
    assert isinstance(sensors, Sensors)
    assert sensors.positions.shape == (len(sensors), 3) == (25, 3)
    assert sensors.footprint == (0.01, 0.01)
    assert ((sensors.positions >= 0) & (sensors.positions <= [*body.size, body.thickness])).all()
    np.testing.assert_allclose(sensors.positions[:, 2], 0.005)
    np.testing.assert_array_equal(sensors.positions, layout.sensors(body).positions)


@pytest.mark.parametrize("option", OPTIONS, ids=lambda path: path.stem)
def test_shipped_layouts_run_from_the_upper_left_rightwards_and_down(option, body):
    x, y, _ = instantiate(OmegaConf.load(option)).sensors(body).positions.T
    rows = y.reshape(5, 5)
    assert (np.diff(x.reshape(5, 5), axis=1) > 0).all()
    assert (rows[1:].min(axis=1) > rows[:-1].max(axis=1)).all()
