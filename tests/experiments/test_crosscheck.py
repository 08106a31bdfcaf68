"""The cross-check of mechanics, through the command line."""

import csv

import pytest

SMALL = [
    *("body.cells=[8,8]", "layout=grid", "layout.rows=3", "layout.columns=3", "touch.redraws=100"),
    *(
        "touch.small_area=[0.1,0.3]",
        "data.gestures=200",
        "device.test_gestures=100",
        "evaluation.safe_gestures=64",
    ),
]


@pytest.mark.slow
def test_every_simulator_against_every_other(run, tmp_path):
    done = run(tmp_path, "crosscheck.py", "rules", *SMALL, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    lines = list(csv.DictReader((tmp_path / "crosscheck.csv").read_text().splitlines()))
    names = ["naive", "fem, equation 10", "fem, interface", "solid"]
    assert [(line["trained"], line["tested"]) for line in lines] == [(a, b) for a in names for b in names]
    assert all(0.4 < float(line["overall"]) <= 1 for line in lines)
    own = {line["trained"]: line for line in lines if line["trained"] == line["tested"]}
    assert len({line["overall"] for line in own.values()}) > 1


@pytest.mark.slow
def test_a_mistyped_row_is_refused(run, tmp_path):
    done = run(tmp_path, "crosscheck.py", "featurs")
    assert done.returncode == 2
    assert "featurs" in done.stderr
    assert "Traceback" not in done.stderr
