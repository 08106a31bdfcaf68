"""A training that is killed continues, and ends as if nothing had happened."""

import time
from pathlib import Path

import pytest
import torch

from skin.config import Tracking
from skin.learner.network import LAST
from skin.tracking import Store
from skin.unfinished import find_unfinished

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

TRAINING = (
    "train", "experiment=best_fresh", "simulator=naive", "data.gestures=400", "learner.dropout=0.2",
    "trainer.max_epochs=8", "device.test_gestures=48", "evaluation.devices=0", "evaluation.layouts=0",
    "evaluation.safe_gestures=64", "tracking.threads=1",
)  # fmt: skip


def stored(folder):
    settings = Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None)
    return settings, Store.open(settings)


def learned(folder):
    """Return the only finished run of a folder and its weights."""
    _, store = stored(folder)
    (run,) = store.find("FINISHED")
    path = store.client.download_artifacts(run.info.run_id, "weights.pt")
    return run, torch.load(path, weights_only=True)


def epochs(folder, run):
    """Return the validation loss by step."""
    _, store = stored(folder)
    return {one.step: one.value for one in store.client.get_metric_history(run.info.run_id, "val_loss")}


def wait_for(epoch, folder, command):
    """Wait until the checkpoint of an epoch exists, counted from 0, and return its path."""
    for _ in range(1200):
        for path in Path(folder).glob(f"a/unfinished/*/{LAST}"):
            if torch.load(path, weights_only=True)["epoch"] >= epoch:
                return path
        assert command.poll() is None, command.completed().stderr
        time.sleep(0.05)
    raise AssertionError("no checkpoint")


@pytest.mark.slow
def test_a_killed_training_ends_with_the_weights_of_one_that_was_not(run, begin, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    assert run(whole, *TRAINING).returncode == 0
    own = [f"tracking.uri=sqlite:///{killed}/m.db", f"tracking.artifacts={killed}/a"]
    with begin(killed, *TRAINING, *own) as first:
        last = wait_for(2, killed, first)
    settings, store = stored(killed)
    (left,) = store.find("KILLED")
    again = run(killed, *TRAINING)
    assert again.returncode == 0, again.stderr
    assert f"run {left.info.run_id} was interrupted and continues" in again.stderr
    assert not last.parent.exists()
    (expected, weights), (found, same) = learned(whole), learned(killed)
    assert found.info.run_id == left.info.run_id
    assert epochs(killed, found) == epochs(whole, expected)
    assert all(torch.equal(weights[name], same[name]) for name in weights)
    assert find_unfinished(store, settings, found.data.tags["fingerprint"]) is None


@pytest.mark.slow
def test_other_code_and_resume_false_begin_again_and_a_complete_training_is_evaluated(run, begin, tmp_path):
    own = [f"tracking.uri=sqlite:///{tmp_path}/m.db", f"tracking.artifacts={tmp_path}/a"]
    with begin(tmp_path, *TRAINING, *own) as first:
        wait_for(7, tmp_path, first)
    settings, store = stored(tmp_path)
    (left,) = store.find("KILLED")
    identity, commit = left.data.tags["fingerprint"], left.data.tags["source_commit"]
    assert find_unfinished(store, settings, "another") is None
    fresh = Tracking(settings.uri, settings.artifacts, "skin", False, None)
    assert find_unfinished(store, fresh, identity) is None
    store.client.set_tag(left.info.run_id, "source_commit", "another")
    assert find_unfinished(store, settings, identity) is None
    store.client.set_tag(left.info.run_id, "source_commit", commit)
    again = run(tmp_path, *TRAINING)
    assert again.returncode == 0, again.stderr
    found, _ = learned(tmp_path)
    assert found.info.run_id == left.info.run_id
    assert sorted(epochs(tmp_path, found)) == sorted(epochs(tmp_path, left))
    assert "same/overall/accuracy" in found.data.metrics
