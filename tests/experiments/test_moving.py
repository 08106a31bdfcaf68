"""The command on moving and misplaced sensors, from its door to its files."""

import csv
import sqlite3

import pytest

from skin.config import Tracking
from skin.errors import InputError
from skin.tracking import Store
from studies.moving_runs import latest

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = [
    "data.gestures=80",
    "trainer.max_epochs=1",
    "device.test_gestures=48",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
    "evaluation.gestures=48",
]


def runs(folder):
    with sqlite3.connect(folder / "m.db") as database:
        names = database.execute("select name, status from runs order by start_time").fetchall()
    database.close()
    return names


@pytest.mark.slow
def test_finished_runs_are_tried_and_lines_are_trained_once(run, tmp_path):
    done = run(tmp_path, "train.py", "experiment=temporal_graph", *SMALL)
    assert done.returncode == 0, done.stderr
    asked = ["n=60", "out=found", "moving.devices=2", "moving.gestures=32", "moving.train=true"]
    asked += ["moving.errors=[0.0,0.005]", "moving.seeds=[0]", *SMALL]
    done = run(tmp_path, "moving.py", *asked)
    assert done.returncode == 0, done.stderr
    assert "below 1 %, no effect possible" in done.stdout
    with (tmp_path / "found" / "moving.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    conditions = ["0 mm", "5 mm", "modulus ± 20%", "layout", "oracle", "estimated"]
    assert [line["condition"] for line in lines] == conditions
    assert [line["row"] for line in lines] == ["temporal_graph"] * 3 + ["moving_*"] * 3
    assert all(25 < float(line["accuracy"].split()[0]) < 90 for line in lines)
    assert all(line["verdict"] in ("", "undecided") for line in lines)
    before = runs(tmp_path)
    assert len(before) == 6  # a training, its trial, a parent and three lines
    assert {status for _, status in before} == {"FINISHED"}
    written = (tmp_path / "found" / "moving.csv").read_text()
    done = run(tmp_path, "moving.py", *asked)
    assert done.returncode == 0, done.stderr
    assert runs(tmp_path) == before
    assert (tmp_path / "found" / "moving.csv").read_text() == written

    # Runs of this study are no rows to be tried, and a row that never ran is named.
    store = Store.open(Tracking(f"sqlite:///{tmp_path}/m.db", str(tmp_path / "a"), "skin", True, None))
    assert [one.data.tags["row"] for one in latest(store, "fem", "all")] == ["temporal_graph"]
    with pytest.raises(InputError, match=r"experiment=features simulator=fem makes one"):
        latest(store, "fem", ["features"])


@pytest.mark.slow
def test_a_skin_without_motion_is_refused_in_one_sentence(run, tmp_path):
    done = run(tmp_path, "moving.py", f"out={tmp_path}/found", "simulator=naive")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "set simulator=fem simulator.constraint=free" in done.stderr
    assert not (tmp_path / "found").exists()
