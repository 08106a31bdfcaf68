"""The cross-check of mechanics, through the command line."""

import csv
import subprocess
import sys

import pytest

from skin.config import ROOT

SMALL = [
    *("body.cells=[8,8]", "layout=grid", "layout.rows=3", "layout.columns=3", "touch.redraws=100"),
    *("touch.small_area=[0.1,0.3]", "data.gestures=200", "device.test_gestures=100"),
]


def run(*arguments):
    command = [sys.executable, ROOT / "experiments" / "crosscheck.py", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


@pytest.mark.slow
def test_every_simulator_against_every_other(tmp_path):
    store = [f"tracking.uri=sqlite:///{tmp_path}/runs.db", f"tracking.artifacts={tmp_path}/artifacts"]
    done = run("rules", *SMALL, *store, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    lines = list(csv.DictReader((tmp_path / "crosscheck.csv").read_text().splitlines()))
    names = ["naive", "fem, equation 10", "fem, interface", "solid"]
    assert [(line["trained"], line["tested"]) for line in lines] == [(a, b) for a in names for b in names]
    assert all(0.4 < float(line["overall"]) <= 1 for line in lines)
    own = {line["trained"]: line for line in lines if line["trained"] == line["tested"]}
    assert len({line["overall"] for line in own.values()}) > 1


@pytest.mark.slow
def test_a_mistyped_row_is_refused():
    done = run("featurs")
    assert done.returncode == 2
    assert "featurs" in done.stderr
    assert "Traceback" not in done.stderr
