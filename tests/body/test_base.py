"""Bodies: the contract of all, the sheet, and the arm, which is a sheet rolled up."""

from dataclasses import replace

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.arm import Arm
from skin.body.base import AbstractBody, Sensors
from skin.body.sheet import Sheet
from skin.core.files import CONF
from skin.errors import InputError

OPTIONS = sorted((CONF / "body").glob("*.yaml"))


@pytest.fixture(params=OPTIONS, ids=lambda path: path.stem)
def body(request) -> AbstractBody:
    return instantiate(OmegaConf.load(request.param))


def points(body: AbstractBody, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform(size=(*shape, 3)) * [*body.size, body.thickness]


def test_the_chart_is_a_grid_of_equal_cells(body):
    assert isinstance(body, AbstractBody)
    assert isinstance(body.flat, bool)
    assert np.multiply(body.cell, body.cells) == pytest.approx(body.size)
    assert hash(body) == hash(replace(body))
    assert replace(body, cells=(8, 6)).shape == (6, 8)


def test_the_axes_are_orthonormal_and_one_way_round(body):
    frame = body.frame(points(body, 50))
    product = frame @ frame.swapaxes(1, 2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-14)
    # x, y and outwards are right-handed on every body
    assert (np.linalg.det(frame) < 0).all()


def test_the_axes_are_the_way_that_places_move(body):
    """Independent answer: differences of places, from which the lengths at the surface follow too."""
    step, given = 1e-6, points(body, 50)
    for surface in (given, given * [1, 1, 0]):
        moves = np.stack([body.locate(surface + step * axis) for axis in np.eye(3)], axis=1)
        moves = (moves - body.locate(surface)[:, None]) / step
        length = np.linalg.norm(moves, axis=2)
        np.testing.assert_allclose(moves / length[..., None], body.frame(surface), atol=1e-4)
    np.testing.assert_allclose(length, 1, atol=1e-4)  # the chart is true to length on the surface


LAYERS = [
    {"material": {"name": "Dragon Skin 10 Medium", "poisson": 0.49}, "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


def arm(**changes) -> Arm:
    return Arm(**{"radius": 0.05, "length": 0.2, "angle": 2.0, "cells": [8, 6], "layers": LAYERS, **changes})


def test_places_by_hand():
    """A half sleeve of 5 cm: its edges lie level with the axis, its middle on top."""
    half = arm(angle=np.pi)
    edge = np.pi * 0.05
    chart = [[0, 0, 0], [edge / 2, 0.1, 0], [edge, 0.2, 0], [edge / 2, 0.1, 0.015], [edge, 0, 0.015]]
    space = [[-0.05, 0, 0], [0, 0.1, 0.05], [0.05, 0.2, 0], [0, 0.1, 0.035], [0.035, 0, 0]]
    np.testing.assert_allclose(half.locate(np.array(chart)), space, atol=1e-15)
    top = half.frame(np.array([edge / 2, 0.1, 0.0]))
    np.testing.assert_allclose(top, [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(half.frame(np.zeros(3)), [[0, 0, 1], [0, 1, 0], [1, 0, 0]], atol=1e-15)


def test_all_places_lie_on_the_cylinder_and_into_the_skin_is_to_its_axis():
    body, rng = arm(), np.random.default_rng(0)
    given = rng.uniform(size=(100, 3)) * [*body.size, body.thickness]
    space, into = body.locate(given), body.frame(given)[:, 2]
    radius = np.hypot(space[:, 0], space[:, 2])
    np.testing.assert_allclose(radius, 0.05 - given[:, 2])
    np.testing.assert_allclose(space + radius[:, None] * into, space * [0, 1, 0], atol=1e-15)


def test_straight_lines_of_the_chart_are_the_shortest_on_the_surface():
    """Distances between sensors: the helix's length by small steps in space, and no detour is shorter."""
    body = arm()
    first, second = np.array([0.01, 0.03, 0.0]), np.array([0.09, 0.15, 0.0])
    fraction = np.linspace(0, 1, 2001)[:, None]
    helix = first + fraction * (second - first)
    along = np.linalg.norm(np.diff(body.locate(helix), axis=0), axis=1).sum()
    assert along == pytest.approx(np.linalg.norm(second - first), rel=1e-6)
    for bend in (-0.01, 0.01):
        detour = helix + bend * np.sin(np.pi * fraction) * [1, 0, 0]
        assert np.linalg.norm(np.diff(body.locate(detour), axis=0), axis=1).sum() > along


def test_it_says_how_to_give_it_another_size():
    """Recordings and layouts know extents, not angles."""
    body = arm()
    typed = dict(part.removeprefix("body.").split("=") for part in body.resized((0.12, 0.16)).split())
    assert arm(**{name: float(value) for name, value in typed.items()}).size == pytest.approx((0.12, 0.16))


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
    ("make", "changes", "says"),
    [
        (arm, {"radius": 0}, "body.radius=0 must be greater than 0"),
        (arm, {"length": -1}, "body.length=-1 must be greater than 0"),
        (arm, {"angle": 2 * np.pi}, "body.angle=6.283.* must be less than 6.283"),
        (arm, {"radius": 0.015}, "layers of 0.015 m together leave no core within body.radius=0.015 m"),
        (arm, {"cells": [1, 8]}, "body.cells=.* must be greater than or equal to 2"),
        (arm, {"layers": []}, "at least one layer"),
        (sheet, {"size": [0.16, 0]}, r"body.size=\[0.16, 0\] must be greater than 0"),
        (sheet, {"cells": [1, 8]}, r"body.cells=\[1, 8\] must be greater than or equal to 2"),
        (sheet, {"layers": []}, "at least one layer"),
        (sheet, {"layers": [{"material": "EcoFlex 00-30"}]}, "body.layers.0 needs thickness, got material"),
        (sheet, {"layers": [LAYERS[0], LAYERS[1] | {"thickness": -1}]}, "body.layers.1.thickness=-1 must"),
        (sheet, {"layers": [{"material": "rubber", "thickness": 0.01}]}, "unknown material rubber"),
    ],
)
def test_what_is_no_body_is_refused_by_name(make, changes, says):
    with pytest.raises(InputError, match=says):
        make(**changes)


def test_a_mesh_too_fine_for_memory_is_refused_with_an_estimate():
    with pytest.raises(InputError, match=r"body.cells=\[1000000,1000000\] needs about .* GB.*32,32"):
        sheet(cells=[1_000_000, 1_000_000])
