"""The command that sorts verdicts by their distance from a threshold."""

import csv

import pytest
from PIL import Image

SMALL = ["layout=grid", "simulator=naive", "data.gestures=200", "device.test_gestures=64"]
SMALL += ["evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=64"]
WAYS = ("threshold", "reading")


@pytest.mark.slow
def test_a_finished_run_is_sorted_by_margins(run, tmp_path):
    done = run(tmp_path, "train.py", "experiment=rules", *SMALL)
    assert done.returncode == 0, done.stderr
    done = run(tmp_path, "margins.py", "run=latest", "gestures=400", "out=found")
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert said[0].startswith("within 10 % of their thresholds lie ")
    with next((tmp_path / "found").glob("margins_rules_*.csv")).open(newline="") as file:
        lines = list(csv.DictReader(file))
    ways = {way: [one for one in lines if (one["label"], one["by"]) == ("big", way)] for way in WAYS}
    assert [sum(int(one["touches"]) for one in each) for each in ways.values()] == [400, 400]
    wrong, also = (sum(int(one["wrong"]) for one in each) for each in ways.values())
    assert wrong == also > 0
    assert f"of {wrong} errors of big" in said[0]
    text = next((tmp_path / "found").glob("margins_rules_*.md")).read_text()
    assert "## Alarm above 0." in text
    assert "chosen on 64 fresh safe gestures for 2 % false alarms, finds " in said[0]
    with Image.open(next((tmp_path / "found").glob("margins_rules_*.png"))) as picture:
        assert picture.size[0] > 800
    few = ["device.test_gestures=32", "evaluation.devices=0", "evaluation.layouts=0", "out=found"]
    for _ in range(2):
        done = run(tmp_path, "evaluate.py", *few)
        assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "found").glob("evaluation_simulated_*.md"))) == 2
    done = run(tmp_path, "margins.py", "run=latest", "gestures=0")
    assert done.returncode == 2
    assert "margins need touches, got gestures=0" in done.stderr
