"""Bodies that fit on sheets of any form, and what their shape tells."""

import numpy as np
import pytest

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.device.simulated import accuracy_from_shape
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.gestures import Fit, GestureSettings, TouchSampler, draw_bodies
from skin.touch.shapes import Shapes

LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
DEFAULT = Sheet((0.16, 0.16), (32, 32), LAYER)
OBLONG = {
    "240 x 80 mm": Sheet((0.24, 0.08), (48, 16), LAYER),
    "60 x 200 mm": Sheet((0.06, 0.20), (12, 40), LAYER),
    "320 x 107 mm": Sheet((0.320, 0.107), (64, 21), LAYER),
}


@pytest.fixture(scope="module", params=OBLONG)
def bodies(request):
    body, settings = OBLONG[request.param], GestureSettings()
    generator, shapes = np.random.default_rng(0), Shapes(settings.shapes, body)
    big, fit = generator.random(4000) < 0.5, Fit.of(settings, shapes)
    return body, big, draw_bodies(big, settings, shapes, generator, fit, fit.draw(big, generator))


def test_a_body_is_stretched_along_the_longer_side_and_only_as_far_as_it_needs(bodies):
    body, big, drawn = bodies
    along = np.log(drawn["stretch"]) * np.sign(body.size[0] - body.size[1])
    discs = drawn["shape"] == 0
    assert (along[discs] >= 0).all()
    narrow = int(np.argmin(body.size))
    left = (np.array(body.size) - (drawn["high"] - drawn["low"]))[:, narrow]
    needed = big & (along > 0)
    np.testing.assert_allclose(left[needed], 0.010, atol=1e-8)


def test_fitted_bodies_cover_what_was_asked(bodies):
    """Counted on the cells of discs: 30 to 70 % where they are big, though the sheet is narrow."""
    body, big, drawn = bodies
    rows = np.flatnonzero(drawn["shape"] == 0)[:200]
    shapes = Shapes(GestureSettings().shapes, body)
    room = np.array(body.size) - (drawn["high"] - drawn["low"])[rows]
    pose = *(drawn[name][rows] for name in ("shape", "angle", "scale")), room / 2 - drawn["low"][rows]
    frames = shapes.render(*pose, drawn["stretch"][rows]).flatten(1)
    area = (frames > 0.02 * frames.amax(1, keepdim=True)).float().mean(1).numpy()
    assert area[big[rows]].min() > 0.27
    assert area[big[rows]].max() < 0.72
    assert area[~big[rows]].max() < 0.33


def test_a_sheet_of_nine_sensors_and_three_to_one_has_all_gestures():
    """Of the 250 big touches of such a sheet 249 were bars, and 4038 gestures could not be drawn at all."""
    body = OBLONG["240 x 80 mm"]
    source = TouchSampler(body, body.footprints(Grid(3, 3).sensors(body)), Prescribed(), GestureSettings())
    movie = source.sample(512, np.random.default_rng(0))
    assert source.fit
    shape, big = movie.parameters["shape"].numpy().astype(int), movie.labels[:, 0].numpy() > 0.5
    assert np.bincount(shape[big], minlength=7).min() >= 15
    told, error = accuracy_from_shape(shape, big)
    assert told - 2 * error < 0.6


def test_shapes_without_room_are_named():
    footprints = DEFAULT.footprints(Grid().sensors(DEFAULT))
    source = TouchSampler(DEFAULT, footprints, Prescribed(), GestureSettings(shapes=("bar",), spare=0.1))
    with pytest.raises(InputError, match=r"none of touch.shapes=\['bar'\] covers 0.3 to 0.7.*touch.stretch"):
        source.sample(16, np.random.default_rng(0))


def test_a_shape_that_has_room_only_as_a_small_one_is_small():
    """It tells small from big, so a training warns."""
    fit = Fit(big=np.array([True, False]), small=np.array([True, True]))
    big = np.arange(1000) % 2 == 0
    shape = fit.draw(big, np.random.default_rng(0))
    assert (shape[big] == 0).all()
    assert 200 < (shape[~big] == 1).sum() < 300
    told, error = accuracy_from_shape(shape, big)
    assert told - 2 * error > 0.6
