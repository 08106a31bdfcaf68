"""What a network is told of each sensor, and the pressure of fingertips, against closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from skin.body.base import GEOMETRY, Layer, Sheet
from skin.body.layout import Grid
from skin.body.material import Material
from skin.mechanics.geometry import Fingertip, sensor_geometry
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid


@pytest.fixture(scope="module")
def body():
    layers = [Layer(Material("hard", 2e5, 0.49), 0.01), Layer(Material("soft", 1e5, 0.49), 0.01)]
    return Sheet((0.2, 0.16), (40, 32), layers)


def column(geometry, name):
    return geometry[:, GEOMETRY.index(name)]


def test_without_mechanics_a_sensor_reads_the_pressure_above_it(body):
    body = replace(body, size=(0.205, 0.165), cells=(41, 33))
    sensors = Grid(1, 1, (0.005, 0.005), depth=0.005).sensors(body)  # in the middle of a cell
    geometry = sensor_geometry(body, sensors, Naive(body, sensors))
    torch.testing.assert_close(column(geometry, "share"), torch.ones(1))
    # The integral of 1 / (1 + exp((d - r) / w)) over the plane is pi r^2 (1 + (pi w / r)^2 / 3).
    area = math.pi * 0.008**2 * (1 + (math.pi * 0.0015 / 0.008) ** 2 / 3)
    assert column(geometry, "response_0mm").item() == pytest.approx(0.005**2 / area, rel=0.03)
    assert column(geometry, "response_40mm").item() == pytest.approx(0, abs=1e-6)


def test_places_and_sizes_are_those_of_the_skin(body):
    sensors = Grid(2, 3, (0.008, 0.006), depth=0.004).sensors(body)
    geometry = sensor_geometry(body, sensors, Naive(body, sensors))
    positions = torch.from_numpy(sensors.positions)
    torch.testing.assert_close(geometry[:, :3].double(), positions, rtol=1e-6, atol=0)
    for name, value in {"footprint_x": 0.008, "footprint_y": 0.006, "width": 0.2, "height": 0.16}.items():
        torch.testing.assert_close(column(geometry, name), torch.full((6,), value))
    torch.testing.assert_close(column(geometry, "thickness"), torch.full((6,), body.thickness))


def test_in_a_solid_the_response_falls_with_distance_and_mirrors(body):
    body = replace(body, cells=(20, 16))
    sensors = Grid(2, 2, (0.01, 0.01), depth=0.01).sensors(body)
    geometry = sensor_geometry(body, sensors, Solid(body, sensors, divisions=1))
    near, far = column(geometry, "response_0mm"), column(geometry, "response_20mm")
    assert (near > 5 * far.abs()).all()
    # the four sensors are mirror images of each other
    torch.testing.assert_close(near, near.mean().expand(4), rtol=1e-3, atol=0)
    # an even load is carried evenly
    torch.testing.assert_close(column(geometry, "share"), torch.ones(4), rtol=0.05, atol=0)


SHEET = Sheet([0.12, 0.08], [24, 16], [{"material": "EcoFlex 00-30", "thickness": 0.01}])
TOUCHES = torch.tensor([[0.05, 0.03, 0.010, 5.0], [0.1, 0.06, 0.004, 1.0]], dtype=torch.float64)


def test_pressure_has_the_force_and_the_centre_of_the_touch():
    pressure = Fingertip(SHEET, 0.0015)(TOUCHES)
    assert pressure.shape == (2, 16, 24)
    force = pressure * (0.12 / 24 * 0.08 / 16)
    assert force.sum((1, 2)).numpy() == pytest.approx([5, 1], rel=1e-12)
    x, y = (torch.arange(count) * 0.005 + 0.0025 for count in (24, 16))
    assert ((force.sum(1) @ x.double()) / force.sum((1, 2))).numpy() == pytest.approx([0.05, 0.1], abs=2e-4)
    assert ((force.sum(2) @ y.double()) / force.sum((1, 2))).numpy() == pytest.approx([0.03, 0.06], abs=2e-4)
    pressure = Fingertip(SHEET, 2e-4)(torch.tensor([[0.06, 0.04, 0.02, 3.0]], dtype=torch.float64))
    assert pressure.max().item() == pytest.approx(3 / (torch.pi * 0.02**2), rel=0.01)
