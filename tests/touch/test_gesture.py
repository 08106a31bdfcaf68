"""What gestures are drawn from."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.touch.fingertips import FingertipSettings, read_touch
from skin.touch.gestures import GestureSettings, draw_bodies, draw_paths
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
        ({"shape": ["disc"]}, r"touch has no setting shape: did you mean shapes"),
        ({"thresholds": {"area": 0.3, "are": 1}}, r"touch.thresholds has no setting are: did you mean area"),
        ({"shapes": []}, r"touch.shapes=.* has too few entries"),
        ({"shapes": "disc"}, r"touch.shapes=disc must be a list"),
        ({"small_area": [0.2, 0.4]}, r"touch.small_area=\[0.2, 0.4\] must lie between 0 and 0.3"),
        (
            {"press": [0.3, 2.0]},
            r"press=\[0.3, 2.0\] s gives 3 to 20 frames at .*, valid are 4 to 30 \(0.4 to",
        ),
        ({"tap": [0.1, 0.4]}, r"touch.tap=.* gives 1 to 4 frames .* valid are 1 to 3 \(0.1 to 0.3 s\)"),
        ({"tap": [0.1, 0.1]}, r"touch.tap=.* at most 1 frames .* lasts 2 \(0.2 s\): raise touch.tap"),
        ({"tap": [0, 0.3]}, r"touch.tap=.* must be greater than 0: as in touch.tap=\[0.1,0.3\]"),
        ({"window": 0.04}, r"touch.window=0.04 s gives 0 frames at touch.rate=10 Hz, valid are at least 1"),
        ({"rate": 2.0}, r"touch.tap=\[0.1, 0.3\] s gives 0 to 1 frames at touch.rate=2 Hz"),
        ({"rate": 0}, r"touch.rate=0 must be greater than 0: as in touch.rate=10.0"),
        ({"safe_peak": [0, 90e3]}, r"touch.safe_peak=.* must be greater than 0"),
        ({"safe_peak": [float("nan"), 90e3]}, r"touch.safe_peak"),
        ({"dangerous_peak": [50e3, 180e3]}, r"touch.dangerous_peak"),
        ({"speed": [0.02, 0.003]}, r"touch.speed=.* must be a range"),
        ({"path": 0.05}, r"touch.path=0.05 m at the highest touch.speed lasts 4 \(0.4 s\): raise touch.tap"),
        ({"shear": -0.1}, r"touch.shear=-0.1 must be"),
        ({"redraws": 0}, r"touch.redraws=0 must be greater than 0: as in touch.redraws=30"),
        ({"stretch": 0.5}, r"touch.stretch=0.5 must be greater than or equal to 1"),
        ({"leak": 0.3}, r"touch.leak=0.3 must be greater than or equal to 0.5"),
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
    [
        (None, (30, 10.0)),
        ({"rate": 50, "press": [9, 1]}, (150, 50.0)),
        (GestureSettings(window=2.0), (20, 10.0)),
    ],
)
def test_the_window_of_a_model(given, expected):
    assert model_window(given) == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"window": 0.01}, r"touch.window=0.01 s is no frame at touch.rate=10 Hz: raise it to 0.1 or more"),
        ({"rate": "fast"}, r"touch.rate=fast must be"),
    ],
)
def test_a_window_that_no_model_has_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        model_window(given)


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
