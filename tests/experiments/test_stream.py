"""A network trained on windows of streams, and tried on a long one, from the command line."""

import csv
import sqlite3

import pytest

SMALL = [
    "data.gestures=200",
    "device.test_gestures=120",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
]
SHORT = ["rows=all", "simulator=naive", "stream.hours=0.02", "stream.gap=[20,60]"]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """A folder with one finished run of a network that learnt from windows."""
    folder = tmp_path_factory.mktemp("runs")
    row = ["experiment=temporal_graph", "simulator=naive", "trainer.max_epochs=1", "data.stream=true"]
    done = run(folder, "train.py", *row, "evaluation.gestures=96", *SMALL)
    assert done.returncode == 0, done.stderr
    assert "touch/accuracy" in done.stdout
    return folder


@pytest.mark.slow
def test_a_run_is_tried_once_and_then_brought_back(run, folder):
    done = run(folder, "stream.py", *SHORT, f"out={folder}/results")
    assert done.returncode == 0, done.stderr
    said = done.stdout
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
    again = run(folder, "stream.py", *SHORT, f"out={folder}/results")
    assert (again.returncode, again.stdout) == (0, said), again.stderr
    assert {path.name for path in (folder / "results").iterdir()} == set(files)
    with sqlite3.connect(folder / "m.db") as database:
        tried = database.execute("select count(*) from tags where key='outcome'").fetchone()
    database.close()
    assert tried == (1,)


@pytest.mark.slow
def test_bad_input_is_one_sentence(run, folder):
    done = run(folder, "stream.py", "stream.hours=0", "out=nowhere")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "stream.hours=0" in done.stderr
    assert not (folder / "nowhere").exists()
