"""`skin convert` as a person runs it, and a training on what it wrote."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
import yaml

from skin.device.conversion import summarise_conversion
from skin.device.files import read_recording
from tests.budget import free
from tests.commands.conftest import query

MAPPING = {
    "files": "*/*.csv",
    "table": {"na_values": ["-1.000"]},
    "fields": "(?P<person>[^/]+)/(?P<gesture>[a-z]+)",
    "time": {"column": "time", "unit": "ms"},
    "channels": {"columns": "s*", "unit": "N"},
    "segments": {"by": "file", "frames": 12},
    "labels": {
        "press": {"column": "gesture", "values": {"press": 1, "tap": 0}},
        "dangerous": {"target": "force", "above": 5.0},
    },
    "targets": {"force": {"column": "gauge", "unit": "N"}},
    "groups": ["person"],
}
TREES = ["experiment=features", "learner.rounds=5"]
NETWORK = ["representation=readings", "model=mlp", "trainer.max_epochs=2"]


def write(folder, persons=6, touches=24, **mapping):
    """Write touches of persons: a press lasts longer; who pats has neither label of press."""
    random = np.random.default_rng(0)
    for person, number in product(range(persons), range(touches)):
        gesture = ("press", "tap", "pat")[number % 3]
        force = np.zeros(12)
        force[2 : 10 if gesture == "press" else 4] = random.uniform(1, 10)
        readings = force[:, None] * [1, 0.5, 0.1] + random.normal(0, 0.02, (12, 3))
        gauge = force if number % 4 else np.full(12, -1.0)
        (folder / f"p{person}").mkdir(exist_ok=True)
        path = folder / f"p{person}" / f"{gesture}_{number:02d}.csv"
        rows = np.c_[100 * np.arange(12), readings, gauge]
        np.savetxt(path, rows, "%.3f", ",", header="time,s0,s1,s2,gauge", comments="")
    (folder / "map.yaml").write_text(yaml.safe_dump(MAPPING | mapping, sort_keys=False))


@pytest.fixture(scope="module")
def converted(run, tmp_path_factory):
    """Return a function that converts touches once, with classes or without, and returns the file."""
    known = {}

    def convert(**more):
        if (key := tuple(more)) not in known:
            with free():
                folder = tmp_path_factory.mktemp("converted")
                write(folder, **more)
                done = run(folder, "convert", "from=map.yaml", "out=x.parquet", store=False)
                known[key] = folder / "x.parquet", done.stdout
        return known[key]

    return convert


@pytest.mark.parametrize("settings", [TREES, NETWORK], ids=["trees", "network"])
def test_a_folder_is_converted_and_trained_on_by_person(run, converted, tmp_path, settings):
    path, said = converted()
    assert said.startswith("x.parquet: 144 touches of 12 frames at 10 Hz, 3 readings, press in 48 of 96, ")
    assert said.endswith("6 of person, positions unknown\n")
    recording = read_recording(path)
    many = replace(recording, parameters={f"p{number}": torch.zeros(144) for number in range(30)})
    assert ", 30 parameters, as p0, p1, p2, " in summarise_conversion(many)
    assert recording.touches.labels[:, 0].isnan().sum() == 48
    assert recording.touches.labels[:, 1].isnan().sum() == 36
    train = ["device=recording", f"device.path={path}", "device.test_groups=[p1]", *settings]
    done = run(tmp_path, "train", *train)
    assert "split: by person: 4 to train (1 for validation), 1 to test (p1)\n" in done.stdout
    ((split,),) = query(tmp_path, "select value from tags where key = 'split'")
    losses = query(tmp_path, "select is_nan from latest_metrics where key = 'val_loss'")
    assert split.startswith("by person: ")
    assert losses == [(0,)] * (settings is NETWORK)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["from=map.yaml", "path=nowhere"], "nowhere has no file */*.csv"),
        (["reader=skin.device.conversion.epi"], "reader=skin.device.conversion.epi needs path="),
        (["reader=os.getcwd", "path=.", "options={a: 1}"], "options has no setting a"),
    ],
)
def test_what_cannot_be_converted_is_refused(run, tmp_path, words, message):
    write(tmp_path, persons=1, touches=3)
    done = run(tmp_path, "convert", *words, "out=x.csv", store=False, code=2)
    assert message in done.stderr
    assert not list(tmp_path.glob("x.*"))


@pytest.mark.parametrize(
    ("task", "figure", "settings"),
    [("classes", "overall/accuracy", NETWORK), ("regression", "force/rms_N", TREES)],
)
def test_classes_and_targets_are_learned_instead_of_labels(run, converted, tmp_path, task, figure, settings):
    path, said = converted(classes={"column": "gesture"})
    assert "classes pat, press, tap" in said
    words = ["device=recording", f"device.path={path}", f"task={task}", *settings]
    done = run(tmp_path, "train", *words)
    assert figure in done.stdout
    assert "press/accuracy" not in done.stdout
    if settings is TREES:
        done = run(tmp_path, "evaluate", "run=latest")
        assert figure in done.stdout


@pytest.fixture(scope="module")
def two(run, tmp_path_factory):
    """Return a recording of two persons, of whom only the second one presses."""
    folder = tmp_path_factory.mktemp("two")
    write(folder, persons=2, touches=12)
    for path in (folder / "p0").glob("press*"):
        path.unlink()
    run(folder, "convert", "from=map.yaml", "out=x.parquet", store=False)
    groups = read_recording(folder / "x.parquet").metadata["groups"]
    assert groups == {"person": ["p0", "p1"]}
    return f"device.path={folder}/x.parquet"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["task=classes"], "x.parquet has no classes: give task=labels or task=regression"),
        (["task=regression", "device.targets=[x]"], "x.parquet has no target x, it has force"),
        (["device.targets=[force]"], "device.targets needs task=regression"),
        (["task=gestures"], "device.task=gestures must be"),
        (["task=regression", "learner=rules"], "learner=rules knows the labels"),
        (["task=regression", "device=simulated"], "task=regression needs device=recording"),
        (["device.group=session"], "has no group session: give device.group=person, gesture"),
        (["device.test_groups=[p9]"], "has no person p9, it has p0, p1"),
        (["device.test_groups=[p0,p1]"], "has every person: leave out some to train on"),
        (["device.test_groups=[p1]"], "press lacks a class in the touches to train on"),
    ],
)
def test_a_task_or_a_split_that_a_recording_does_not_have_is_refused(run, two, tmp_path, words, message):
    recording = [] if "device=simulated" in words else ["device=recording", two]
    done = run(tmp_path, "train", *recording, "experiment=features", *words, code=2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
