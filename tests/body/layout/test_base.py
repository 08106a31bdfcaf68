"""The contract of every layout."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.base import Sensors
from skin.body.layout import AbstractLayout, Grid
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive

CONF = Path(__file__).parents[3] / "conf"
OPTIONS = sorted((CONF / "layout").glob("*.yaml"))


@pytest.fixture(scope="module", params=sorted((CONF / "body").glob("*.yaml")), ids=lambda path: path.stem)
def body(request):
    return instantiate(OmegaConf.load(request.param))


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


@pytest.mark.parametrize("simulator", [Naive, PlatesAndBeams])
def test_what_feels_no_shear_refuses_tilted_sensors(simulator):
    body = instantiate(OmegaConf.load(CONF / "body" / "sheet.yaml"))
    sensors = Grid(2, 2).sensors(body)
    normals = sensors.normals.copy()
    normals[2] = [0.6, 0.0, 0.8]
    with pytest.raises(InputError, match=r"sensor 3 is tilted or .*simulator=(naive|fem) .*simulator=solid"):
        simulator(body, replace(sensors, normals=normals))
    with pytest.raises(InputError, match=r"sensor 1 .*measures along the surface, .*layout.axes=normal"):
        simulator(body, Grid(2, 2, axes="three").sensors(body))


@pytest.mark.parametrize("option", OPTIONS, ids=lambda path: path.stem)
def test_shipped_layouts_run_from_the_upper_left_rightwards_and_down(option, body):
    x, y, _ = instantiate(OmegaConf.load(option)).sensors(body).positions.T
    if option.stem == "random":  # which has no rows
        assert (np.diff(y) >= 0).all()
        return
    rows = y.reshape(5, 5)
    assert (np.diff(x.reshape(5, 5), axis=1) > 0).all()
    assert (rows[1:].min(axis=1) > rows[:-1].max(axis=1)).all()
