"""A run comes back as it was, but for what the command line names."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import skops.io as sio
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from sklearn.linear_model import LinearRegression

from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.settings import Evaluation
from skin.runs.build import alarm_source, build_data, build_device, build_learner
from skin.runs.configuration import Config, Tracking
from skin.runs.run import TAG, FinishedRun, find_run

RECORDED = Config(device={"_target_": "skin.device.recording.Recorded"})
SKIN = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2", "data.gestures=20"]


@pytest.fixture(scope="module")
def store(tmp_path_factory, opened):
    """A store with a killed, a failed and two finished runs; the last one is an evaluation."""
    store = opened(tmp_path_factory.mktemp("store"))
    for name in ("older", "newer"):
        with store.run(name, {"learned": "weights.pt"}):
            pass
    with pytest.raises(ZeroDivisionError), store.run("failed", {"learned": "weights.pt"}):
        raise ZeroDivisionError
    store.client.create_run(store.experiment, run_name="killed", tags={"learned": "weights.pt"})
    with store.run("evaluation", {"evaluated": "newer"}):
        pass
    return store


def test_a_run_is_latest_or_begins_with_an_id(store):
    run = find_run(Tracking(store.uri), "latest")
    assert run.title == "newer"
    assert find_run(Tracking(store.uri), run.identity[:12]).identity == run.identity
    for name, reason in (("no such id", "no finished training run"), ("", "2 runs")):
        with pytest.raises(InputError, match=reason):
            find_run(Tracking(store.uri), name)


def stored_point(text=None, rate=0.02):
    data = SimpleNamespace(tags={} if text is None else {TAG: text})
    run = FinishedRun(None, SimpleNamespace(data=data, info=SimpleNamespace(run_id="abc")))
    run.__dict__["stored"] = RECORDED
    settings = Evaluation(devices=0, layouts=0, false_alarm_rate=rate)
    return choose_alarm_threshold(alarm_source(run, object(), replace(RECORDED, evaluation=settings)))


def test_an_operating_point_comes_back_as_it_was_stored(caplog):
    point = OperatingPoint(0.8782987594604492, 0.02, 5000, 99, 0)
    assert stored_point(point.text()) == point
    assert stored_point("null") is None
    assert caplog.text == ""


def test_a_run_on_a_recording_says_where_its_threshold_is_not_for_the_wanted_rate(caplog):
    point = stored_point()
    assert (point.threshold, point.safe) == (0.5, 0)
    point = OperatingPoint(0.875, 0.02, 300, 5, None)
    assert stored_point(point.text(), 0.1) == point
    old, other = caplog.text.splitlines()
    assert "run abc stores no alarm threshold for 2 % false alarms" in old
    assert "its false-alarm rate is unknown; train it again" in old
    assert "no alarm threshold for 10 % false alarms" in other
    assert "chosen on 300 safe validation gestures for 2 % false alarms" in other


@pytest.fixture(scope="module")
def whole(tmp_path_factory, configured):
    """What learners save: the name of the file -> its content."""
    found = {}
    for name, learner in (
        ("models.skops", ["learner=boosted_trees", "learner.rounds=2", "data.gestures=200"]),
        ("rules.json", ["learner=rules"]),
    ):
        config = configured(*SKIN, *learner)
        made = build_learner(config)
        made.fit(build_data(config, build_device(config)))
        path = made.save(tmp_path_factory.mktemp("learned"))
        assert path.name == name
        found[name] = path.read_bytes()
    return found | {"weights.pt": b"PK\3\4" + bytes(100)}


def stored(change):
    def damage(content):
        models = sio.loads(content, trusted=sio.get_untrusted_types(data=content))
        return sio.dumps(change(models) or models)

    return damage


def nodes(**values):
    """Return a function that changes the first node of the first tree of models."""

    def change(models):
        for name, value in values.items():
            models[0]._predictors[0][0].nodes[name][0] = value

    return change


class Stranger:
    """A class that no file may choose."""


DAMAGED = {
    "cut": ("models.skops", lambda content: content[:-100]),
    "almost empty": ("models.skops", lambda content: content[:3]),
    "a byte": ("models.skops", lambda content: content[:200] + b"\0\1\2\3" + content[204:]),
    "text": ("models.skops", lambda content: b"no archive"),
    "other content": ("models.skops", stored(lambda models: {"a": 1})),
    "a stranger": ("models.skops", stored(lambda models: [Stranger()] * 4)),
    "another estimator": ("models.skops", stored(lambda models: [LinearRegression()] * 4)),
    "regressors": ("models.skops", stored(lambda models: [
        HistGradientBoostingRegressor(max_iter=1).fit(np.eye(60), np.arange(60))] * 4)),
    "other features": ("models.skops", stored(lambda models: [
        HistGradientBoostingClassifier(max_iter=1).fit(np.eye(60), np.arange(60) % 2)] * 4)),
    "other labels": ("models.skops", stored(lambda models: models[:2])),
    "a loop": ("models.skops", stored(nodes(left=0))),
    "a missing child": ("models.skops", stored(nodes(right=10_000))),
    "a missing feature": ("models.skops", stored(nodes(feature_idx=-7))),
    "a category": ("models.skops", stored(nodes(is_categorical=1))),
    "no number": ("models.skops", stored(nodes(value=np.nan))),
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
def test_what_was_learned_is_refused_where_it_is_damaged_or_foreign(case, store, whole, tmp_path, configured):
    name, damage = DAMAGED[case]
    kind = {"models.skops": "boosted_trees", "rules.json": "rules", "weights.pt": "network"}[name]
    config = configured(*SKIN, f"learner={kind}")
    path = tmp_path / name
    path.write_bytes(damage(whole[name]))
    with store.run("damaged", {"learned": name}) as run:
        store.client.log_artifact(run.info.run_id, str(path))
    data, learner = build_data(config, build_device(config)), build_learner(config)
    with pytest.raises(InputError, match=rf"{name} of run .* is damaged or does not fit") as refused:
        FinishedRun(store, store.client.get_run(run.info.run_id)).load_weights(learner, data)
    assert "\n" not in str(refused.value)


def test_a_run_without_its_files_or_of_another_version_is_refused(store, configured):
    with store.run("bare", {"learned": "rules.json"}) as run:
        store.client.log_text(run.info.run_id, "evaluation: {gestures: 5}", "config.yaml")
    learner = build_learner(configured(*SKIN, "learner=rules"))
    with pytest.raises(InputError, match=r"has no rules\.json in "):
        FinishedRun(store, run).load_weights(learner, None)
    with pytest.raises(InputError, match=r"does not fit this version: .*gestures.*: train it again$"):
        _ = FinishedRun(store, run).stored
