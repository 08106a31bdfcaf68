"""A run is the same one on another machine, with moved modules, and in a later version."""

from copy import deepcopy
from pathlib import Path

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from skin.config import fingerprint, plain, validate_config
from skin.fingerprint import RENAMED, config_hash, renamed

OLD = OmegaConf.load(Path(__file__).with_name("earlier_run.yaml"))

CLASSES = {
    "body": ["arm.Arm", "sheet.Sheet"],
    "contact": ["prescribed.Prescribed", "rigid.Rigid"],
    "device": ["cost.Cost", "recording.Recorded", "serial.Serial", "simulated.Simulated"],
    "fusion": ["early.Early", "late.Late", "linked.Linked"],
    "layout": ["file.File", "grid.Grid", "scattered.Scattered"],
    "learner": ["ensemble.Ensemble", "features.Features", "network.Network", "rules.Rules"],
    "model": ["cnn.Cnn", "efficientnet.EfficientNet", "gcn.Gcn", "mlp.Mlp", "transformer.Transformer"],
    "representation": [
        "fourier.Fourier",
        "graph.Graph",
        "image.Image",
        "interp.Interpolation",
        "measured.Measured",
        "readings.Readings",
    ],
    "simulator": ["fem.PlatesAndBeams", "naive.Naive", "solid.Solid"],
}


@pytest.mark.parametrize(
    ("group", "name"), [(group, name) for group, names in CLASSES.items() for name in names]
)
def test_every_class_that_an_older_run_names_is_found(group, name):
    found = renamed({"_target_": f"skin.{group}.{name}"})["_target_"]
    assert get_class(found).__module__ == found.rpartition(".")[0]


def test_an_older_configuration_keeps_its_hash():
    """51e8… is what the program of that time made of it."""
    old = plain(OLD)
    old.pop("tracking")
    assert config_hash(old) == "51e8fd45fa9b1f8b"


def test_todays_run_differs_from_the_older_one_by_its_evaluation_alone(configured):
    now = plain(validate_config(configured("experiment=temporal_graph", "simulator=naive")))
    now = {key: one for key, one in now.items() if key not in ("tracking", "trust") and one is not None}
    assert config_hash(now) != "51e8fd45fa9b1f8b"
    now["evaluation"] = plain(OLD)["evaluation"]
    assert config_hash(now) == "51e8fd45fa9b1f8b"


@pytest.mark.parametrize(
    "overrides",
    [
        ["trainer.precision=bf16-mixed"],
        ["trainer.devices=2", "trainer.strategy=ddp", "+trainer.num_nodes=2"],
        ["trainer.accelerator=gpu"],
        ["+trainer.enable_progress_bar=true"],
        ["tracking.threads=1"],
    ],
)
@pytest.mark.parametrize("learner", ["network", "ensemble"])
def test_the_machine_makes_no_other_run(configured, overrides, learner):
    assert fingerprint(configured(f"learner={learner}", *overrides)) == fingerprint(
        configured(f"learner={learner}")
    )


def test_a_class_that_moved_is_the_same_class(configured, monkeypatch):
    before = plain(configured("experiment=best"))
    now = deepcopy(before)
    for model in (now["model"], now["learner"]["members"]["network"]["model"]):
        assert model["_target_"] == "skin.model.mlp.Mlp"
        model["_target_"] = "skin.network.dense.Dense"
    assert config_hash(now) != config_hash(before)
    monkeypatch.setitem(RENAMED, "skin.model.mlp.Mlp", "skin.network.dense.Dense")
    assert config_hash(now) == config_hash(before)
    assert renamed(before) == now
    assert renamed([{"_target_": ["skin.model.mlp.Mlp"]}]) == [{"_target_": ["skin.model.mlp.Mlp"]}]


def test_only_classes_that_moved_are_listed():
    for old, new in RENAMED.items():
        assert old != new
        assert new not in RENAMED, "the table leads to the last name at once"


RENAMED_OPTIONS = {
    "experiment=features": "skin.learner.features.Features",
    "representation=features": "skin.representation.measured.Measured",
}


@pytest.mark.parametrize("override", RENAMED_OPTIONS)
def test_a_renamed_option_keeps_its_fingerprint(configured, override):
    now = plain(validate_config(configured(override, "model=mlp")))
    group, old = RENAMED_OPTIONS[override].split(".")[1], deepcopy(now)
    old[group]["_target_"] = RENAMED_OPTIONS[override]
    assert old != now
    assert renamed(old) == now
    assert config_hash(old) == config_hash(now)


def test_a_data_set_counts_by_its_manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hashes = []
    for manifest in (None, "one", "other"):
        if manifest:
            (tmp_path / "touches").mkdir(exist_ok=True)
            (tmp_path / "touches" / "manifest.json").write_text(manifest)
        hashes.append({config_hash({"path": path}) for path in ("touches", "./touches")})
    assert len(set.union(*hashes)) == 6
