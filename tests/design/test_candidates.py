"""Sites lie on the surface, on their raster, and outside of keep-out zones."""

import numpy as np
import pytest
from PIL import Image

from skin.body.base import Sheet
from skin.design.placement import candidate_sites, keep_out
from skin.errors import InputError

LAYERS = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
SIZE = (0.12, 0.06)
SHEET = Sheet(SIZE, [24, 12], LAYERS)
FOOTPRINT = (0.01, 0.01)


def positions(**settings):
    return candidate_sites(SHEET, FOOTPRINT, 0.0, **settings).positions[:, :2]


def test_sites_are_cells_with_room_for_a_footprint():
    found = positions()
    x, y = (np.unique(found[:, axis].round(6)) for axis in (0, 1))
    assert x == pytest.approx(np.arange(0.0075, 0.115, 0.005))
    assert y == pytest.approx(np.arange(0.0075, 0.055, 0.005))
    assert len(found) == len(x) * len(y)
    assert found[:2] == pytest.approx(np.array([[0.0075, 0.0075], [0.0125, 0.0075]]))


@pytest.mark.parametrize(
    ("raster", "counts"), [(0.02, (6, 3)), ((0.03, 0.02), (4, 3)), ([0.05, 0.05], (2, 1))]
)
def test_a_raster_is_centred(raster, counts):
    found = positions(raster=raster)
    pitches = raster if isinstance(raster, tuple | list) else (raster, raster)
    for axis in (0, 1):
        lines = np.unique(found[:, axis].round(6))
        assert len(lines) == counts[axis]
        assert np.diff(lines) == pytest.approx(pitches[axis], abs=2e-6)
        assert lines.mean() == pytest.approx(SIZE[axis] / 2, abs=1e-6)


def test_no_footprint_lies_in_a_polygon():
    triangle = [(0.0, 0.0), (0.04, 0.0), (0.0, 0.04)]
    box = [(0.1, 0.03), (0.12, 0.03), (0.12, 0.06), (0.1, 0.06)]
    found = positions(forbidden=keep_out([triangle, box], SIZE))
    upper_left = found - 0.005
    # The corner of the footprint that is nearest to a zone, with 0.5 mm for the pixels of its outline.
    assert (upper_left.sum(axis=1) > 0.04 - 0.002).all()
    lower_right = found + 0.005
    assert not (lower_right > np.array([0.1005, 0.0305])).all(axis=1).any()
    rest = positions()
    free = ((rest - 0.005).sum(axis=1) > 0.04) & ~(rest + 0.005 > np.array([0.1, 0.03]) + 1e-9).all(axis=1)
    assert {tuple(one) for one in rest[free].round(6)} <= {tuple(one) for one in found.round(6)}


def test_dark_pixels_of_a_picture_forbid_sites(tmp_path):
    pixels = np.full((60, 120), 255, dtype=np.uint8)
    pixels[:, :60] = 20
    Image.fromarray(pixels).save(tmp_path / "left.png")
    found = positions(forbidden=keep_out(str(tmp_path / "left.png"), SIZE))
    assert len(found) == 10 * 10
    assert found[:, 0].min() == pytest.approx(0.0675)


def test_transparent_pixels_forbid_nothing(tmp_path):
    Image.new("RGBA", (120, 60), (0, 0, 0, 0)).save(tmp_path / "clear.png")
    assert not keep_out(str(tmp_path / "clear.png"), SIZE).any()


def test_a_picture_of_another_aspect_is_refused(tmp_path):
    Image.new("L", (60, 60), 255).save(tmp_path / "square.png")
    match = r"60 x 60 pixels, but the surface has 0\.12 x 0\.06 m: give a picture"
    with pytest.raises(InputError, match=match):
        keep_out(str(tmp_path / "square.png"), SIZE)
    Image.new("L", (61, 30), 255).save(tmp_path / "near.png")
    assert keep_out(str(tmp_path / "near.png"), SIZE).shape == (30, 61)


@pytest.mark.parametrize(("content", "reason"), [(None, "no picture"), (b"no picture", "cannot read")])
def test_what_is_no_picture_is_refused(tmp_path, content, reason):
    path = tmp_path / "x.png"
    if content:
        path.write_bytes(content)
    with pytest.raises(InputError, match=reason):
        keep_out(str(path), SIZE)


def test_a_polygon_needs_three_corners():
    with pytest.raises(InputError, match=r"polygon 2 of design\.keep_out has 2 corners"):
        keep_out([[(0, 0), (0.1, 0), (0, 0.1)], [(0, 0), (0.1, 0.1)]], SIZE)


def test_no_site_left_is_refused():
    everything = [[(-0.01, -0.01), (0.13, -0.01), (0.13, 0.07), (-0.01, 0.07)]]
    with pytest.raises(InputError, match="no site is left"):
        positions(forbidden=keep_out(everything, SIZE))
    with pytest.raises(InputError, match="no site is left"):
        positions(raster=0.2)
