"""Pictures that press, and pictures that cannot."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skin.errors import InputError
from skin.touch.shapes import load_image

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
