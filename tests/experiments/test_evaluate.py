"""Evaluating a run again gives what its training found."""

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALL = [
    "data.gestures=160",
    "device.test_gestures=96",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.gestures=96",
]


def run(folder, script, *overrides):
    """Run a command with a store of its own and return its exit code and what it said."""
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    done = subprocess.run(
        [sys.executable, ROOT / "experiments" / script, *overrides, *own],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def metrics(folder):
    """Return the accuracies of every run, oldest first."""
    with sqlite3.connect(folder / "m.db") as database:
        runs = database.execute("select run_uuid from runs where status='FINISHED' order by start_time")
        found = [
            dict(database.execute("select key, value from latest_metrics where run_uuid=?", one))
            for one in runs.fetchall()
        ]
    database.close()
    return [{key: value for key, value in one.items() if key.endswith("/accuracy")} for one in found]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with one finished run of the quickest row that has weights."""
    folder = tmp_path_factory.mktemp("runs")
    code, _, said = run(folder, "train.py", "experiment=temporal_graph", "trainer.max_epochs=1", *SMALL)
    assert code == 0, said
    return folder


@pytest.mark.slow
def test_the_same_device_gives_the_same_figures(folder):
    code, said, errors = run(folder, "evaluate.py")
    assert code == 0, errors
    trained, evaluated = metrics(folder)[0], metrics(folder)[-1]
    assert len(trained) == 20
    assert evaluated == pytest.approx(trained, abs=1e-6)
    assert f"{100 * trained['same/overall/accuracy']:.1f}" in said


@pytest.mark.slow
def test_bad_input_is_one_sentence(folder):
    code, _, said = run(folder, "evaluate.py", "device=recording")
    assert (code, said.count("\n")) == (2, 1)
    assert "device.path=" in said
