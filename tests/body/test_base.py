"""The contract of every body: a chart of its surface, and where that lies in space."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.base import AbstractBody

CONF = Path(__file__).parents[2] / "conf" / "body"
OPTIONS = sorted(CONF.glob("*.yaml"))


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
