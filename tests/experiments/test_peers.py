"""The peers' command: files out, another process learns, its answers become a run like any other."""

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator

from experiments.peers.exchange import export_touches
from skin.build import build_device
from skin.config import Evaluation, Tracking, fingerprint, validate_config
from skin.paths import ROOT
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

ENVIRONMENT = ROOT / ".venv-peers" / "bin" / "python"
SMALL = [
    "data.gestures=160",
    "device.test_gestures=96",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
]


@pytest.fixture(scope="module")
def command(run):
    """Run the command with a store and files of its own."""

    def command(folder, *arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("COLUMNS", "200")
            return run(folder, "peers", *arguments, f"peers.folder={folder}/files")

    return command


@pytest.fixture(scope="module")
def learn():
    """The peers' script as a module; what it needs beyond the core it imports late."""
    spec = importlib.util.spec_from_file_location("learn", ROOT / "experiments" / "peers" / "learn.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def exchanged(configured, tmp_path_factory):
    """A device with a dead sensor and the folder of its exported touches."""
    device = build_device(configured("simulator=naive", *SMALL, "device.dead=1"))
    folder = tmp_path_factory.mktemp("exchanged") / "files"
    export_touches(device, Evaluation(1, 1, 48, 0.02, 64), folder)
    return device, folder


def test_without_its_environment_it_says_what_builds_it(command, tmp_path):
    done = command(tmp_path, f"peers.python={tmp_path}/none/python")
    assert done.returncode == 2
    assert done.stderr.endswith("make peers builds it\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["row=rocket9"], "no peer row=rocket9: choose from lightgbm"),
        (["datta.gestures=9"], "datta"),
    ],
)
def test_bad_input_exits_with_2(command, tmp_path, arguments, reason):
    done = command(tmp_path, *arguments)
    assert done.returncode == 2
    assert reason in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def ran(command, tmp_path_factory):
    """What two calls of the command with the peer that needs no other environment did."""
    folder = tmp_path_factory.mktemp("peers")
    arguments = ["row=ridge", f"peers.python={sys.executable}", "simulator=naive", *SMALL]
    return folder, command(folder, *arguments), command(folder, *arguments)


@pytest.mark.slow
def test_a_peer_is_a_run_that_the_table_finds(ran, configured):
    folder, first, _ = ran
    assert first.returncode == 0, first.stderr
    store = Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))
    config = validate_config(configured("row=ridge", "simulator=naive", "seed=0", *SMALL))
    (run,) = store.find("FINISHED", fingerprint=fingerprint(config))
    assert {"row": "ridge", "simulator": "naive", "seed": "0"}.items() <= run.data.tags.items()
    for column in ("same", "holdout", "device_shift", "unseen_layout"):
        assert f"{column}/overall/accuracy" in run.data.metrics
    # per label 25 sensors x 30 frames, an intercept, and two numbers of its logistic curve
    assert run.data.metrics["parameters"] == 4 * (25 * 30 + 1 + 2)
    assert run.data.metrics["seconds_per_epoch"] > 0
    path = store.client.download_artifacts(run.info.run_id, "predictions.parquet", str(folder))
    table = pq.read_table(path, memory_map=False)
    right = np.mean((table["p_press"].to_numpy() > 0.5) == (table["press"].to_numpy() > 0))
    assert run.data.metrics["same/press/accuracy"] == pytest.approx(right)


@pytest.mark.slow
def test_what_is_finished_is_skipped(ran):
    _, first, second = ran
    assert "same" in first.stdout
    assert second.returncode == 0, second.stderr
    assert "did this before" in second.stdout


def test_the_script_reads_what_the_device_felt(learn, exchanged):
    device, folder = exchanged
    touches = device.touches("test")
    assert not touches.valid.all()
    expected = touches.readings.where(touches.valid, 0).mT.numpy()
    assert np.array_equal(learn.load_readings(folder, "same_0"), expected)
    found = np.stack(list(learn.load_labels(folder, "same_0").values()), axis=1)
    assert np.array_equal(found, touches.labels.numpy())


class Scores(ClassifierMixin, BaseEstimator):
    """A classifier whose score is its only feature."""

    def fit(self, x, y):
        self.classes_ = np.array([0, 1])
        return self

    def decision_function(self, x):
        return x[:, 0]

    def predict(self, x):
        return (x[:, 0] > 0).astype(int)


def test_scores_become_probabilities_as_platt_has_it(learn):
    random = np.random.default_rng(0)
    truth = random.integers(0, 2, 300)
    score = truth + 0.4 * random.standard_normal(300)
    ours = learn.platt(score, truth).predict_proba(score[:, None])[:, 1]
    theirs = CalibratedClassifierCV(FrozenEstimator(Scores().fit(None, None)), method="sigmoid")
    theirs.fit(score[:, None], truth)
    # both search for the minimum of the same smooth loss
    assert ours == pytest.approx(theirs.predict_proba(score[:, None])[:, 1], abs=2e-3)


def test_scores_that_part_the_classes_stay_finite_and_in_order(learn):
    score = np.linspace(-1, 1, 40)
    chance = learn.platt(score, (score > 0).astype(int)).predict_proba(score[:, None])[:, 1]
    assert (np.diff(chance) > 0).all()
    assert 0 < chance[0] < 0.1 < 0.9 < chance[-1] < 1


@pytest.mark.slow
@pytest.mark.skipif(not ENVIRONMENT.is_file(), reason="no .venv-peers: make peers builds it")
@pytest.mark.parametrize("peer", ["lightgbm", "minirocket", "multirocket_hydra"])
def test_peers_learn_in_their_own_environment(exchanged, peer):
    device, folder = exchanged
    script = ROOT / "experiments" / "peers" / "learn.py"
    subprocess.run([ENVIRONMENT, script, peer, folder, "--jobs", "1"], check=True, timeout=300)
    table = pq.read_table(folder / peer / "same_0.parquet")
    assert tuple(table.column_names) == device.task.names
    chances = np.stack([column.to_numpy() for column in table.columns], axis=1)
    assert ((chances >= 0) & (chances <= 1)).all()
    assert ((chances > 0.5) == device.touches("test").labels.numpy()).mean() > 0.7
    assert json.loads((folder / peer / "about.json").read_text())["parameters"] > 100
