"""A sweep counts its jobs as Hydra does, tells the time left, goes on after a failure, and resumes."""

import sqlite3
import subprocess
import sys

import pytest

from skin.config import ROOT
from skin.sweep import Progress, jobs

SMALL = [
    "experiment=rules",
    "simulator=naive",
    "data.gestures=64",
    "device.test_gestures=32",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
    "evaluation.gestures=32",
]


def test_jobs_come_in_hydras_order():
    found = jobs(["seed=0,1", "row=x"], {"simulator": "naive,fem"})
    assert [(job["simulator"], job["seed"], job["row"]) for job in found] == [
        ("naive", "0", "x"),
        ("naive", "1", "x"),
        ("fem", "0", "x"),
        ("fem", "1", "x"),
    ]


def test_the_command_line_wins_over_the_sweeps_file():
    found = jobs(["simulator=fem"], {"simulator": "naive,fem", "experiment": "rules,features"})
    assert [job["experiment"] for job in found] == ["rules", "features"]
    assert {job["simulator"] for job in found} == {"fem"}


def test_nothing_known_gives_no_estimate():
    assert Progress([None, None]).left() is None


def test_what_took_before_is_the_first_estimate():
    assert Progress([10.0, None, 20.0]).left() == 45  # the unknown one like the mean of the others


def test_the_rest_follows_the_speed_of_this_machine():
    progress = Progress([10.0, 10.0, 20.0])
    progress.finish(0, 30.0, skipped=False)
    assert progress.left() == 90


def test_a_skipped_job_says_nothing_about_speed():
    progress = Progress([10.0, 10.0, 20.0])
    progress.finish(0, 0.01, skipped=True)
    assert progress.left() == 30


def sweep(folder, *overrides):
    """Return the arguments of a sweep."""
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    return ["train.py", "-m", *SMALL, *own, *overrides, f"hydra.sweep.dir={folder}/out"]


def runs(folder):
    """Return (name, status, parent) of every run, oldest first."""
    with sqlite3.connect(folder / "m.db") as database:
        found = database.execute(
            "select name, status, (select value from tags where tags.run_uuid = runs.run_uuid "
            "and key = 'mlflow.parentRunId') from runs order by start_time"
        ).fetchall()
    database.close()
    return found


@pytest.mark.slow
def test_a_sweep_that_was_killed_goes_on_where_it_was(run, begin, tmp_path):
    with begin(tmp_path, *sweep(tmp_path, "seed=0,1,2")) as first:
        next(line for line in first.lines() if line.startswith("[2/3]"))
    assert [one[:2] for one in runs(tmp_path)][:2] == [
        ("sweep", "RUNNING"),
        ("rules naive seed 0", "FINISHED"),
    ]
    again = run(tmp_path, *sweep(tmp_path, "seed=0,1,2"), store=False)
    assert again.returncode == 0, again.stderr
    assert [line for line in again.stdout.splitlines() if "finished before" in line] == [
        line for line in again.stdout.splitlines() if line.startswith("[1/3]") and "…" not in line
    ]
    finished = [name for name, status, parent in runs(tmp_path) if status == "FINISHED" and parent]
    assert finished == ["rules naive seed 0", "rules naive seed 1", "rules naive seed 2"]


@pytest.mark.slow
def test_a_run_is_named_by_its_changes_and_logs_them_and_a_skipped_one_prints_its_scores(run, tmp_path):
    given = ["train", *SMALL, "device.offset=0.2", "layout=grid"]
    first = run(tmp_path, *given)
    assert first.returncode == 0, first.stderr
    with sqlite3.connect(tmp_path / "m.db") as database:
        (name,) = database.execute("select name from runs").fetchone()
        params = dict(database.execute("select key, value from params"))
    database.close()
    assert name.startswith("rules naive ")
    assert name.endswith(" offset=0.2 layout=grid seed 0")
    assert (params["device.offset"], params["layout"], params["seed"]) == ("0.2", "grid", "0")
    again = run(tmp_path, *given)
    assert again.returncode == 0, again.stderr
    assert "did this before" in again.stdout
    rows = [line for line in first.stdout.splitlines() if line.startswith("│")]
    assert rows == [line for line in again.stdout.splitlines() if line.startswith("│")]
    assert rows


@pytest.mark.slow
def test_a_bad_job_fails_and_the_others_run(run, tmp_path):
    done = run(tmp_path, *sweep(tmp_path, "device.offset=-1,0.1"), store=False)
    assert done.returncode == 1
    assert "offset" in done.stderr
    assert [one[:2] for one in runs(tmp_path) if one[2]] == [("rules naive offset=0.1 seed 0", "FINISHED")]
    assert [status for name, status, parent in runs(tmp_path) if not parent] == ["FAILED"]


def test_what_no_job_could_accept_is_refused_once():
    command = [sys.executable, str(ROOT / "experiments" / "train.py"), "-m", "+typo=1", "seed=0,1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert "typo" in done.stderr
    assert "Traceback" not in done.stderr
