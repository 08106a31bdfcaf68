"""A run's configuration changes only in what the command line names."""

import pytest
from hydra import compose, initialize_config_dir

from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.configuration import recompose, settings_of, validate_config


def stored(*overrides):
    """Return a configuration as a run keeps it: every value final."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return validate_config(compose("train", list(overrides)))


def bring_back(run, *overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return settings_of(recompose(run, overrides))


def test_nothing_named_changes_nothing():
    run = stored("experiment=sequence_graph", "simulator=naive", "device.offset=0.3", "seed=4")
    back = bring_back(run, "run=latest")
    assert back == settings_of(run)


def test_only_what_is_named_changes():
    run = stored("experiment=sequence_graph", "simulator=naive", "device.offset=0.3")
    back = bring_back(run, "device.seed=7")
    assert (back["device"].pop("seed"), back["device"].pop("offset")) == (7, 0.3)
    before = settings_of(run)
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


OWN = """\
# @package _global_
defaults:
  - override /simulator: solid
body:
  _target_: skin.body.base.Sheet
  _convert_: all
  size: [0.30, 0.10]
  cells: [30, 20]
  layers: [{material: EcoFlex 00-30, thickness: 0.004}]
layout: {path: mine.csv, footprint: [0.008, 0.008]}
touch: {spare: 0.005}
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the files of a user's skin, as ``--config-dir`` names it."""
    (tmp_path / "body").mkdir()
    (tmp_path / "body" / "mine.yaml").write_text(OWN)
    return tmp_path


def with_folder(run, folder, *overrides):
    return bring_back(run, f"hydra.searchpath=[{folder}]", *overrides)


@pytest.mark.parametrize("trained", ["layout=file", "layout=grid"])
def test_all_that_a_chosen_option_sets_is_taken(folder, trained):
    back = with_folder(stored(trained, "device.offset=0.3"), folder, "body=mine")
    assert back["body"]["size"] == [0.30, 0.10]
    assert back["layout"]["_target_"] == "skin.body.layout.File"
    assert (back["layout"]["path"], back["layout"]["footprint"]) == ("mine.csv", [0.008, 0.008])
    assert (
        back["simulator"]["_target_"]
        == back["device"]["simulator"]["_target_"]
        == "skin.mechanics.simulator.solid.Solid"
    )
    assert back["touch"]["spare"] == back["device"]["touch"]["spare"] == 0.005
    # What the option does not set stays that of the run.
    assert (back["device"]["offset"], back["data"]["name"]) == (0.3, "fem")


def test_a_setting_equal_to_the_default_is_taken_too(folder):
    (folder / "body" / "mine.yaml").write_text(OWN.replace("0.008, 0.008", "0.010, 0.010"))
    back = with_folder(stored("layout.footprint=[0.02,0.02]"), folder, "body=mine")
    assert back["layout"]["footprint"] == [0.01, 0.01]


def test_the_command_line_takes_precedence_over_an_option(folder):
    back = with_folder(stored(), folder, "body=mine", "layout.path=other.csv", "simulator=naive")
    assert back["layout"]["path"] == "other.csv"
    assert back["simulator"]["_target_"].endswith("Naive")


def test_an_included_file_is_taken_too(folder):
    (folder / "body" / "long.yaml").write_text(
        "# @package _global_\ndefaults: [mine]\nbody: {size: [0.4, 0.1]}\n"
    )
    back = with_folder(stored(), folder, "body=long")
    assert (back["body"]["size"], back["layout"]["path"]) == ([0.4, 0.1], "mine.csv")


def test_an_option_cannot_change_what_the_weights_depend_on(folder):
    (folder / "body" / "mine.yaml").write_text(f"{OWN}trainer: {{gradient_clip_val: 1.0}}\n")
    with pytest.raises(InputError, match=r"trainer\.gradient_clip_val was fixed"):
        with_folder(stored(), folder, "body=mine")
    trained = stored("+trainer.gradient_clip_val=1.0")
    assert with_folder(trained, folder, "body=mine")["layout"]["path"] == "mine.csv"


def test_what_has_no_effect_in_a_training_has_none_on_a_run(folder):
    (folder / "body" / "mine.yaml").write_text(f"{OWN}evaluation: {{devices: 3}}\n")
    assert with_folder(stored("evaluation.devices=7"), folder, "body=mine")["evaluation"]["devices"] == 7


def test_a_profile_changes_only_its_settings_of_the_device():
    back = bring_back(stored("device.offset=0.3"), "profile=mild")
    assert back["device"]["offset"] == 0.3
    assert back["device"]["noise"] == stored("profile=mild").device["noise"]
