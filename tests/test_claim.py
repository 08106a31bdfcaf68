"""What another process makes is not made twice."""

import json
import threading

import pytest

from skin import claim, tracking
from skin.config import Tracking
from skin.errors import InputError
from skin.tracking import PROCESS, Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

ELSEWHERE = json.dumps(["another machine", 1, 0.0])


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    return Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(claim, "BEAT", 0.5)


def begin(store, fingerprint, process=None, **tags):
    """Return a run in progress."""
    tags |= {"fingerprint": fingerprint, PROCESS: process or tracking._me()}
    return store.client.create_run(store.experiment, tags=tags)


def status(store, run):
    return store.client.get_run(run.info.run_id).info.status


def test_a_run_of_a_process_that_lives_is_not_made_again(store):
    run = begin(store, "a")
    with pytest.raises(InputError, match=rf"^run {run.info.run_id} with the same"):
        claim.refuse_twice(store, "a")
    claim.refuse_twice(store, "another")
    assert status(store, run) == "RUNNING"


def test_of_two_that_begin_at_the_same_time_one_goes_on(store):
    runs = [begin(store, "b") for _ in range(2)]
    refused = []
    for run in runs:
        try:
            claim.refuse_twice(store, "b", run)
        except InputError:
            refused.append(run)
    assert len(refused) == 1


def test_a_run_of_another_machine_lives_while_it_changes(store):
    run = begin(store, "c", ELSEWHERE)
    with claim.claim(store, run, once=False), pytest.raises(InputError, match="is in progress"):
        claim.refuse_twice(store, "c")


def test_a_silent_run_of_another_machine_was_killed(store):
    run = begin(store, "d", ELSEWHERE, alive="1")
    claim.refuse_twice(store, "d")
    assert status(store, run) == "KILLED"


def test_a_run_of_an_earlier_version_is_left_alone(store):
    run = begin(store, "e", ELSEWHERE)
    claim.refuse_twice(store, "e")
    assert status(store, run) == "RUNNING"


def test_a_claim_ends_with_its_run(store):
    before = threading.active_count()
    with claim.claim(store, begin(store, "f"), once=True):
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
