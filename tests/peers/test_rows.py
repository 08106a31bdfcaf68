"""The rows of peers: finished runs that the table, studies and evaluations find."""

import sys

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from experiments import peers
from skin.core.files import CONF
from skin.core.settings import check_targets
from skin.learning.data import TouchData
from skin.runs.build import build_learner
from skin.runs.configuration import Tracking, fingerprint, settings_of, validate_config
from skin.runs.store import Store

SMALL = ["data.gestures=160", "device.test_gestures=96", "evaluation.devices=1", "evaluation.layouts=1"]
SMALL += ["evaluation.safe_gestures=64"]


def composed(row, *words):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        search = f"hydra.searchpath=['file://{peers.CONF}']"
        return validate_config(compose("train", [search, f"experiment={row}", *words]))


@pytest.mark.parametrize("row", peers.ROWS)
def test_every_row_is_built_and_may_be_loaded(row):
    config = composed(row)
    build_learner(config)
    assert config.row == row
    check_targets(settings_of(config), "a run")


@pytest.fixture(scope="module")
def ran(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("peers")

    def command(verb, *words):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("COLUMNS", "200")
            patch.setenv(peers.PYTHON, sys.executable)
            return run(folder, verb, *words)

    train = ["--config-dir", str(peers.CONF), "experiment=ridge", "simulator=naive", *SMALL]
    study = ["study=robustness", "study.part=dead", "study.rows=[ridge]", "study.devices=1"]
    study += ["simulator=naive", f"out={folder}/out"]
    return folder, command("train", *train), command("study", *study)


@pytest.mark.slow("trains a peer")
def test_a_peer_is_a_run_that_the_table_finds(ran):
    folder, first, _ = ran
    assert first.returncode == 0, first.stderr
    store = Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))
    (run,) = store.find("FINISHED", fingerprint=fingerprint(composed("ridge", "simulator=naive", *SMALL)))
    for column in ("same", "holdout", "device_shift", "unseen_layout"):
        assert f"{column}/overall/accuracy" in run.data.metrics
    # Per label 25 sensors x 30 frames, an intercept, and two numbers of its logistic curve.
    assert run.data.metrics["parameters"] == 4 * (25 * 30 + 1 + 2)
    assert run.data.metrics["seconds_per_epoch"] > 0


@pytest.mark.slow("trains a peer")
def test_a_study_evaluates_a_finished_peer_under_its_conditions(ran):
    folder, _, study = ran
    assert study.returncode == 0, study.stderr
    lines = (folder / "out" / "study_dead.csv").read_text().splitlines()
    assert len(lines) == 1 + 4
    assert all(line.startswith("ridge naive") for line in lines[1:])


@pytest.mark.slow("trains each peer in its own environment")
@pytest.mark.skipif(not peers.python().is_file(), reason="no .venv-peers: make peers builds it")
@pytest.mark.parametrize("row", sorted({*peers.ROWS} - {"ridge"}))
def test_peers_learn_in_their_own_environment(configured, made_up_device, row, tmp_path):
    data = TouchData(made_up_device, instantiate(configured().representation), 32)
    learner, touches = build_learner(composed(row)), data.touches("test")
    learner.check(data)
    learner.fit(data)
    found = learner.probabilities(touches)
    assert ((found >= 0) & (found <= 1)).all()
    assert ((found > 0.5) == (touches.labels > 0.5)).float().mean() > 0.7
    assert learner.parameters > 100
    other = build_learner(composed(row))
    other.load(data, learner.save(tmp_path))
    # A feature counts values above a threshold, which rounding may cross.
    assert (other.probabilities(touches) - found).abs().max() < 0.05
