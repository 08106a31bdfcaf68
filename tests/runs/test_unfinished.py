"""A training that is killed continues, and ends as if nothing had happened."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.request import urlopen

import pytest
import torch

from skin.errors import InputError
from skin.learning.network import LAST
from skin.runs.configuration import Tracking, source_tags
from skin.runs.store import Store
from skin.runs.train import find_unfinished

TRAINING = (
    "train", "experiment=best_fresh", "simulator=naive", "data.gestures=400", "learner.dropout=0.2",
    "trainer.max_epochs=8", "device.test_gestures=48", "evaluation.devices=0", "evaluation.layouts=0",
    "evaluation.safe_gestures=64", "tracking.threads=1",
)  # fmt: skip


def learned(store):
    """Return the only finished run of a store, its weights, and its validation loss by step."""
    (run,) = store.find("FINISHED")
    path = store.client.download_artifacts(run.info.run_id, "weights.pt")
    history = store.client.get_metric_history(run.info.run_id, "val_loss")
    return run, torch.load(path, weights_only=True), {each.step: each.value for each in history}


def wait_for(epoch, folder, command, artifacts="a"):
    """Wait until the checkpoint of an epoch exists, counted from 0, and return its path."""
    for _ in range(1200):
        for path in Path(folder).glob(f"{artifacts}/unfinished/*/{LAST}"):
            if torch.load(path, weights_only=True)["epoch"] >= epoch:
                return path
        assert command.poll() is None, command.completed().stderr
        time.sleep(0.05)
    raise AssertionError("no checkpoint")


@pytest.mark.slow("trains three times")
def test_a_training_in_progress_is_refused_and_a_killed_one_ends_as_a_whole_one(run, begin, tmp_path, opened):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    run(whole, *TRAINING)
    own = [f"tracking.uri=sqlite:///{killed}/m.db", f"tracking.artifacts={killed}/a"]
    with begin(killed, *TRAINING, *own) as first:
        wait_for(0, killed, first)
        second = run(killed, *TRAINING, code=2)
        assert "is in progress in another process: wait for it" in second.stderr
        last = wait_for(2, killed, first)
    store = opened(killed)
    (left,) = store.find("KILLED")
    again = run(killed, *TRAINING)
    assert f"run {left.info.run_id} was interrupted and continues" in again.stderr
    assert not last.parent.exists()
    (_, weights, losses), (found, same, repeated) = learned(opened(whole)), learned(store)
    assert found.info.run_id == left.info.run_id
    assert repeated == losses
    assert all(torch.equal(weights[name], same[name]) for name in weights)
    assert find_unfinished(store, found.data.tags["fingerprint"]) is None


class Server:
    """An MLflow server of its own, whose runs are in a folder; it can be stopped and started again.

    Args:
        folder: of the database and the artifacts.
    """

    def __init__(self, folder):
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.uri, self.folder = f"http://127.0.0.1:{self.port}", folder

    def __enter__(self):
        command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self.port)]
        command += ["--backend-store-uri", f"sqlite:///{self.folder}/server.db", "--workers", "1"]
        command += ["--artifacts-destination", str(self.folder / "served")]
        settings = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": self.folder}
        self.process = subprocess.Popen(command, env=os.environ | settings, start_new_session=True, **quiet)
        for _ in range(600):
            with suppress(OSError), urlopen(f"{self.uri}/health", timeout=5):
                return self
            assert self.process.poll() is None
            time.sleep(0.1)
        raise AssertionError("the server does not start")

    def __exit__(self, *error):
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def on_server(server):
    with server:
        store = Store.open(Tracking(server.uri))
        (run,) = store.find()
        of = run.info.run_id
        names = ("train_loss", "val_loss")
        history = {name: [each.step for each in store.client.get_metric_history(of, name)] for name in names}
        files = {one.path for one in store.client.list_artifacts(run.info.run_id)}
    assert {"weights.pt", "predictions.parquet", "config.yaml"} <= files
    return run, history


@pytest.mark.slow("trains twice and starts a server")
def test_a_training_without_its_server_is_complete_when_repeated(begin, run, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    server = Server(tmp_path)
    own = [f"tracking.uri={server.uri}"]
    with ExitStack() as stack:
        with server:
            training = stack.enter_context(begin(tmp_path, *TRAINING, *own))
            wait_for(1, tmp_path, training, "mlartifacts")
        ended = training.completed()
    assert ended.returncode == 2, ended.stderr
    assert "Traceback" not in ended.stderr
    said = rf"the tracking server {server.uri} does not answer, and run \w+ is not complete"
    assert re.search(said, ended.stderr)
    began = time.monotonic()
    refused = run(tmp_path, *TRAINING, *own, store=False, code=2)
    assert refused.stderr.count("\n") == 1, refused.stderr
    assert time.monotonic() - began < 20
    with server:
        again = run(tmp_path, *TRAINING, *own, store=False)
    assert "was interrupted and continues" in again.stderr
    finished, history = on_server(server)
    assert finished.info.status == "FINISHED"
    # What the server did not take of an epoch is lost.
    assert {name for name, steps in history.items() if len(set(steps)) >= 7} == {"train_loss", "val_loss"}


def test_only_one_process_trains_a_configuration(tmp_path, opened):
    store = opened(tmp_path)
    with store.hold("a"), store.hold("b"), pytest.raises(InputError, match="wait for it"), store.hold("a"):
        pass
    with store.hold("a"):
        pass


def test_a_killed_run_of_another_machine_is_continued_where_its_folder_is_here(tmp_path, opened):
    store = opened(tmp_path)
    run = store.create("killed", source_tags() | {"fingerprint": "a"})
    folder = store.folder / run.info.run_id
    folder.mkdir(parents=True)
    folder.with_name(f"{run.info.run_id}.lock").touch()
    store = opened(tmp_path)
    assert find_unfinished(store, "a") is None
    (folder / LAST).touch()
    assert find_unfinished(store, "a").info.run_id == run.info.run_id
    assert find_unfinished(store, "another") is None
    store.client.set_tag(run.info.run_id, "source_commit", "another")
    assert find_unfinished(store, "a") is None
