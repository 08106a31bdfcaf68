"""A network trained on windows of streams, and tried on a long one, from the command line."""

import csv
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALL = ["data.gestures=200", "device.test_gestures=120", "evaluation.devices=1", "evaluation.layouts=1"]
SHORT = ["rows=all", "simulator=naive", "stream.hours=0.02", "stream.gap=[20,60]", "out=results"]


def run(folder, script, *overrides):
    """Run a command with a store of its own and return its exit code and what it said."""
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    given = [one.replace("out=results", f"out={folder}/results") for one in overrides]
    done = subprocess.run(
        [sys.executable, ROOT / "experiments" / script, *given, *own],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with one finished run of a network that learnt from windows."""
    folder = tmp_path_factory.mktemp("runs")
    row = ["experiment=temporal_graph", "simulator=naive", "trainer.max_epochs=1", "data.stream=true"]
    code, said, errors = run(folder, "train.py", *row, "evaluation.gestures=96", *SMALL)
    assert code == 0, errors
    assert "touch/accuracy" in said
    return folder


@pytest.mark.slow
def test_a_run_is_tried_once_and_then_brought_back(folder):
    code, said, errors = run(folder, "stream.py", *SHORT)
    assert code == 0, errors
    files = {path.name: path for path in (folder / "results").iterdir()}
    name = "stream_temporal_graph_streams"
    assert set(files) == {f"{name}.md", f"{name}.csv", f"{name}.png"}
    assert "false alarms per hour" in said
    assert "cannot (fusion=early is made for windows of 30 frames, got 60" in said
    with files[f"{name}.csv"].open(newline="") as file:
        lines = list(csv.DictReader(file))
    windows = sum(int(line["value"]) for line in lines if line["measure"] == "windows")
    told = sum(
        int(line["value"]) for line in lines if "said" in line["measure"] and line["name"] == "learned"
    )
    assert 0 < windows < told == 120

    for path in files.values():
        path.unlink()
    code, again, errors = run(folder, "stream.py", *SHORT)
    assert (code, again) == (0, said), errors
    assert {path.name for path in (folder / "results").iterdir()} == set(files)
    with sqlite3.connect(folder / "m.db") as database:
        tried = database.execute("select count(*) from tags where key='outcome'").fetchone()
    database.close()
    assert tried == (1,)


@pytest.mark.slow
def test_bad_input_is_one_sentence(folder):
    code, _, said = run(folder, "stream.py", "stream.hours=0", "out=nowhere")
    assert (code, said.count("\n")) == (2, 1)
    assert "stream.hours=0" in said
    assert not (folder / "nowhere").exists()
