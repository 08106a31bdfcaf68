"""A run's configuration changes only in what the command line names."""

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from skin.config import plain, validate_config
from skin.errors import InputError
from skin.paths import CONF
from skin.run_overrides import apply_overrides


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("evaluate", list(overrides))


def stored(*overrides):
    """Return a configuration as a run keeps it: every value final."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.create(plain(validate_config(compose("train", list(overrides)))))


def bring_back(run, *overrides):
    return plain(apply_overrides(run, composed(*overrides), overrides))


def test_nothing_named_changes_nothing():
    run = stored("experiment=sequence_graph", "simulator=naive", "device.offset=0.3", "seed=4")
    back = bring_back(run, "run=latest")
    assert {key: back[key] for key in run} == plain(run)


def test_only_what_is_named_changes():
    run = stored("experiment=sequence_graph", "simulator=naive", "device.offset=0.3")
    back = bring_back(run, "device.seed=7")
    assert (back["device"].pop("seed"), back["device"].pop("offset")) == (7, 0.3)
    before = plain(run)
    assert before["device"].pop("seed") == 0
    before["device"].pop("offset")
    assert back["device"] == before["device"]


def test_another_simulator_reaches_the_device():
    run = stored("simulator=fem")
    assert bring_back(run, "simulator=naive")["device"]["simulator"]["_target_"].endswith("Naive")


def test_what_the_device_had_of_its_own_stays():
    run = stored("data.gestures=60", "device.gestures=50")
    assert bring_back(run, "data.gestures=99")["device"]["gestures"] == 50
    assert bring_back(stored("data.gestures=60"), "data.gestures=99")["device"]["gestures"] == 99


def test_another_device_replaces_the_whole_group():
    back = bring_back(stored(), "device=recording", "device.path=x.parquet")
    assert back["device"]["path"] == "x.parquet"
    assert back["device"]["_target_"] == "skin.device.recording.Recorded"
    assert "offset" not in back["device"]


@pytest.mark.parametrize("override", ["seed=1", "experiment=rules", "model.dropout=0", "learner.hidden=[8]"])
def test_what_the_weights_depend_on_is_refused_by_name(override):
    with pytest.raises(InputError, match=override.split("=")[0].replace(".", r"\.")):
        bring_back(stored(), override)
