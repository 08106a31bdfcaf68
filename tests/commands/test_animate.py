"""`skin animate` as a person runs it."""

import pytest
from PIL import Image

from skin.device.files import write_recording
from skin.runs.build import build_device

NAIVE = ("animate", "simulator=naive")


@pytest.mark.slow("draws every frame of two touches")
def test_a_drawn_touch_and_a_recorded_one(run, tmp_path, configured):
    done = run(tmp_path, *NAIVE, "out=hand.gif", "labels=[big,dynamic]", "shape=hand", "seed=3", store=False)
    assert done.stdout == "hand.gif: hand: big, dynamic, 30 frames at 10 Hz\n"
    device = build_device(configured("simulator=naive", "data.gestures=16"))
    write_recording(device.recording(), tmp_path / "x.parquet")
    recording = ["device=recording", "device.path=x.parquet", "index=5", "out=five.gif"]
    done = run(tmp_path, *NAIVE, *recording, store=False)
    assert done.stdout.startswith("five.gif: touch 5: ")
    for name in ("hand.gif", "five.gif"):
        assert (tmp_path / name).stat().st_size < 1e6
        with Image.open(tmp_path / name) as file:
            assert file.n_frames == 30
    assert sorted(path.name for path in tmp_path.glob("*.gif")) == ["five.gif", "hand.gif"]


def test_fingertips_are_shown_without_asking_for_labels(run, tmp_path):
    done = run(tmp_path, *NAIVE, "touch=fingertips", "out=tips.png", store=False)
    assert done.stdout == "tips.png: disc: dynamic, press, 30 frames at 10 Hz\n"
