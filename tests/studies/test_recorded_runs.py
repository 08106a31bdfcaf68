"""Recorded results replace a lost database, except where weights are needed."""

import csv
import sqlite3
from contextlib import closing
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from experiments.studies.recorded_runs import export_runs, import_runs, read_records, write_records
from skin.config import Tracking
from skin.errors import InputError
from skin.finished_run import MissingWeightsError, find_pretrained
from skin.model_of_run import load_run
from skin.paths import ROOT
from skin.tracking import Store
from tests.damage import DAMAGED_FILES, damaged, opened

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = ["data.gestures=160", "device.test_gestures=64", "evaluation.devices=0", "evaluation.layouts=0",
         "evaluation.safe_gestures=64"]  # fmt: skip
TABLE = ["table.simulators=[naive]", "table.seeds=2", "experiment=linked_graph", "trainer.max_epochs=1",
         *SMALL]  # fmt: skip
STUDY = ["study=dead", "simulator=naive", "study.devices=1", "device.test_gestures=48"]


def at(folder):
    """Return the settings of a database in a folder."""
    return Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None)


def names(folder):
    """Return the names of the runs in a database."""
    with closing(sqlite3.connect(folder / "m.db")) as store:
        return sorted(
            name for (name,) in store.execute("select name from runs where lifecycle_stage = 'active'")
        )


def record(fingerprint, **more):
    """Return a record of a training, or of a trial on it."""
    tags = {"fingerprint": fingerprint} if not more else {"evaluated": fingerprint, **more}
    metrics = {"same/overall/accuracy": 0.1 + 0.2}
    files = {"outcomes.npy": b"\0\1"}
    about = {"experiment": "skin", "name": "made up", "start": 1000, "end": 3000}
    return about | {"tags": tags, "params": {"row": "a"}, "metrics": metrics, "files": files}


@pytest.fixture
def made_up(tmp_path):
    """A file with a training, a trial on it, and another training."""
    path = tmp_path / "runs.parquet"
    write_records([record("a" * 16), record("a" * 16, study="b"), record("c" * 16)], path)
    return path


def test_records_become_finished_runs_once(made_up, tmp_path):
    assert import_runs(at(tmp_path), made_up) == 3
    store = Store.open(at(tmp_path))
    (training,) = store.find("FINISHED", fingerprint="a" * 16)
    (trial,) = store.find("FINISHED", study="b")
    assert trial.data.tags["mlflow.parentRunId"] == training.info.run_id
    assert (training.info.start_time, training.info.end_time) == (1000, 3000)
    assert training.data.tags["recorded"] == "runs.parquet"
    assert training.data.metrics == {"same/overall/accuracy": 0.1 + 0.2}
    assert training.data.params == {"row": "a"}
    path = store.client.download_artifacts(training.info.run_id, "outcomes.npy", str(tmp_path))
    assert Path(path).read_bytes() == b"\0\1"
    assert import_runs(at(tmp_path), made_up) == 0


def test_a_newer_record_is_imported_too(made_up, tmp_path):
    import_runs(at(tmp_path), made_up)
    write_records([record("a" * 16) | {"start": 2000, "metrics": {"x": 1.0}}, record("c" * 16)], made_up)
    assert import_runs(at(tmp_path), made_up) == 1
    assert Store.open(at(tmp_path)).find("FINISHED", fingerprint="a" * 16)[0].data.metrics == {"x": 1.0}


def test_an_imported_run_has_the_weights_of_the_pretrained_model_that_it_is(tmp_path):
    known = find_pretrained("default_skin")
    records = read_records(ROOT / "docs/results/runs.parquet")
    own = [one for one in records if one["tags"].get("fingerprint") == known.data.tags["fingerprint"]]
    write_records(own, tmp_path / "runs.parquet")
    import_runs(at(tmp_path), tmp_path / "runs.parquet")
    uri = f"sqlite:///{tmp_path}/m.db"
    imported, copied = (load_run(name, uri) for name in (own[0]["tags"]["fingerprint"], "default_skin"))
    touches = copied.device.touches("test")[slice(8)]
    assert torch.equal(imported.predict(touches), copied.predict(touches))


def test_an_imported_run_of_another_training_has_no_weights(tmp_path):
    """It was trained again, with the same settings."""
    known = find_pretrained("default_skin")
    records = read_records(ROOT / "docs/results/runs.parquet")
    (own,) = (one for one in records if one["tags"].get("fingerprint") == known.data.tags["fingerprint"])
    write_records([own | {"start": own["start"] + 1}], tmp_path / "runs.parquet")
    import_runs(at(tmp_path), tmp_path / "runs.parquet")
    with pytest.raises(MissingWeightsError, match="without its weights"):
        load_run(own["tags"]["fingerprint"], f"sqlite:///{tmp_path}/m.db")


def test_imported_runs_can_be_ignored(made_up, tmp_path):
    import_runs(at(tmp_path), made_up)
    settings = at(tmp_path)
    settings.recorded = False
    assert not Store.open(settings).find("FINISHED")


def test_export_keeps_what_published_files_name(made_up, tmp_path):
    """Neither run is in the database."""
    (tmp_path / "seeds.csv").write_text(f"row,run\nx,{'a' * 16}\n")
    before = [one for one in read_records(made_up) if one["tags"].get("fingerprint") != "c" * 16]
    assert export_runs(at(tmp_path), made_up, tmp_path) == 2
    assert read_records(made_up) == before


def test_export_of_imported_runs_is_the_same_file(made_up, tmp_path):
    (tmp_path / "seeds.csv").write_text(f"row,run\nx,{'a' * 16}\ny,{'c' * 16}\n")
    import_runs(at(tmp_path), made_up)
    again = tmp_path / "again.parquet"
    assert export_runs(at(tmp_path), again, tmp_path) == 3
    assert again.read_bytes() == made_up.read_bytes()


def test_pictures_are_not_recorded(made_up, tmp_path):
    (tmp_path / "seeds.csv").write_text(f"row,run\nx,{'a' * 16}\n")
    page = {"files": {"page.csv": b"1", "page.png": b"2"}}
    write_records([record("a" * 16), record("a" * 16, study="b") | page], made_up)
    import_runs(at(tmp_path), made_up)
    again = tmp_path / "again.parquet"
    assert export_runs(at(tmp_path), again, tmp_path) == 2
    assert {name for one in read_records(again) for name in one["files"]} == {"outcomes.npy", "page.csv"}


@pytest.mark.parametrize("content", [b"", b"no table"])
def test_another_file_is_refused(tmp_path, content):
    path = tmp_path / "runs.parquet"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"results\.file=FILE"):
        read_records(path)


def test_without_published_files_nothing_is_written(tmp_path):
    with pytest.raises(InputError, match="skin table"):
        export_runs(at(tmp_path), tmp_path / "runs.parquet", tmp_path)
    assert not (tmp_path / "runs.parquet").exists()


@pytest.fixture(scope="module")
def published(run, tmp_path_factory):
    """A folder with a table, a study and the file of their runs; and what the commands printed."""
    folder = tmp_path_factory.mktemp("published")
    export = ["results.action=export", "results.file=runs.parquet", "out=docs"]
    done = [
        run(folder, "table", *TABLE, "out=docs"),
        run(folder, "study", *STUDY, "out=docs"),
        run(folder, "results", *export),
    ]
    assert [one.returncode for one in done] == [0, 0, 0], [one.stderr for one in done]
    return folder


@pytest.fixture(scope="module")
def restored(run, published, tmp_path_factory):
    """A folder whose database was filled from that file."""
    folder = tmp_path_factory.mktemp("restored")
    done = run(folder, "results", "results.action=import", f"results.file={published}/runs.parquet")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_a_lost_database_costs_nothing(run, published, restored):
    before = names(restored)
    table, study = (
        run(restored, "table", *TABLE, "out=docs"),
        run(restored, "study", *STUDY, "out=docs"),
    )
    assert (table.returncode, study.returncode) == (0, 0), table.stderr + study.stderr
    assert names(restored) == before
    assert table.stdout.count("was finished before") == 2
    for name in ("table.csv", "table_seeds.csv", "study_dead.csv", "figure07_speed_naive.csv"):
        assert (restored / "docs" / name).read_text() == (published / "docs" / name).read_text()


@pytest.mark.slow
def test_every_seed_is_published_with_its_fingerprint(published):
    with (published / "docs" / "table_seeds.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    rows = [(line["row"], line["seed"]) for line in lines]
    assert sorted(rows) == [("linked_graph", "0"), ("linked_graph", "1")]
    stored = {one["tags"].get("fingerprint") for one in read_records(published / "runs.parquet")}
    assert {line["run"] for line in lines} <= stored


@pytest.mark.slow
def test_nothing_of_the_machine_is_recorded(published):
    text = str(read_records(published / "runs.parquet"))
    assert "config.yaml" in text
    for private in (str(published), "mlflow.user", "tracking:", "process'"):
        assert private not in text


@pytest.mark.slow
def test_what_needs_weights_says_how_to_train_them(run, restored):
    words = ["study=misplaced", *STUDY[1:], "study.rows=[linked_graph]", "out=x"]
    refused = run(restored, "study", *words)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1), refused.stderr
    assert "without its weights: tracking.recorded=false trains it again" in refused.stderr
    missing = run(restored, "evaluate", "run=latest")
    assert (missing.returncode, "no finished training run" in missing.stderr) == (2, True), missing.stderr
    words = ["experiment=linked_graph", "simulator=naive", "trainer.max_epochs=1", *SMALL]
    again = run(restored, "train", "-m", *words, "seed=0,1", "tracking.recorded=false")
    assert (again.returncode, again.stdout.count("took")) == (0, 2), again.stderr
    done = run(restored, "study", "study=misplaced", *STUDY[1:], "study.rows=[linked_graph]", "out=x")
    assert done.returncode == 0, done.stderr


@DAMAGED_FILES
@given(data=st.data())
def test_damage_never_passes_for_results(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "whole.parquet"
    if not path.exists():
        write_records([record("a" * 16), record("a" * 16, study="b"), record("c" * 16)], path)
    (folder / "damaged.parquet").write_bytes(data.draw(damaged(path.read_bytes())))
    assert opened(lambda: read_records(folder / "damaged.parquet")) in (None, read_records(path))


def test_the_published_results_have_a_checksum(tmp_path):
    content = bytearray((ROOT / "docs/results/runs.parquet").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "runs.parquet").write_bytes(content)
    with pytest.raises(InputError, match="its checksum is not that of its content: restore it"):
        read_records(tmp_path / "runs.parquet")


@pytest.mark.parametrize("wrong", ["null", "columns"])
def test_results_without_a_value_are_refused(made_up, tmp_path, wrong):
    table = pq.read_table(made_up)
    name = pa.nulls(len(table), pa.string())
    table = table.set_column(1, "name", name) if wrong == "null" else table.drop_columns("name")
    pq.write_table(table.replace_schema_metadata(None), tmp_path / "x.parquet")
    with pytest.raises(InputError, match="a run has no name" if wrong == "null" else "it has other columns"):
        read_records(tmp_path / "x.parquet")
