"""A run counts as finished only with all its results."""

import re

import pytest

import skin.run
from skin.config import ROOT, checked
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = (
    "experiment=linked_graph",
    "simulator=naive",
    "data.gestures=64",
    "trainer.max_epochs=1",
    "device.test_gestures=32",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
    "evaluation.gestures=32",
)


@pytest.fixture
def config(configured, tmp_path):
    """Return a small training that logs to a folder of its own."""
    return checked(
        configured(
            *SMALL, f"tracking.uri=sqlite:///{tmp_path}/runs.db", f"tracking.artifacts={tmp_path}/artifacts"
        )
    )


@pytest.mark.slow
def test_a_run_stays_open_until_its_results_are_logged(config, monkeypatch):
    seen = []
    evaluate = skin.run.evaluate

    def looking(*arguments):
        # What a kill would leave behind between training and evaluation.
        seen.extend(run.info.status for run in Store.open(config.tracking).find())
        return evaluate(*arguments)

    monkeypatch.setattr(skin.run, "evaluate", looking)
    assert skin.run.train(config) is True
    assert seen == ["RUNNING"]
    (run,) = Store.open(config.tracking).find("FINISHED")
    assert run.data.metrics["parameters"] == 196
    assert {"same/overall/accuracy", "train_loss", "val_loss", "seconds_per_epoch"} <= set(run.data.metrics)
    assert skin.run.train(config) is False
    page = (ROOT / "docs" / "mlflow.md").read_text()
    for name in run.data.metrics:
        # train_accuracy_press is told of as train_accuracy
        parts = name.split("/") if f"`{name}`" not in page else [name]
        parts = [re.sub("(_accuracy)_[a-z]+$", r"\1", part) for part in parts]
        assert all(f"`{part}`" in page for part in parts), name


def test_a_run_is_found_by_what_simulated_it_and_not_by_the_name_of_its_data(configured):
    assert skin.run.tags(configured("simulator=solid", "data=fem"))["simulator"] == "solid"
    for simulator in ("naive", "fem", "solid"):
        assert skin.run.tags(configured(f"simulator={simulator}"))["simulator"] == simulator


@pytest.mark.parametrize("device", ["recording", "serial", "cost"])
def test_a_device_without_simulator_stands_in_its_place(device, configured):
    assert skin.run.tags(configured(f"device={device}"))["simulator"] == device
