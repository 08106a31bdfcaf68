"""A sweep's parent run is named by what is swept and tells what came of each variant."""

import json
from pathlib import Path

import pytest

from skin.config import Tracking
from skin.tracking import Store
from skin.variants import log_variants, sweep_title

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


def test_a_title_tells_what_is_swept():
    jobs = [{"row": "x", "+model.norm": norm, "seed": seed} for norm in ("none", "layer") for seed in "01"]
    assert sweep_title(jobs, ["+model.norm", "seed"]) == "model.norm=none,layer × seed=0,1"
    assert sweep_title(jobs, []) == ""


def test_a_title_fits_into_the_database():
    found = sweep_title([{"seed": str(seed)} for seed in range(1000)], ["seed"])
    assert len(found) == 250
    assert found.endswith("…")


def test_each_variant_has_its_metrics_and_its_row(tmp_path):
    store = Store.open(Tracking(f"sqlite:///{tmp_path}/m.db", f"{tmp_path}/a", "skin", True, None))
    runs = []
    for accuracy, others in (
        (0.5, {"same/dangerous/alarm_recall": 0.25}),
        (0.75, {}),
        (1.0, {"train_loss": 3.0}),
    ):
        with store.run("a run", {}) as run:
            store.log_metrics(run, {"same/overall/accuracy": accuracy, "same/big/accuracy": 0.1} | others)
        runs.append(store.client.get_run(run.info.run_id))
    parent = store.create("parent", {})
    log_variants(store, parent, ["model.norm"], {("layer",): runs[:2], ("[8]",): runs[2:]})
    place = "model.norm layer"
    found = store.client.get_run(parent.info.run_id).data
    assert "variants.json" in found.tags["mlflow.loggedArtifacts"]  # by which the UI shows a table
    assert found.metrics == {
        f"n/{place}": 2,
        f"mean/same/overall/accuracy/{place}": 0.625,
        f"sd/same/overall/accuracy/{place}": pytest.approx(0.125 * 2**0.5),
        f"mean/same/dangerous/alarm_recall/{place}": 0.25,
    }
    path = store.client.download_artifacts(parent.info.run_id, "variants.json", str(tmp_path))
    table = json.loads(Path(path).read_text())
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["data"]]
    assert [(row["model.norm"], row["n"], row["mean/same/overall/accuracy"]) for row in rows] == [
        ("layer", 2, 0.625),
        ("[8]", 1, 1.0),
    ]
    assert rows[0]["runs"] == f"{runs[0].info.run_id} {runs[1].info.run_id}"
    assert rows[1]["sd/same/overall/accuracy"] is None
