"""Files of a stranger run no code: every payload would leave a marker, and none does."""

import os
import pickle
from contextlib import suppress

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from omegaconf import OmegaConf

from skin.errors import InputError
from skin.runs.build import build_device, build_learner
from skin.runs.configuration import Tracking, settings_of
from skin.runs.run import FinishedRun, find_run
from skin.runs.store import Store

SKIN = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2", "data.gestures=20"]
TEXTS = [
    "row: !!python/object/apply:os.mkdir [MARKER]\n",
    "a: &a [x, x]\nb: &b [*a, *a]\nrow: [*b, *b]\n",
    "row: " + 2000 * "[",
    "- row\n",
    "row: \0",
    "row: x/../../marker\n",
]
PLAYED = ["generate.py", *SKIN, "device=recording", "out=y.csv"]


class Payload:
    """Leaves a marker when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("stranger")


@pytest.fixture(scope="module")
def store(folder):
    return Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))


@pytest.fixture
def marker(tmp_path):
    return tmp_path / "marker"


@pytest.fixture
def bait(tmp_path, marker):
    path = tmp_path / "bait.pkl"
    path.write_bytes(pickle.dumps(Payload(marker)))
    return path


@pytest.fixture
def put(store, configured, tmp_path):
    def put(change=None, *overrides, text=None, learned=None):
        config = settings_of(configured(*SKIN, "learner=rules", *overrides))
        config.pop("tracking")
        config |= change or {}
        path = tmp_path / "rules.json" if learned is None else learned
        if learned is None:
            path.write_text("{}")
        with store.run("bait", {"learned": path.name, "row": "bait", "simulator": "naive"}) as run:
            text = OmegaConf.to_yaml(OmegaConf.create(config)) if text is None else text
            store.client.log_text(run.info.run_id, text, "config.yaml")
            store.client.log_artifact(run.info.run_id, str(path))
        return run.info.run_id

    return put


def refused(done, marker, *words):
    """Check that a command ended with one sentence, and that no payload ran."""
    assert not marker.exists(), "the payload ran"
    assert done.stderr.count("\n") == 1, done.stderr
    assert all(word in done.stderr for word in words), done.stderr


CASES = {
    # where the payload is built, and by which command
    "a function of a library": ("live run={}", lambda bait, marker: {
        "body": {"_target_": "pandas.read_pickle", "filepath_or_buffer": str(bait)}}),
    "a function of the standard library": ("study study=embeddings study.run={}", lambda bait, marker: {
        "layout": {"_target_": "shutil.copyfile", "src": str(bait), "dst": str(marker)}}),
    "deep in a list, with arguments by place": ("study study=margins study.run={}", lambda bait, marker: {
        "learner": {"_target_": "skin.learning.learner.Ensemble", "members": {"a": [
            [{"_target_": "os.mkdir", "_args_": [str(marker)]}]]}}}),
    "a module that torch.optim imports": ("study study=streams study.run={}", lambda bait, marker: {
        "layout": {"_target_": "torch.optim.optimizer.torch.load", "f": str(bait), "weights_only": False}}),
    "a module that a module of skin imports": ("evaluate run={}", lambda bait, marker: {
        "layout": {"_target_": "skin.runs.store.os.mkdir", "path": str(marker)}}),
    "a name made by interpolation": (None, lambda bait, marker: {
        "row": "os.mkdir", "body": {"_target_": "${row}", "_args_": [str(marker)]}}),
    "a method of a class": (None, lambda bait, marker: {
        "body": {"_target_": "skin.core.files.Path.touch", "_args_": [
            {"_target_": "skin.core.files.Path", "_args_": [str(marker)]}]}}),
}  # fmt: skip


@pytest.mark.parametrize("case", [case for case, (command, _) in CASES.items() if command])
def test_a_run_builds_only_parts_of_the_package(case, run, folder, put, bait, marker):
    command, change = CASES[case]
    identity = put(change(bait, marker))
    refused(run(folder, *command.format(identity).split(), code=2), marker, "trust=true", identity)


@pytest.mark.parametrize("case", CASES)
def test_what_is_refused_would_have_run(case, store, put, bait, marker):
    """Trust proves that the payloads work."""
    found = find_run(Tracking(store.uri), put(CASES[case][1](bait, marker)))
    with pytest.raises(InputError, match="trust=true"):
        found.stored  # noqa: B018 - raises
    assert not marker.exists()
    trusted = FinishedRun(store, found.run, trust=True).stored
    for build in (build_device, build_learner):
        with suppress(Exception):
            build(trusted)
    assert marker.exists()


def test_a_stored_configuration_cannot_say_that_it_is_trusted(run, folder, put, bait, marker):
    identity = put(CASES["a function of a library"][1](bait, marker) | {"trust": True})
    refused(run(folder, "evaluate.py", f"run={identity}", code=2), marker, "trust=true")
    assert run(folder, "evaluate.py", f"run={identity}", "trust=true", code=None).returncode
    assert marker.exists()


@pytest.mark.parametrize("text", TEXTS)
def test_yaml_makes_no_objects_does_not_grow_and_leads_out_of_no_folder(text, store, put, marker):
    whole = {"row": "x/../../marker"} if text == TEXTS[-1] else None
    identity = put(whole, text=None if whole else text.replace("MARKER", str(marker)))
    found = find_run(Tracking(store.uri), identity)
    with pytest.raises(InputError, match="row" if whole else found.identity):
        found.stored  # noqa: B018 - raises
    assert not marker.exists()


@pytest.mark.parametrize("learner", ["boosted_trees", "network"])
def test_what_a_run_learned_holds_numbers_alone(learner, run, folder, put, tmp_path, marker):
    if learner == "boosted_trees":
        path, evil = tmp_path / "features.npz", np.array([Payload(marker)], dtype=object)
        np.savez(path, train=evil, train_labels=evil, validation=evil, validation_labels=evil)
    else:
        path = tmp_path / "weights.pt"
        torch.save({"layer": Payload(marker)}, path)
    identity = put({}, f"learner={learner}", learned=path)
    refused(run(folder, "evaluate.py", f"run={identity}", code=2), marker, path.name)


def test_a_calibration_makes_no_objects(run, tmp_path, marker):
    path = tmp_path / "gains.yaml"
    path.write_text(f"format: 1\ncount: 4\nsensors: !!python/object/apply:os.mkdir [{marker}]\n")
    done = run(tmp_path, "generate.py", *SKIN, "out=x.csv", f"device.calibration={path}", store=False, code=2)
    refused(done, marker, "gains.yaml")


@pytest.fixture(scope="module")
def recording(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    for name in ("x.parquet", "x.csv"):
        run(folder, "generate.py", *SKIN, "n=20", f"out={name}", store=False)
    return folder


def test_a_recording_makes_no_objects(run, recording, tmp_path, marker):
    table = pq.read_table(recording / "x.parquet")
    # What pyarrow before 14.0.1 unpickled while it read a schema.
    kind = {"ARROW:extension:name": "arrow.py_extension_type"}
    kind["ARROW:extension:metadata"] = pickle.dumps(Payload(marker), 0)
    field = pa.field("reading_00", pa.float32(), metadata=kind)
    position = table.schema.get_field_index("reading_00")
    pq.write_table(table.cast(table.schema.set(position, field)), tmp_path / "x.parquet")
    run(tmp_path, *PLAYED, "device.path=x.parquet", store=False)
    assert not marker.exists()


def test_a_cache_is_built_anew_where_it_holds_objects(run, tmp_path, marker, monkeypatch):
    monkeypatch.setenv("SKIN_CACHE", str(tmp_path / "cache"))
    command = ["generate.py", "simulator=fem", *SKIN[1:], "n=5", "body.cells=[12,12]", "out=x.csv"]
    run(tmp_path, *command, store=False)
    (known,) = (tmp_path / "cache").iterdir()
    with np.load(known) as file:
        names, before = list(file), (tmp_path / "x.csv").read_bytes()
    np.savez(known, **dict.fromkeys(names, np.array([Payload(marker)], dtype=object)))
    run(tmp_path, *command, store=False)
    assert not marker.exists()
    assert (tmp_path / "x.csv").read_bytes() == before
