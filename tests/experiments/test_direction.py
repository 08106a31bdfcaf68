"""The command on the direction of sliding, from its door to its files."""

import csv
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a", f"out={folder}"]
    return subprocess.run(
        [sys.executable, ROOT / "experiments" / "direction.py", *overrides, *own],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.mark.slow
def test_it_trains_every_skin_once(tmp_path):
    few = ["direction.seeds=[0]", "direction.rows=[features]", "body.cells=[8,8]", "simulator.divisions=1"]
    small = ["data.gestures=120", "device.test_gestures=64"]
    done = run(tmp_path, *few, *small)
    assert done.returncode == 0, done.stderr
    lines = list(csv.DictReader((tmp_path / "direction.csv").read_text().splitlines()))
    assert [line["skin"] for line in lines] == ["upright", "upright_shear", "tilted_shear"]
    assert all(0 < float(line["degrees"]) < 180 for line in lines)
    with closing(sqlite3.connect(tmp_path / "m.db")) as store:
        hashes = store.execute("select distinct value from tags where key = 'data_hash'").fetchall()
    assert len(hashes) == 3  # three skins felt the same touches
    assert {line["verdict"] for line in lines[1:]} == {"undecided"}
    again = run(tmp_path, *few, *small)
    assert again.returncode == 0
    assert "training" not in again.stderr


def test_bad_input_is_one_sentence(tmp_path):
    done = run(tmp_path, "direction.shear=0")
    assert done.returncode == 2
    assert done.stderr == "direction.shear must be above 0, got 0: as in direction.shear=0.5\n"
    assert not list(tmp_path.glob("direction*"))
