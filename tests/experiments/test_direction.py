"""The command on the direction of sliding, from its door to its files."""

import csv
import sqlite3
from contextlib import closing

import pytest


@pytest.mark.slow
def test_it_trains_every_skin_once(run, tmp_path):
    few = ["direction.seeds=[0]", "direction.rows=[features]", "body.cells=[8,8]", "simulator.divisions=1"]
    small = ["data.gestures=120", "device.test_gestures=64", "evaluation.safe_gestures=64", f"out={tmp_path}"]
    done = run(tmp_path, "direction.py", *few, *small)
    assert done.returncode == 0, done.stderr
    lines = list(csv.DictReader((tmp_path / "direction.csv").read_text().splitlines()))
    assert [line["skin"] for line in lines] == ["upright", "upright_shear", "tilted_shear"]
    assert all(0 < float(line["degrees"]) < 180 for line in lines)
    with closing(sqlite3.connect(tmp_path / "m.db")) as store:
        hashes = store.execute("select distinct value from tags where key = 'data_hash'").fetchall()
    assert len(hashes) == 3  # three skins felt the same touches
    assert {line["verdict"] for line in lines[1:]} == {"undecided"}
    again = run(tmp_path, "direction.py", *few, *small)
    assert again.returncode == 0
    assert "training" not in again.stderr


def test_bad_input_is_one_sentence(run, tmp_path):
    done = run(tmp_path, "direction.py", "direction.shear=0", f"out={tmp_path}")
    assert done.returncode == 2
    assert done.stderr == "direction.shear must be above 0, got 0: as in direction.shear=0.5\n"
    assert not list(tmp_path.glob("direction*"))
