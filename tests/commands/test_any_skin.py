"""A run of drawn skins is used on a skin of its own: simulated, recorded, and at a port."""

import re
from dataclasses import replace

import pytest

from skin.device.files import read_recording, write_recording
from skin.touch.labels import Task
from tests.commands.test_evaluate import metrics

TRAINED = [
    "experiment=any_skin", "simulator=solid", "device.count=3", "device.test_skins=2",
    "device.skins.length=[0.08,0.12]", "device.skins.cell=0.01", "device.skins.sensors=[4,16]",
    "device.skins.divisions=1", "data.gestures=300", "device.test_gestures=64", "trainer.max_epochs=1",
]  # fmt: skip
NINE = "x_m,y_m\n" + "".join(f"{x / 100},{y / 100}\n" for y in (3, 8, 13) for x in (2, 7, 14))
OWN = ["simulator=solid", "simulator.divisions=1", "layout=file", "layout.path=nine.csv"]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("any")
    (folder / "nine.csv").write_text(NINE)
    run(folder, "train", *TRAINED)
    return folder


@pytest.mark.slow("trains and evaluates a run")
def test_it_is_evaluated_on_a_layout_from_a_file_and_says_what_is_new_to_it(run, folder):
    done = run(folder, "evaluate", "device=simulated", "device.test_gestures=200", *OWN)
    assert "200 gestures" in next(folder.glob("results/evaluation_simulated_*.md")).read_text()
    assert re.search(r"longer side 0\.16 m \(0\.08 to 0\.12 m\)", " ".join(done.stderr.split()))


@pytest.mark.slow("trains and evaluates a run")
def test_a_recording_with_one_of_the_labels_is_judged_by_it(run, folder):
    done = run(folder, "generate", "n=40", "out=four.parquet", *OWN, store=False)
    four = read_recording(folder / "four.parquet")
    labels = four.touches.labels[:, 2:3]
    some = replace(four, task=Task(("press",)), touches=replace(four.touches, labels=labels))
    write_recording(some, folder / "some.parquet")
    done = run(folder, "evaluate", "device=recording", "device.path=some.parquet", "device.test=all", *OWN)
    assert "press/accuracy" in done.stdout
    assert "big/accuracy" not in done.stdout
    assert "labels: the touches of the test tell nothing of big, dynamic, dangerous" in done.stdout


@pytest.mark.slow("trains and exports a run")
def test_it_is_exported_for_a_layout_from_a_file(run, folder):
    onnxruntime = pytest.importorskip("onnxruntime")
    run(folder, "export", "out=nine.onnx", "export.touches=100", *OWN)
    model = onnxruntime.InferenceSession(folder / "nine.onnx")
    shapes = {one.name: one.shape[1:] for one in [*model.get_inputs(), *model.get_outputs()]}
    assert shapes == {"readings": [30, 9], "valid": [30, 9], "probabilities": [4]}


@pytest.mark.slow("trains and adapts a run")
def test_it_is_adapted_to_a_skin_that_must_be_named(run, folder):
    quick = ["adapt.gestures=8", "adapt.layers=[head]", "adapt.lr=[0.001]", "adapt.epochs=2"]
    quick += ["evaluation.safe_gestures=64"]
    done = run(folder, "adapt", *OWN, *quick, code=2)
    assert "is adapted to gestures of one skin: add device=recording" in done.stderr
    run(folder, "generate", "n=40", "out=forty.parquet", *OWN, store=False)
    run(folder, "adapt", "device=recording", "device.path=forty.parquet", *OWN, *quick)
    found = metrics(folder)[-1]
    assert 0 < found["before/overall/accuracy"] <= 1
    assert 0 < found["same/overall/accuracy"] <= 1
