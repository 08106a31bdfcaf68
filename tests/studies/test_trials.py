"""Conditions of a study and their devices."""

import functools
import time

import pytest

from experiments.studies import trials
from experiments.studies.runs import Planned
from experiments.studies.study import Study, Variant
from experiments.studies.trials import _Run, numbered_settings, run_trials
from skin.config import fingerprint
from skin.errors import InputError
from skin.finished_run import MissingWeightsError, find_pretrained
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


def study(**settings):
    return Study("x", "x", [0], **settings)


def test_a_condition_without_lists_has_one_device():
    assert list(numbered_settings(study(), {"device.noise": 0.1})) == [("", {"device.noise": 0.1})]


def test_a_list_gives_each_device_its_value():
    condition = {"layout": "random", "layout.seed": [7, 8]}
    assert list(numbered_settings(study(), condition)) == [
        ("1", {"layout": "random", "layout.seed": 7}),
        ("2", {"layout": "random", "layout.seed": 8}),
    ]


def test_numbered_settings_are_the_number_of_the_device():
    found = list(numbered_settings(study(devices=2, numbered=["device.seed"]), {"device.dead": 1}))
    assert found == [("1", {"device.dead": 1, "device.seed": 1}), ("2", {"device.dead": 1, "device.seed": 2})]


def test_lists_of_different_lengths_are_refused():
    with pytest.raises(InputError, match="one length"):
        list(numbered_settings(study(devices=3, numbered=["device.seed"]), {"layout.seed": [1, 2]}))


@pytest.fixture
def measured(configured, tmp_path, monkeypatch):
    """Finish a training anew, or take a given run; return a function that counts its trials."""
    config = configured("experiment=rules", f"tracking.uri=sqlite:///{tmp_path}/m.db")
    store, count = Store.open(config.tracking), []

    def measure(self, what, own, name, tags, changed):
        count.append(name)
        with store.run(name, tags) as run:
            pass
        return store.client.get_run(run.info.run_id)

    monkeypatch.setattr(_Run, "_measure", measure)
    compose = functools.partial(configured, "experiment=rules")
    monkeypatch.setattr(trials, "compose", lambda name, words: compose(*words))

    def train(run=None):
        if run is None:
            with store.run("rules", {"fingerprint": fingerprint(config)}) as run:
                pass
            run = store.client.get_run(run.info.run_id)
        own = _Run(store, run, config)
        own.stored = config

        def trial():
            own.measured(study(), [], ["device.dead=1"])
            return len(count)

        return trial

    return train


def test_a_trial_is_measured_once_for_a_training(measured):
    trial = measured()
    assert [trial(), trial()] == [1, 1]


def test_a_trial_of_a_pretrained_model_is_measured_once(measured):
    """A model's record does not say when its training ended."""
    trial = measured(find_pretrained("default_skin"))
    assert [trial(), trial()] == [1, 1]


def test_a_trial_of_an_earlier_training_is_not_reused(measured):
    """The same configuration trained again by other code may give other weights."""
    assert measured()() == 1
    time.sleep(0.01)  # MLflow counts milliseconds
    again = measured()
    assert [again(), again()] == [2, 2]


@pytest.fixture
def imported(configured, tmp_path, monkeypatch):
    """Return a function that yields the trials of a run without weights on two devices, one of them known."""
    config = configured("experiment=rules", f"tracking.uri=sqlite:///{tmp_path}/m.db")
    store = Store.open(config.tracking)
    with store.run("rules", {"fingerprint": "a" * 16}) as run:
        pass
    run, said = store.client.get_run(run.info.run_id), {"outcome": "known"}

    def measured(self, study, base, line):
        if "device.dead=1" in line:
            raise MissingWeightsError("no weights")
        with store.run("trial", said) as trial:
            pass
        return store.client.get_run(trial.info.run_id)

    monkeypatch.setattr(_Run, "measured", measured)
    monkeypatch.setattr(trials, "passed_overrides", list)

    def of(rows, **conditions):
        asked = study(rows=rows, conditions=conditions)
        return run_trials(store, Planned(Variant("rules", {}, {}), "0", run), asked, config, tmp_path)

    return of


def test_an_imported_run_without_all_results_is_left_out_of_all_rows(imported, capsys):
    """No part of it, so that a row has the same runs under all conditions."""
    assert not list(imported("all", known={}, unknown={"device.dead": 1}))
    assert capsys.readouterr().err == "left out: no weights\n"


def test_an_imported_run_with_all_results_is_not_left_out(imported):
    assert [(one.condition, one.line) for one in imported("all", known={})] == [("known", "known")]


def test_an_imported_run_of_a_named_row_has_to_be_trained(imported):
    with pytest.raises(MissingWeightsError):
        list(imported(["rules"], known={}, unknown={"device.dead": 1}))
