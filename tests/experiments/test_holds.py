"""The command that times the alarm of held touches."""

import csv

import pytest

SMALL = ["layout=grid", "simulator=naive", "data.gestures=400", "device.test_gestures=64"]
SMALL += ["evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=200"]


@pytest.mark.slow
def test_every_course_is_played_and_no_alarm_ends_early(run, tmp_path):
    done = run(tmp_path, "train.py", "experiment=rules", *SMALL)
    assert done.returncode == 0, done.stderr
    done = run(tmp_path, "holds.py", "run=latest", "holds.gestures=2", "holds.rate=10", "out=found")
    assert done.returncode == 0, done.stderr
    with next((tmp_path / "found").glob("holds_rules_*.csv")).open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 9
    assert {one["course"] for one in lines} >= {"tap", "press", "hold 600 s", "ramp 10 s"}
    assert all(one["kept"] == one["touches"] for one in lines)
    assert sum(int(one["alarms"]) for one in lines) > 0
    assert f"course {lines[0]['course']}, touches 2" in done.stdout
