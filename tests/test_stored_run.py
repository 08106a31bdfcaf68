"""A run comes back as it was, but for what the command line names."""

import io
import json
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from skin.build import build_data, build_device, build_learner
from skin.config import Tracking, validate_config
from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.settings import Evaluation
from skin.paths import CONF
from skin.stored_run import TAG, find_run, load_configuration, load_learner, load_operating_point
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("evaluate", list(overrides))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store with a killed, a failed and two finished runs; the last one is an evaluation."""
    folder = tmp_path_factory.mktemp("store")
    settings = Tracking(f"sqlite:///{folder / 'm.db'}", str(folder / "a"), "skin", True, None)
    store = Store.open(settings)
    with store.run("older", {"learned": "weights.pt"}):
        pass
    with store.run("newer", {"learned": "weights.pt"}):
        pass
    with pytest.raises(ZeroDivisionError), store.run("failed", {"learned": "weights.pt"}):
        raise ZeroDivisionError
    store.client.create_run(store.experiment, run_name="killed", tags={"learned": "weights.pt"})
    with store.run("evaluation", {"evaluated": "newer"}):
        pass
    return store


def test_latest_is_the_last_training_that_finished(store):
    assert find_run(store, "latest").info.run_name == "newer"


def test_the_beginning_of_an_id_is_enough(store):
    run = find_run(store, "latest")
    assert find_run(store, run.info.run_id[:12]).info.run_id == run.info.run_id


@pytest.mark.parametrize(("name", "reason"), [("no such id", "no finished training run"), ("", "2 runs")])
def test_a_name_that_means_no_single_run_is_refused(store, name, reason):
    with pytest.raises(InputError, match=reason):
        find_run(store, name)


RECORDED = OmegaConf.create({"device": {"_target_": "skin.device.recording.Recorded"}})


def tagged(text=None):
    """Return as much of a run as its operating point is read from."""
    data = SimpleNamespace(tags={} if text is None else {TAG: text})
    return SimpleNamespace(data=data, info=SimpleNamespace(run_id="abc"))


def settings(rate=0.02):
    return Evaluation(devices=0, layouts=0, false_alarm_rate=rate)


def test_an_operating_point_comes_back_as_it_was_stored(caplog):
    point = OperatingPoint(0.8782987594604492, 0.02, 5000, 99, 0)
    assert load_operating_point(tagged(point.text()), None, RECORDED, settings()) == point
    assert load_operating_point(tagged("null"), None, RECORDED, settings()) is None
    assert caplog.text == ""


def test_an_old_run_on_a_recording_alarms_at_one_half_and_says_so(caplog):
    point = load_operating_point(tagged(), None, RECORDED, settings())
    assert (point.threshold, point.safe) == (0.5, 0)
    said = caplog.text
    assert "run abc stores no alarm threshold for 2 % false alarms" in said
    assert "its false-alarm rate is unknown; train it again" in said


def test_another_rate_on_a_recording_keeps_the_stored_threshold_and_says_so(caplog):
    point = OperatingPoint(0.875, 0.02, 300, 5, None)
    assert load_operating_point(tagged(point.text()), None, RECORDED, settings(0.1)) == point
    said = caplog.text
    assert "no alarm threshold for 10 % false alarms" in said
    assert "chosen on 300 safe validation gestures for 2 % false alarms" in said


SKIN = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2", "data.gestures=20"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What learners save: the name of the file -> its content."""
    found = {}
    for name, learner in (
        ("features.npz", ["learner=boosted_trees", "learner.rounds=2"]),
        ("rules.json", ["learner=rules"]),
    ):
        config = validate_config(composed(*SKIN, *learner))
        made = build_learner(config)
        made.fit(build_data(config, build_device(config)))
        path = made.save(tmp_path_factory.mktemp("learned"))
        assert path.name == name
        found[name] = path.read_bytes()
    return found | {"weights.pt": b"PK\3\4" + bytes(100)}


def claimed(shape):
    """Return an .npz file whose arrays claim a shape that they do not have."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in ("train", "train_labels", "validation", "validation_labels"):
            archive.writestr(f"{name}.npy", header.getvalue() + bytes(64))
    return buffer.getvalue()


def foreign(**arrays):
    """Return an .npz file of arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def tables(rows, columns, labels):
    """Return an .npz file as learner=boosted_trees saves it, of random numbers."""
    random = np.random.default_rng(0)
    parts = {}
    for split in ("train", "validation"):
        parts[split] = random.normal(size=(rows, columns)).astype(np.float32)
        parts[f"{split}_labels"] = random.integers(0, 2, (rows, labels)).astype(np.float32)
    return foreign(**parts)


DAMAGED = {
    "cut": ("features.npz", lambda content: content[:-100]),
    "almost empty": ("features.npz", lambda content: content[:3]),
    "a byte": ("features.npz", lambda content: content[:200] + b"\0\1\2\3" + content[204:]),
    "text": ("features.npz", lambda content: b"no archive"),
    "larger than memory": ("features.npz", lambda content: claimed((250_000_000, 240))),
    "an endless shape": ("features.npz", lambda content: claimed((10**400,))),
    "other arrays": ("features.npz", lambda content: foreign(a=np.ones(3))),
    "texts": ("features.npz", lambda content: foreign(**dict.fromkeys(
        ("train", "train_labels", "validation", "validation_labels"), np.array([["x"] * 4] * 9)))),
    "other features": ("features.npz", lambda content: tables(20, 5, 4)),
    "other labels": ("features.npz", lambda content: tables(20, 5, 2)),
    "a list": ("rules.json", lambda content: b"[]"),
    "other rules": ("rules.json", lambda content: b"{}"),
    "cut rules": ("rules.json", lambda content: content[:40]),
    "rules of other types": ("rules.json", lambda content: json.dumps(
        {name: {"measurement": 3, "threshold": 0, "slope": 1} for name in json.loads(content)}).encode()),
    "unknown measurements": ("rules.json", lambda content: json.dumps(
        {name: rule | {"measurement": "luck"} for name, rule in json.loads(content).items()}).encode()),
    "weights": ("weights.pt", lambda content: content),
    "no weights": ("weights.pt", lambda content: b""),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_what_was_learned_is_refused_where_it_is_damaged_or_foreign(case, store, whole, tmp_path):
    name, damage = DAMAGED[case]
    kind = {"features.npz": "boosted_trees", "rules.json": "rules", "weights.pt": "network"}[name]
    config = validate_config(composed(*SKIN, f"learner={kind}"))
    path = tmp_path / name
    path.write_bytes(damage(whole[name]))
    with store.run("damaged", {"learned": name}) as run:
        store.client.log_artifact(run.info.run_id, str(path))
    data, learner = build_data(config, build_device(config)), build_learner(config)
    with pytest.raises(InputError, match=rf"{name} of run .* is damaged or does not fit") as refused:
        load_learner(store, store.client.get_run(run.info.run_id), learner, data)
    assert "\n" not in str(refused.value)


def test_a_run_without_its_files_is_refused(store):
    with store.run("bare", {"learned": "rules.json"}) as run:
        pass
    config = validate_config(composed(*SKIN, "learner=rules"))
    with pytest.raises(InputError, match=r"has no rules\.json in "):
        load_learner(store, store.client.get_run(run.info.run_id), build_learner(config), None)


def test_a_run_of_another_version_is_refused(store):
    with store.run("other", {"learned": "rules.json"}) as run:
        store.client.log_text(run.info.run_id, "evaluation: {gestures: 5}", "config.yaml")
    with pytest.raises(InputError, match=r"does not fit this version: .*gestures.*: train it again$"):
        load_configuration(store, run)
