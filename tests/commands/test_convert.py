"""`skin convert` as a person runs it, and a training on what it wrote."""

import json
import sqlite3

import numpy as np
import pytest
import yaml

from skin.device.files import read_recording

MAPPING = {
    "files": "*/*.csv",
    "fields": "(?P<person>[^/]+)/(?P<gesture>[a-z]+)",
    "time": {"column": "time", "unit": "ms"},
    "channels": {"columns": "s*", "unit": "N"},
    "segments": {"by": "file", "frames": 12},
    "labels": {
        "press": {"column": "gesture", "values": {"press": 1, "tap": 0}},
        "dangerous": {"target": "force", "above": 5.0},
    },
    "targets": {"force": {"column": "gauge", "unit": "N", "missing": -1}},
    "groups": ["person"],
}


def write(folder, persons=6, touches=24):
    """Write touches of persons: a press lasts longer; who pats has neither label of press."""
    random = np.random.default_rng(0)
    for person in range(persons):
        place = folder / f"p{person}"
        place.mkdir(parents=True)
        for number in range(touches):
            gesture = ("press", "tap", "pat")[number % 3]
            force, frames = random.uniform(1, 10), 8 if gesture == "press" else 2
            rows = ["time,s0,s1,s2,gauge"]
            for frame in range(12):
                value = force if 2 <= frame < 2 + frames else 0.0
                noise = random.normal(0, 0.02, 3)
                gauge = value if number % 4 else -1
                readings = ",".join(
                    f"{value * part + error:.3f}" for part, error in zip((1, 0.5, 0.1), noise, strict=True)
                )
                rows.append(f"{100 * frame},{readings},{gauge}")
            (place / f"{gesture}_{number:02d}.csv").write_text("\n".join(rows))
    (folder / "map.yaml").write_text(yaml.safe_dump(MAPPING, sort_keys=False))


def test_a_folder_is_converted_and_trained_on_by_person(run, tmp_path):
    write(tmp_path)
    done = run(tmp_path, "convert", "from=map.yaml", "out=x.parquet", store=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(
        "x.parquet: 144 touches of 12 frames at 10 Hz, 3 readings, press in 48 of 96, "
    )
    assert done.stdout.endswith("6 of person, positions unknown\n")
    recording = read_recording(tmp_path / "x.parquet")
    assert recording.touches.labels[:, 0].isnan().sum() == 48
    assert recording.touches.labels[:, 1].isnan().sum() == 36
    for settings in (
        ["experiment=features", "learner.rounds=5"],
        ["representation=readings", "model=mlp", "trainer.max_epochs=2"],
    ):
        train = ["device=recording", "device.path=x.parquet", "device.test_groups=[p1]", *settings]
        done = run(tmp_path, "train.py", *train)
        assert done.returncode == 0, done.stderr
        assert "split: by person: 4 to train (1 for validation), 1 to test (p1)\n" in done.stdout
    database = sqlite3.connect(tmp_path / "m.db")
    splits = database.execute("select value from tags where key = 'split'").fetchall()
    losses = database.execute("select value, is_nan from latest_metrics where key = 'val_loss'").fetchall()
    database.close()
    assert len(splits) == 2
    assert all(split.startswith("by person: ") for (split,) in splits)
    assert [is_nan for _, is_nan in losses] == [0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "skin convert needs from= and out=, as in from=map.yaml out=x.parquet"),
        (["from=map.yaml", "out=x.txt"], "a recording is a .parquet or .csv file, got x.txt"),
        (["from=map.yaml", "out=x.csv", "path=nowhere"], "nowhere has no file */*.csv"),
        (["from=none.yaml", "out=x.csv"], "cannot read the mapping none.yaml"),
        (["from=efles", "out=x.csv"], "from=efles is no format: give map.yaml, or one of cost, eflesh_force"),
        (["from=epi", "out=x.csv"], "from=epi needs path=FOLDER"),
    ],
)
def test_bad_input_ends_with_a_sentence(run, tmp_path, words, message):
    write(tmp_path, persons=1, touches=3)
    done = run(tmp_path, "convert", *words, store=False)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("x.*"))


def test_classes_and_targets_are_learned_instead_of_labels(run, tmp_path):
    write(tmp_path)
    mapping = MAPPING | {"classes": {"column": "gesture"}}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False))
    done = run(tmp_path, "convert", "from=map.yaml", "out=x.parquet", store=False)
    assert done.returncode == 0, done.stderr
    assert "classes pat, press, tap" in done.stdout
    trees = ["experiment=features", "learner.rounds=20"]
    network = ["representation=readings", "model=mlp", "trainer.max_epochs=2"]
    for task, figure in (("classes", "overall/accuracy"), ("regression", "force/rms_N")):
        for settings in (trees, network):
            words = ["device=recording", "device.path=x.parquet", f"task={task}", *settings]
            done = run(tmp_path, "train.py", *words)
            assert done.returncode == 0, done.stderr
            assert figure in done.stdout
            assert "press/accuracy" not in done.stdout
    done = run(tmp_path, "evaluate.py", "run=latest")
    assert done.returncode == 0, done.stderr
    assert "force/rms_N" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["task=classes"], "x.csv has no classes: give task=labels or task=regression"),
        (["task=regression", "device.targets=[x]"], "x.csv has no target x, it has force"),
        (["device.targets=[force]"], "device.targets needs task=regression"),
        (["task=gestures"], "device.task=gestures must be"),
        (["task=regression", "learner=rules"], "learner=rules knows the labels"),
        (["task=regression", "device=simulated"], "task=regression needs device=recording"),
    ],
)
def test_what_is_not_in_a_recording_is_not_learned(run, tmp_path, words, message):
    write(tmp_path, persons=2, touches=12)
    done = run(tmp_path, "convert", "from=map.yaml", "out=x.csv", store=False)
    assert done.returncode == 0, done.stderr
    words = ["device=recording", "device.path=x.csv", "experiment=features", *words]
    words = [word for word in words if "device=simulated" not in words or not word.startswith("device.path")]
    done = run(tmp_path, "train.py", *(words[1:] if "device=simulated" in words else words))
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["device.group=session"], "has no group session: give device.group=person, gesture"),
        (["device.test_groups=[p9]"], "has no person p9, it has p0, p1"),
        (["device.test_groups=[p0,p1]"], "has every person: leave out some to train on"),
        (["device.test_groups=[p1]"], "press lacks a class in the touches to train on"),
    ],
)
def test_a_split_that_leaves_nothing_to_learn_is_refused(run, tmp_path, words, message):
    """Only the second person presses."""
    write(tmp_path, persons=2, touches=12)
    for path in (tmp_path / "p0").glob("press*"):
        path.unlink()
    done = run(tmp_path, "convert", "from=map.yaml", "out=x.csv", store=False)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "x.csv.json").read_text())["metadata"]["groups"] == {"person": ["p0", "p1"]}
    done = run(tmp_path, "train.py", "device=recording", "device.path=x.csv", "experiment=features", *words)
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
