"""Shapes on cells, against areas known otherwise; pictures that press, and pictures that cannot."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.touch.shapes import Shapes, load_image

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


DATA = Path(__file__).parents[2] / "data"


def save(path: Path, pixels: np.ndarray) -> str:
    Image.fromarray(pixels).save(path)
    return str(path)


def test_the_shipped_shapes_are_what_the_script_draws():
    shapes = runpy.run_path(str(DATA / "make_shapes.py"))["SHAPES"]
    assert {path.stem for path in (DATA / "shapes").glob("*.png")} == set(shapes)
    for name, shape in shapes.items():
        np.testing.assert_allclose(load_image(name), shape() / shape().max(), atol=1.01 / 255)


@pytest.mark.parametrize(
    ("kind", "unit", "suffix"), [(np.uint8, 1, "png"), (np.uint16, 257, "png"), (np.float32, 7 / 255, "tiff")]
)
def test_any_depth(tmp_path, kind, unit, suffix):
    pixels = (unit * np.array([[0, 128], [255, 64], [0, 0]])).astype(kind)
    image = load_image(save(tmp_path / f"mine.{suffix}", pixels))
    np.testing.assert_allclose(image, [[0, 128 / 255], [1, 64 / 255], [0, 0]], atol=1e-3)


def test_transparent_means_no_force(tmp_path):
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:2, :, 3] = 0
    image = load_image(save(tmp_path / "mine.png", pixels))
    np.testing.assert_array_equal(image, [[0] * 4] * 2 + [[1] * 4] * 2)


def test_refusals_name_the_picture(tmp_path):
    with pytest.raises(InputError, match=r"no shape nothing: touch.shapes takes bar, .*square"):
        load_image("nothing")
    good = (DATA / "shapes" / "hand.png").read_bytes()
    for name, content in (("text", b"no picture"), ("empty", b""), ("cut", good[: len(good) // 2])):
        (tmp_path / f"{name}.png").write_bytes(content)
        with pytest.raises(InputError, match=rf"cannot read the shape .*{name}.png"):
            load_image(str(tmp_path / f"{name}.png"))
    with pytest.raises(InputError, match=r"black.png must be .* got \(5, 5\) pixels from 0 to 0"):
        load_image(save(tmp_path / "black.png", np.zeros((5, 5), np.uint8)))
    with pytest.raises(InputError, match=r"nan.tiff must be .* finite values .* from nan"):
        load_image(save(tmp_path / "nan.tiff", np.array([[1, np.nan]], np.float32)))
    with pytest.raises(InputError, match=r"pull.tiff must be .* from 0 up, .* from -1 to 1"):
        load_image(save(tmp_path / "pull.tiff", np.array([[1, -1]], np.float32)))
