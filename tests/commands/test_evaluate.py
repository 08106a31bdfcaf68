"""Evaluating a run again gives what its training found."""

from dataclasses import replace

import pytest

from skin.device.files import read_recording, write_recording
from tests.commands.conftest import query

SMALL = ["data.gestures=160", "device.test_gestures=96", "evaluation.devices=1", "evaluation.layouts=1"]
SMALL += ["evaluation.safe_gestures=64"]


def metrics(folder):
    runs = query(folder, "select run_uuid from runs where status='FINISHED' order by start_time")
    ask = "select key, value from latest_metrics where run_uuid=? and key like '%/accuracy'"
    return [dict(query(folder, ask, one)) for one in runs]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """A folder with one finished run of the quickest row that has weights."""
    folder = tmp_path_factory.mktemp("runs")
    run(folder, "train.py", "experiment=temporal_graph", "trainer.max_epochs=1", *SMALL)
    return folder


@pytest.mark.slow("trains and evaluates a run")
def test_the_same_device_gives_the_same_figures(run, folder):
    done = run(folder, "evaluate.py")
    trained, evaluated = metrics(folder)[0], metrics(folder)[-1]
    assert len(trained) == 20
    assert evaluated == pytest.approx(trained, abs=1e-6)
    assert f"{100 * trained['same/overall/accuracy']:.1f}" in done.stdout
    (page,) = (folder / "results").glob("evaluation_*.md")
    assert ", evaluated with the settings of the run, 96 gestures." in page.read_text()


@pytest.mark.slow("trains and evaluates a run")
def test_touches_without_labels_get_verdicts(run, folder, tmp_path):
    run(tmp_path, "generate", "simulator=naive", "n=12", "out=x.parquet", store=False)
    known = read_recording(tmp_path / "x.parquet")
    bare = replace(known, touches=replace(known.touches, labels=None))
    path = write_recording(bare, tmp_path / "y.parquet")
    run(folder, "evaluate", "device=recording", f"device.path={path}", "device.test=all")
    (written,) = (folder / "results").glob("evaluation_recording_*.csv")
    assert len(written.read_text().splitlines()) == 1 + 12
