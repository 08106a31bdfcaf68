"""A recording as a device: it must be of the sheet and the layout that the configuration names."""

from dataclasses import replace

import pytest
import torch

from skin import Grid, InputError, Sheet, read_recording
from skin.body.layout import Scattered
from skin.device.files import write_recording
from skin.device.recording import Recorded
from skin.touch.labels import Task
from tests.device.test_files import write_data_set
from tests.made_up import SHEET, naive_skin

LAYOUT = Scattered(5, 5, seed=0)


@pytest.fixture(scope="module")
def simulated():
    return naive_skin(layout=LAYOUT, gestures=50).recording()


@pytest.fixture(scope="module")
def path(simulated, tmp_path_factory) -> str:
    return str(write_recording(simulated, tmp_path_factory.mktemp("files") / "x.parquet"))


@pytest.fixture(scope="module")
def folder(simulated, tmp_path_factory) -> str:
    return str(write_data_set(simulated, tmp_path_factory.mktemp("sets") / "touches"))


@pytest.mark.parametrize("stored", ["path", "folder"])
def test_a_file_and_a_data_set_are_split_by_gesture(request, stored, simulated):
    stored = request.getfixturevalue(stored)
    device, again, other = (Recorded(SHEET, LAYOUT, stored, split_seed=seed) for seed in (0, 0, 1))
    parts = [device.touches(split) for split in ("train", "validation", "test")]
    assert [len(part) for part in parts] == [40, 5, 5]
    readings = torch.cat([part.readings for part in parts]).flatten(1)
    assert torch.equal(readings.unique(dim=0), simulated.touches.readings.flatten(1).unique(dim=0))
    assert (device.window, device.rate, device.task) == (30, 10.0, simulated.task)
    for twin in (device.touches("holdout"), again.touches("test")):
        assert torch.equal(parts[2].readings, twin.readings)
    assert not torch.equal(parts[2].readings, other.touches("test").readings)


@pytest.mark.parametrize("stored", ["path", "folder"])
@pytest.mark.parametrize(
    ("body", "layout", "message"),
    [
        (SHEET, Grid(4, 4), r"has 25 sensors, the layout has 16"),
        (SHEET, Scattered(5, 5, seed=1), r"has sensor \d+ at .*the layout at"),
        (Sheet((0.2, 0.16), (16, 16), SHEET.layers), LAYOUT, r"add body.size=\[0.16,0.16\]"),
    ],
)
def test_another_skin_is_refused(request, stored, body, layout, message):
    with pytest.raises(InputError, match=message):
        Recorded(body, layout, request.getfixturevalue(stored))


def test_no_file_too_few_touches_and_more_than_memory_are_refused(simulated, tmp_path, folder, monkeypatch):
    with pytest.raises(InputError, match=r"add device.path=x.parquet"):
        Recorded(SHEET, LAYOUT)
    few = write_recording(simulated[:9], tmp_path / "few.parquet")
    with pytest.raises(InputError, match=r"has 9 touches: 80/10/10 needs at least 10"):
        Recorded(SHEET, LAYOUT, str(few))
    device = Recorded(SHEET, LAYOUT, folder)
    monkeypatch.setattr("skin.device.recording._BYTES", 1e12)
    with pytest.raises(InputError, match=r"touches, 40 gestures at once, needs about .* GB of memory"):
        device.touches("train")


def test_no_more_is_held_out_than_needed(folder, monkeypatch):
    monkeypatch.setattr("skin.device.base.MOST_HELD_OUT", 2)
    device = Recorded(SHEET, LAYOUT, folder)
    assert [len(device.touches(split)) for split in ("train", "validation", "holdout")] == [46, 2, 2]


def test_all_of_a_data_set_may_be_the_test(folder, simulated):
    device = Recorded(SHEET, LAYOUT, folder, test="all")
    assert torch.equal(device.touches("test").readings, simulated.touches.readings)
    whole = device.recording()
    assert torch.equal(whole.parameters["peak"], simulated.parameters["peak"])
    assert "summary" not in whole.metadata


def test_a_converted_recording_brings_its_sensors(simulated, tmp_path):
    """Body and layout have no effect on it, nor on the device that restores a run."""
    foreign = replace(simulated, metadata={"positions": "unknown", "groups": {}})
    stored = str(write_recording(foreign, tmp_path / "x.parquet"))
    device = Recorded(SHEET, Grid(4, 4), stored)
    assert len(device.sensors) == 25
    assert not device.configured
    assert not device.blank().configured
    assert device.split == "by gesture"


def test_classes_and_targets_replace_the_labels(simulated, tmp_path):
    count = len(simulated)
    parameters = {
        "class": torch.arange(count).float() % 3,
        "x": torch.linspace(0, 0.1, count),
        "force": torch.arange(count).float().where(torch.arange(count) % 2 == 0, torch.nan),
        "group_person": torch.arange(count).float() % 5,
    }
    about = {"groups": {"person": list("abcde")}, "classes": ["pat", "rub", "tap"]}
    known = replace(simulated, parameters=parameters, metadata=about)
    stored = str(write_recording(known, tmp_path / "x.parquet"))
    classes = Recorded(SHEET, LAYOUT, stored, task="classes", test_groups="a")
    assert classes.task == Task(("pat", "rub", "tap"), "exclusive")
    assert (classes.all_touches().labels.argmax(1) == parameters["class"]).all()
    both = Recorded(SHEET, LAYOUT, stored, task="regression", test_groups="a")
    assert both.task == Task(("x", "force"), "regression")
    assert both.touches("test").labels[:, 1].isnan().any()
    position = Recorded(SHEET, LAYOUT, stored, task="regression", targets=["x"])
    torch.testing.assert_close(position.all_touches().labels[:, 0], parameters["x"])
    assert position.recording().task == position.task
    again = write_recording(position.recording(), tmp_path / "targets.parquet")
    torch.testing.assert_close(read_recording(again).touches.labels[:, 0], parameters["x"])
    assert Recorded(SHEET, LAYOUT, stored, task="labels").task == simulated.task
    with pytest.raises(InputError, match="has no target y, it has x, force"):
        Recorded(SHEET, LAYOUT, stored, task="regression", targets=["y"])


@pytest.mark.parametrize("name", ["class", "x"])
def test_one_class_or_value_to_train_on_is_refused(simulated, tmp_path, name):
    person = torch.arange(len(simulated)) % 2
    parameters = {name: person.float(), "group_person": person.float()}
    about = {"groups": {"person": ["a", "b"]}, "classes": ["pat", "rub"]}
    known = replace(simulated, parameters=parameters, metadata=about)
    stored = str(write_recording(known, tmp_path / "x.parquet"))
    task = {"class": "classes", "x": "regression"}[name]
    message = {"class": "pat lacks a class", "x": "x has less than two values"}[name]
    with pytest.raises(InputError, match=f"{message} in the touches to train on"):
        Recorded(SHEET, LAYOUT, stored, task=task, test_groups="b").touches("train")


def test_a_recording_with_some_labels_serves_a_run_with_more(simulated, tmp_path):
    names = ("dangerous", "press", "firm")
    labels = simulated.touches.labels[:, [3, 2, 0]]
    some = replace(simulated, task=Task(names), touches=replace(simulated.touches, labels=labels))
    path = str(write_recording(some, tmp_path / "x.parquet"))
    device = Recorded(SHEET, LAYOUT, path, test="all")
    same = device.with_labels(simulated.task)
    assert (same.task, same.blank().task) == (simulated.task, simulated.task)
    assert same.blank().touches("test").labels.shape == (1, 4)
    known = same.touches("test").labels
    torch.testing.assert_close(known[:, 2:], simulated.touches.labels[:, 2:])
    assert known[:, :2].isnan().all()
    assert device.touches("test").labels.shape[1] == 3
    assert device.with_labels(device.task) is device
    message = "has the labels dangerous, press, firm, and the run learned soft"
    for task in (Task(("soft",)), replace(simulated.task, names=("soft", "press"), kind="exclusive")):
        with pytest.raises(InputError, match=message):
            device.with_labels(task)
    with pytest.raises(InputError, match="and the run learned press, touch"):
        device.with_labels(Task(("press", "touch"), gate="touch"))


def test_a_recording_without_labels_takes_those_of_a_run(simulated, tmp_path):
    bare = replace(simulated, touches=replace(simulated.touches, labels=None))
    path = str(write_recording(bare, tmp_path / "x.parquet"))
    device = Recorded(SHEET, LAYOUT, path, test="all").with_labels(Task(("a", "b", "c"), "exclusive"))
    assert len(device.task) == 3
    assert device.touches("test").labels is None
