"""What gestures are drawn from, and bodies that must fit on a sheet."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.device.simulated import accuracy_from_shape
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.fingertips import FingertipSettings, read_touch
from skin.touch.gestures import Fit, GestureSettings, TouchSampler, draw_bodies, draw_paths
from skin.touch.paths import draw_times, heading, model_window
from skin.touch.shapes import Shapes

CONF = Path(__file__).parents[2] / "conf" / "touch"
BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("kind", [GestureSettings, FingertipSettings])
def test_the_shipped_configuration_is_the_default_difficulty(kind):
    name = {GestureSettings: "gestures", FingertipSettings: "fingertips"}[kind]
    settings = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"))
    assert settings["limits"] == "${limits}"  # of the group, which is empty
    assert read_touch(settings | {"limits": {}}) == kind()
    assert set(settings) == {entry.name for entry in fields(kind)} - {"labels"}  # none are shipped


def test_every_kind_of_touches_is_tested_above():
    assert {path.stem for path in CONF.glob("*.yaml")} == {"gestures", "fingertips"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"thresholds": {"area": 0.3, "are": 1}}, r"touch.thresholds has no setting are: did you mean area"),
        ({"small_area": [0.2, 0.4]}, r"touch.small_area=\[0.2, 0.4\] must lie between 0 and 0.3"),
        ({"press": [0.3, 2.0]}, r"press=\[0.3, 2.0\] s gives 3 to 20 frames at .*, valid are 4 to 30 \(0.4"),
        ({"tap": [0.1, 0.4]}, r"touch.tap=.* gives 1 to 4 frames .* valid are 1 to 3 \(0.1 to 0.3 s\)"),
        ({"tap": [0.1, 0.1]}, r"touch.tap=.* at most 1 frames .* lasts 2 \(0.2 s\): raise touch.tap"),
        ({"window": 0.04}, r"touch.window=0.04 s gives 0 frames at touch.rate=10 Hz, valid are at least 1"),
        ({"rate": 2.0}, r"touch.tap=\[0.1, 0.3\] s gives 0 to 1 frames at touch.rate=2 Hz"),
        ({"safe_peak": [0, 90e3]}, r"touch.safe_peak=.* must be greater than 0"),
        ({"dangerous_peak": [50e3, 180e3]}, r"touch.dangerous_peak"),
        ({"speed": [0.02, 0.003]}, r"touch.speed=.* must be a range"),
        ({"path": 0.05}, r"touch.path=0.05 m at the highest touch.speed lasts 4 \(0.4 s\): raise touch.tap"),
    ],
)
def test_settings_that_no_gesture_can_meet_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        GestureSettings.of(given)


def test_durations_are_whole_frames_of_the_model():
    frames = GestureSettings().frames
    assert frames == (30, (1, 3), (4, 20), (0.003, 0.020), (10, 60), (15, 45), 3, 2)
    faster = GestureSettings(rate=25.0).frames
    found = faster.window, faster.tap, faster.press, faster.duration, faster.slide
    assert found == (75, (2, 8), (10, 50), 8, 3)
    assert faster.speed == pytest.approx((0.0012, 0.008))


@pytest.mark.parametrize(
    ("given", "expected"),
    [(None, (30, 10)), ({"rate": 50, "press": [9, 1]}, (150, 50)), (GestureSettings(window=2.0), (20, 10))],
)
def test_the_window_of_a_model(given, expected):
    assert model_window(given) == expected


def test_a_window_that_no_model_has_is_refused():
    with pytest.raises(InputError, match=r"touch.window=0.01 s is no frame at .* raise it to 0.1 or more"):
        model_window({"window": 0.01})


def test_heading_is_where_each_step_led():
    """A straight path, one that a wall turns within a step, one of a single frame, one that stands still."""
    straight = np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]])
    turned = np.array([[8.0, 1.0], [9.0, 2.0], [9.4, 3.0], [8.4, 4.0]])
    way = np.concatenate([straight, turned, [[5.0, 5.0]], [[2.0, 2.0], [2.0, 2.0]]])
    half = np.sqrt(0.5)
    corner = np.array([0.4, 1.0]) / np.hypot(0.4, 1.0)
    expected = [[0.6, 0.8]] * 3 + [[half, half], [half, half], corner, [-half, half]] + [[0, 0]] * 3
    np.testing.assert_allclose(heading(way, np.array([0, 3, 7, 8])), expected, atol=1e-12)


def test_paths():
    settings = GestureSettings()
    shapes = Shapes(settings.shapes, BODY)
    generator = np.random.default_rng(0)
    labels = generator.random((4000, 4)) < 0.5
    gestures = draw_bodies(labels[:, 0], settings, shapes, generator)
    gestures |= draw_times(labels, settings, True, generator)
    paths = draw_paths(labels, gestures, settings, BODY.size, generator.random((4000, 5)))
    dynamic, dangerous = labels[:, 1], labels[:, 3]
    speed, way = paths["speed"], paths["speed"] * (gestures["duration"] - 1)
    assert (speed[~dynamic] == 0).all()
    assert speed[dynamic].min() >= 0.003
    assert speed.max() <= 0.020
    assert way[dynamic].min() >= 0.010 - 1e-12
    peak = paths["peak"]
    assert 10e3 <= peak[~dangerous].min() < peak[~dangerous].max() <= 90.5e3
    assert 90.5e3 <= peak[dangerous].min() < peak[dangerous].max() <= 180e3


LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
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
    footprints = BODY.footprints(Grid().sensors(BODY))
    source = TouchSampler(BODY, footprints, Prescribed(), GestureSettings(shapes=("bar",), spare=0.1))
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
