"""What a prompted gesture needs to be recorded: that the skin has felt something."""

import os
from time import sleep

import numpy as np
import pytest

from skin import Grid, read_recording
from skin.device.resampling import Frame
from skin.record.serial import Serial, convert_session, record_session
from skin.record.session import read_session
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import label_plan
from tests.made_up import SHEET, naive_skin

IDLE = 12.0  # s, of which the first is the tare
NOISE = 0.03  # N, with rounding a little more
LEAST = 0.09  # N: five times that, less what the largest value of an interval has anyway


@pytest.fixture
def recorded(emulate, tmp_path, monkeypatch, capfd):
    """Return a function that records an emulated skin and gives the session, and what was said.

    Nothing touches the skin for some seconds, and then fingertips do. Enter is pressed at every prompt.
    """

    def record(count, stream=False, dead=()):
        tips = {"window": 1.0, "press": [0.8, 0.95], "radius": [0.006, 0.012]}
        device = naive_skin(touch=tips, noise=NOISE)
        emulator = emulate(device, count=40, rate=100.0, speed=5.0, idle=IDLE, gap=0.1, dead=dead)
        there = {"port": emulator.port.address, "scale": emulator.converter.scale, "timeout": 20.0}
        asked = {"labels": "prompted", "gestures": count, "stream": stream, "tare": 1.0}
        reader = Serial(body=SHEET, layout=device.layout, touch={"window": 1.0}, **there, **asked)
        typed, keyboard = os.pipe()
        os.write(keyboard, b"\n" * 60)
        with os.fdopen(typed) as lines:
            monkeypatch.setattr("sys.stdin", lines)
            record_session(reader, tmp_path / "s", None, False, lambda text: None)
            os.close(keyboard)
        recording = read_recording(convert_session(reader, tmp_path / "s")[0])
        return recording.touches, capfd.readouterr().err.splitlines()

    return record


def refused(said):
    """Return the prompts for what was not felt; the same prompt follows each."""
    prompts = [line for line in said if line.startswith(("next: ", "no touch was detected"))]
    positions = [position for position, line in enumerate(prompts) if line.startswith("no touch was")]
    assert all(prompts[position - 1] == prompts[position + 1] for position in positions)
    return [prompts[position - 1] for position in positions]


def test_a_gesture_that_nobody_made_is_asked_for_again(recorded, tmp_path):
    touches, said = recorded(3)
    assert touches.readings.amax(dim=(1, 2)).min() > LEAST
    assert touches.labels.int().tolist() == [list(one.values()) for one in label_plan(TOUCH.names, 1, 0)][:3]
    assert refused(said)
    assert sorted(read_session(tmp_path / "s").gestures) == [0, 1, 2]


def test_frames_between_two_gestures_are_kept_however_many(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("skin.record.serial._MOST", 50)
    recorded(2)
    tables = read_session(tmp_path / "s").tables
    rows = sorted((row for table in tables for row in table.to_pylist()), key=lambda row: row["time"])
    assert len(tables) > 3
    assert [row["seq"] for row in rows] == list(range(rows[0]["seq"], rows[0]["seq"] + len(rows)))
    assert [sum(row["gesture"] == number for row in rows) for number in (0, 1)] == [100, 100]


def test_a_prompt_for_no_touch_needs_none(recorded):
    plan = [list(one.values()) for one in label_plan(TOUCH_OR_NOT.names, 1, 0)]
    touches, said = recorded(16, stream=True)
    assert touches.labels.int().tolist() == plan[:16]
    felt = touches.readings.amax(dim=(1, 2)) > LEAST
    wanted = touches.labels[:, TOUCH_OR_NOT.names.index("touch")] == 1
    assert felt[wanted].all()
    assert not felt[0]  # before the first touch
    assert not any("not touch" in prompt for prompt in refused(said))


def test_dead_sensors_feel_nothing_and_the_others_do(recorded):
    touches, said = recorded(2, dead=[0, 1, 2, 3])
    assert touches.readings[:, :, 4:].amax(dim=(1, 2)).min() > LEAST
    assert refused(said)


@pytest.mark.parametrize(("change", "felt"), [(0, False), (1, False), (2, True)])
def test_a_count_more_is_no_touch_for_a_skin_without_noise(change, felt, monkeypatch, tmp_path):
    """Its channels are still during the tare, and one changes by a count afterwards."""
    (tmp_path / "typed").write_text("\n")
    reader = Serial(body=SHEET, layout=Grid(3, 3), port="/dev/null", labels="prompted", scale=0.04)
    still = np.zeros(9)
    conversion = UnitConversion(np.full(9, 0.04), np.full(9, 512.0), still > 0, noise=still, rest=still)
    rows = [np.full(9, 512.0) for _ in range(450)]
    rows[350][4] += change
    frames = [Frame(number, number / 100, 0.0, row, row > 0) for number, row in enumerate(rows)]
    with (tmp_path / "typed").open() as lines:
        monkeypatch.setattr("sys.stdin", lines)
        segmenter = reader.segmenter(None, conversion, frames[:100])
        while segmenter._typed.qsize() < 2:  # Enter, and the end
            sleep(0.01)
    assert any(segmenter.add(frame) for frame in frames[100:]) is felt
