"""Shapes on cells, against areas known otherwise."""

import numpy as np
import pytest

from skin.body.sheet import Sheet
from skin.touch.shapes import Shapes

LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
NAMES = ("disc", "blurred_disc", "square", "bar", "fist", "hand", "fingertip")
MESHES = [((0.16, 0.16), (32, 32)), ((0.2, 0.1), (24, 30)), ((0.05, 0.3), (7, 40)), ((0.1, 0.1), (3, 2))]


def sheet(size=(0.16, 0.16), cells=(32, 32)) -> Sheet:
    return Sheet(size, cells, LAYER)


def poses(count: int, body: Sheet, seed: int = 0):
    """Return shapes, angles, scales and places whose textures lie wholly on the sheet."""
    draw = np.random.default_rng(seed)
    scale = draw.uniform(0.02, 0.3, count) * min(body.size)
    position = np.array(body.size) / 2 + draw.uniform(-0.05, 0.05, (count, 2)) * body.size
    return draw.integers(0, len(NAMES), count), draw.uniform(0, 2 * np.pi, count), scale, position


@pytest.mark.parametrize(("size", "cells"), MESHES[:3])
def test_cells_hold_the_area_that_a_disc_covers(size, cells):
    """A cell's share of the force is the share of the disc that lies on it, counted on a fine grid."""
    body = sheet(size, cells)
    radius, position = 0.4 * min(size), np.array(size) * (0.52, 0.47)
    shapes = Shapes(["disc"], body)
    pixels = shapes.levels[0].shape[-1]
    # The disc's radius is .95 of its picture of 96 pixels, of which the texture has its own rim.
    scale = radius / 0.95 / (min(96, pixels - 2) / pixels)
    frame = shapes.render(np.array([0]), np.array([0.3]), np.array([scale]), position[None])[0]
    fine = 40
    x, y = ((np.arange(n * fine) + 0.5) / n / fine * extent for n, extent in zip(cells, size, strict=True))
    inside = (x[None] - position[0]) ** 2 + (y[:, None] - position[1]) ** 2 < radius**2
    fraction = inside.reshape(cells[1], fine, cells[0], fine).mean((1, 3))
    fraction /= fraction.sum()
    # At the rim, from the texture's own blur.
    assert np.abs(frame.numpy() - fraction).max() < 0.2 * fraction.max()
    assert np.abs(frame.numpy() - fraction).sum() < 0.08


@pytest.mark.parametrize(("size", "cells"), MESHES)
def test_the_extent_bounds_the_contact(size, cells):
    body = sheet(size, cells)
    shapes = Shapes(NAMES, body)
    shape, angle, scale, position = poses(100, body, seed=1)
    frames = shapes.render(shape, angle, scale, position).numpy()
    low, high = (position + reach for reach in shapes.extent(shape, angle, scale))
    for frame, minimum, maximum in zip(frames, low, high, strict=True):
        rows, columns = np.nonzero(frame > 0.02 * frame.max())
        for cell, axis in ((columns, 0), (rows, 1)):
            step = body.cell[axis]
            assert cell.min() * step > minimum[axis] - 1.5 * step
            assert (cell.max() + 1) * step < maximum[axis] + 1.5 * step


def test_scale_gives_the_wanted_contact_area():
    body = sheet()
    shapes = Shapes(NAMES, body)
    draw = np.random.default_rng(2)
    shape, angle = draw.integers(0, 7, 500), draw.uniform(0, 2 * np.pi, 500)
    area = draw.uniform(0.01, 0.3, 500)
    position = 0.08 + draw.uniform(-0.005, 0.005, (500, 2))
    frames = shapes.render(shape, angle, shapes.scale(shape, area), position).flatten(1)
    measured = (frames > 0.02 * frames.amax(1, keepdim=True)).double().mean(1).numpy()
    assert abs(measured - area).max() < 16 / 1024  # cells
    assert abs(measured - area).mean() < 3 / 1024
    assert shapes.area(shape, shapes.scale(shape, area)) == pytest.approx(area, rel=1e-9)
