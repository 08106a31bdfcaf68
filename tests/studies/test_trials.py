"""Conditions of a study and their devices."""

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest

from experiments.studies import trials
from experiments.studies.measures import Subject
from experiments.studies.study import Study, Variant
from experiments.studies.trials import StudyRun, read_frame
from skin.errors import InputError
from skin.runs.configuration import fingerprint
from skin.runs.run import FinishedRun
from skin.runs.store import Store


def measured_frame():
    frame = pd.DataFrame([{"same/overall/accuracy": 0.5, "outcomes": b"\x00\x01"}])
    frame.attrs |= {"about": "a line", "metrics": {"a": float("nan")}, "source": {"source_commit": "0"}}
    return frame


def study(**settings):
    return Study("x", "x", [0], **settings)


@pytest.mark.parametrize(
    ("condition", "more", "found"),
    [
        ({"device.noise": 0.1}, {}, [("", {"device.noise": 0.1})]),
        ({"layout": "random", "layout.seed": [7, 8]}, {}, [("1", {"layout": "random", "layout.seed": 7}),
                                                           ("2", {"layout": "random", "layout.seed": 8})]),
        ({"measure.recordings": ["a", "b"]}, {}, [("", {"measure.recordings": ["a", "b"]})]),
        ({"device.dead": 1}, {"devices": 2, "numbered": ["device.seed"]},
         [("1", {"device.dead": 1, "device.seed": 1}), ("2", {"device.dead": 1, "device.seed": 2})]),
    ],
)  # fmt: skip
def test_lists_of_a_condition_number_its_devices(condition, more, found):
    expected = [("c", number, settings) for number, settings in found]
    assert list(trials.numbered_settings(study(conditions={"c": condition}, **more))) == expected


def test_lists_of_different_lengths_are_refused():
    conditions = {"c": {"layout.seed": [1, 2]}}
    with pytest.raises(InputError, match="one length"):
        list(trials.numbered_settings(study(devices=3, numbered=["device.seed"], conditions=conditions)))


@dataclass(frozen=True)
class Counted:
    gestures: int = 1
    calls: ClassVar = []

    def __call__(self, subject):
        self.calls.append(subject.condition)
        return measured_frame()


@pytest.fixture
def measured(configured, tmp_path, monkeypatch):
    """Finish a training anew, or take a given run; return a function that counts its trials."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(StudyRun, "model", None)
    monkeypatch.setattr(Counted, "calls", [])
    config = configured("experiment=rules", f"tracking.uri=sqlite:///{tmp_path}/m.db")
    store = Store.open(config.tracking)

    def train(finished=None, gestures=1):
        if finished is None:
            with store.run("rules", {"fingerprint": fingerprint(config)}) as run:
                pass
            finished = FinishedRun(store, store.client.get_run(run.info.run_id))
        run = StudyRun(Variant("", {}, {}), "0", finished)

        def trial(condition="a, b", *changes):
            subject = Subject(configured("experiment=rules", *changes), condition=condition)
            frame, _ = trials.measure_once("x", Counted(gestures), run, subject)
            assert frame["same/overall/accuracy"].tolist() == [0.5]
            return len(Counted.calls)

        return trial

    return train


def test_a_trial_is_measured_once_for_a_training(measured, tmp_path):
    trial = measured()
    assert [trial(), trial()] == [1, 1]
    assert [trial("a, b", "device.dead=2"), trial("a, b", "device.dead=2"), trial()] == [2, 2, 2]
    assert [trial("c"), trial("c")] == [3, 3], "of conditions with the same settings, each is measured"
    assert len(list((tmp_path / "results" / "trials" / "x").iterdir())) == 3
    assert measured(gestures=100)() == 4


def test_a_trial_of_an_earlier_training_is_not_reused(measured):
    """The same configuration trained again by other code may give other weights."""
    assert measured()() == 1
    time.sleep(0.01)  # MLflow counts milliseconds
    again = measured()
    assert [again(), again()] == [2, 2]


def test_a_frame_is_read_as_it_was_written_and_a_damaged_one_is_refused(tmp_path):
    path, frame = tmp_path / "new" / "a.parquet", measured_frame()
    assert read_frame(path) is None
    trials.write_frame(frame, path)
    pd.testing.assert_frame_equal(read_frame(path), frame)
    assert read_frame(path).attrs["about"] == "a line"
    assert [file.name for file in path.parent.iterdir()] == ["a.parquet"]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="remove it, and it is measured again"):
        read_frame(path)
    pd.DataFrame({"run": ["a"]}).to_parquet(path)
    with pytest.raises(InputError, match="it is no measurement"):
        read_frame(path)


def trial(model, seed, outcomes, **chosen):
    codes = None if outcomes is None else np.array(outcomes, dtype=np.uint8).tobytes()
    row = {"variant": model, "seed": seed, "run": f"run_{model}", "outcomes": codes, "row": model}
    return row | {"simulator": chosen.get("simulator", ""), "chosen": {"experiment": model, **chosen}}


def test_models_vote_by_seed_and_by_equal_other_settings():
    """Of three gestures, the second is wrong in two of three models, the third in one."""
    found = [trial("a", "0", [0, 1, 0]), trial("b", "0", [0, 1, 1]), trial("c", "0", [0, 0, 0])]
    found += [trial("d", "0", [1, 1, 1]), trial("a", "1", [0, 0, 0]), trial("b", "1", None)]
    (vote,) = trials.votes(study(vote=["a", "b", "c"]), pd.DataFrame(found))
    assert (vote["variant"], vote["seed"], vote["run"]) == ("vote", "0", "run_a run_b run_c")
    metrics = [vote[f"same/{name}"] for name in ("big/accuracy", "dynamic/accuracy", "any/disagreement")]
    assert metrics == pytest.approx([2 / 3, 1, 2 / 3])
    assert not list(trials.votes(study(), pd.DataFrame(found)))
    both = [trial(one["row"], "0", [*one["outcomes"]], simulator=name) for name in "ab" for one in found[:3]]
    named = [one["variant"] for one in trials.votes(study(vote="all"), pd.DataFrame(both))]
    assert named == ["a vote", "b vote"]
