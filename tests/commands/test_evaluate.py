"""Evaluating a run again gives what its training found."""

import re
from dataclasses import replace

import pytest

from skin.device.files import read_recording, write_recording
from skin.touch.labels import Task
from tests.commands.conftest import query

SMALL = ["data.gestures=160", "device.test_gestures=96", "evaluation.devices=1", "evaluation.layouts=1"]
SMALL += ["evaluation.safe_gestures=64"]


def metrics(folder):
    runs = query(folder, "select run_uuid from runs where status='FINISHED' order by start_time")
    ask = "select key, value from latest_metrics where run_uuid=? and key like '%/accuracy'"
    return [dict(query(folder, ask, one)) for one in runs]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """A folder with one finished run of the quickest row that has weights."""
    folder = tmp_path_factory.mktemp("runs")
    run(folder, "train.py", "experiment=temporal_graph", "trainer.max_epochs=1", *SMALL)
    return folder


@pytest.mark.slow("trains and evaluates a run")
def test_the_same_device_gives_the_same_figures(run, folder):
    done = run(folder, "evaluate.py")
    trained, evaluated = metrics(folder)[0], metrics(folder)[-1]
    assert len(trained) == 20
    assert evaluated == pytest.approx(trained, abs=1e-6)
    assert f"{100 * trained['same/overall/accuracy']:.1f}" in done.stdout
    (page,) = (folder / "results").glob("evaluation_*.md")
    assert ", evaluated with the settings of the run, 96 gestures." in page.read_text()


@pytest.mark.slow("trains and evaluates a run")
def test_touches_without_labels_get_verdicts(run, folder, tmp_path):
    run(tmp_path, "generate", "simulator=naive", "n=12", "out=x.parquet", store=False)
    known = read_recording(tmp_path / "x.parquet")
    bare = replace(known, touches=replace(known.touches, labels=None))
    path = write_recording(bare, tmp_path / "y.parquet")
    run(folder, "evaluate", "device=recording", f"device.path={path}", "device.test=all")
    (written,) = (folder / "results").glob("evaluation_recording_*.csv")
    assert len(written.read_text().splitlines()) == 1 + 12


TRAINED = [
    "experiment=any_skin", "simulator=solid", "device.count=3", "device.test_skins=2",
    "device.skins.length=[0.08,0.12]", "device.skins.cell=0.01", "device.skins.sensors=[4,16]",
    "device.skins.divisions=1", "data.gestures=300", "device.test_gestures=64", "trainer.max_epochs=1",
]  # fmt: skip
NINE = "x_m,y_m\n" + "".join(f"{x / 100},{y / 100}\n" for y in (3, 8, 13) for x in (2, 7, 14))
OWN = ["simulator=solid", "simulator.divisions=1", "layout=file", "layout.path=nine.csv"]


@pytest.fixture(scope="module")
def drawn(run, tmp_path_factory):
    drawn = tmp_path_factory.mktemp("any")
    (drawn / "nine.csv").write_text(NINE)
    run(drawn, "train", *TRAINED)
    return drawn


@pytest.mark.slow("trains and evaluates a run")
def test_it_is_evaluated_on_a_layout_from_a_file_and_says_what_is_new_to_it(run, drawn):
    done = run(drawn, "evaluate", "device=simulated", "device.test_gestures=200", *OWN)
    assert "200 gestures" in next(drawn.glob("results/evaluation_simulated_*.md")).read_text()
    assert re.search(r"longer side 0\.16 m \(0\.08 to 0\.12 m\)", " ".join(done.stderr.split()))


@pytest.mark.slow("trains and evaluates a run")
def test_a_recording_with_one_of_the_labels_is_judged_by_it(run, drawn):
    done = run(drawn, "generate", "n=40", "out=four.parquet", *OWN, store=False)
    four = read_recording(drawn / "four.parquet")
    labels = four.touches.labels[:, 2:3]
    some = replace(four, task=Task(("press",)), touches=replace(four.touches, labels=labels))
    write_recording(some, drawn / "some.parquet")
    done = run(drawn, "evaluate", "device=recording", "device.path=some.parquet", "device.test=all", *OWN)
    assert "press/accuracy" in done.stdout
    assert "big/accuracy" not in done.stdout
    assert "labels: the touches of the test tell nothing of big, dynamic, dangerous" in done.stdout


@pytest.mark.slow("trains and exports a run")
def test_it_is_exported_for_a_layout_from_a_file(run, drawn):
    onnxruntime = pytest.importorskip("onnxruntime")
    run(drawn, "export", "out=nine.onnx", "export.touches=100", *OWN)
    model = onnxruntime.InferenceSession(drawn / "nine.onnx")
    shapes = {one.name: one.shape[1:] for one in [*model.get_inputs(), *model.get_outputs()]}
    assert shapes == {"readings": [30, 9], "valid": [30, 9], "probabilities": [4]}


@pytest.mark.slow("trains and adapts a run")
def test_it_is_adapted_to_a_skin_that_must_be_named(run, drawn):
    quick = ["adapt.gestures=8", "adapt.layers=[head]", "adapt.lr=[0.001]", "adapt.epochs=2"]
    quick += ["evaluation.safe_gestures=64"]
    done = run(drawn, "adapt", *OWN, *quick, code=2)
    assert "is adapted to gestures of one skin: add device=recording" in done.stderr
    run(drawn, "generate", "n=40", "out=forty.parquet", *OWN, store=False)
    run(drawn, "adapt", "device=recording", "device.path=forty.parquet", *OWN, *quick)
    found = metrics(drawn)[-1]
    assert 0 < found["before/overall/accuracy"] <= 1
    assert 0 < found["same/overall/accuracy"] <= 1
