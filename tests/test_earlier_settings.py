"""Runs whose gestures were given in frames are the same in seconds."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from skin.config import fingerprint, plain
from skin.earlier_settings import in_frames, in_seconds
from skin.touch.gesture import GestureSettings


def old(rate=10.0):
    config = plain(OmegaConf.load(Path(__file__).with_name("earlier_run.yaml")))
    config["device"]["rate"] = rate
    return config


def test_the_gestures_of_an_earlier_run_are_those_of_today():
    found = in_seconds(old())
    assert GestureSettings.of(found["touch"]) == GestureSettings()
    assert found["device"]["touch"] == found["touch"]
    assert in_seconds(found) == found
    assert {name: found[name] for name in found if name not in ("touch", "device")} == {
        name: value for name, value in old().items() if name not in ("touch", "device")
    }


@pytest.mark.parametrize("rate", [5.0, 10.0, 16.0, 30.0])
def test_the_rate_of_the_device_was_that_of_the_model(rate):
    found = in_seconds(old(rate))
    assert found["touch"]["rate"] == rate
    assert found["touch"]["window"] == pytest.approx(30 / rate)
    settings = GestureSettings.of(found["touch"]).frames
    assert (settings.window, settings.tap, settings.press, settings.duration) == (30, (1, 3), (4, 20), 3)
    assert settings.speed == pytest.approx((0.003, 0.02))
    assert in_frames(found) == old(rate)


def test_a_run_on_a_recording_had_the_default_rate():
    config = {"touch": {"window": 20}, "device": {"path": "x.parquet"}}
    assert in_seconds(config)["touch"] == {"window": 2.0, "rate": 10.0}
    assert in_frames(in_seconds(config)) == config


def test_another_rate_of_the_device_is_another_run(configured):
    assert in_frames({"touch": {"rate": 10.0, "window": 3.0}, "device": {"rate": 100.0}})["touch"] == {
        "rate": 10.0,
        "window": 3.0,
    }
    changes = [], ["device.rate=100"], ["device.rate=20", "touch.rate=20"]
    assert len({fingerprint(configured(*one)) for one in changes}) == 3


def test_what_rounds_to_the_same_frames_is_the_same_run(configured):
    assert fingerprint(configured("touch.window=3.04")) == fingerprint(configured())
    assert fingerprint(configured("touch.window=3.1")) != fingerprint(configured())
