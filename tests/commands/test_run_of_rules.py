"""A finished run in the commands: where its alarm is raised, and its folder, by whose name it is used."""

import json
import re
import shutil
from contextlib import contextmanager

import numpy as np
import pytest

from tests.commands.conftest import query

SKIN = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive"]
SMALL = ["data.gestures=400", "device.test_gestures=96", "evaluation.devices=1", "evaluation.layouts=0"]
SMALL += ["evaluation.safe_gestures=200"]
FEW = "evaluation.devices=0"
LIVE = ["live.touch=0.3", "live.selftest=false", "seconds=1.2"]  # a training of seconds finds little


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    done = run(folder, "train", "experiment=rules", *SKIN, *SMALL)
    (folder / "said").write_text(done.stdout)
    (folder / "warned").write_text(done.stderr)
    return folder


def tag(folder):
    """Return the id of the training run, which is the oldest, and the operating point that it stores."""
    known = "select run_uuid, value from tags join runs using (run_uuid) where key='operating_point'"
    return query(folder, f"{known} order by start_time limit 1")[0]


def stored(folder):
    return json.loads(tag(folder)[1])


@contextmanager
def changed(folder, **values):
    """Store another operating point, or none, for a while."""
    run, text = tag(folder)
    write = "update tags set key=?, value=? where run_uuid=? and value=?"
    name, new = ("operating_point", json.dumps(json.loads(text) | values)) if values else ("old", text)
    query(folder, write, (name, new, run, text))
    yield
    query(folder, write, ("operating_point", text, run, new))


def test_a_training_stores_what_it_chose_and_says_what_it_reaches(folder):
    point = stored(folder)
    assert (point["safe"], point["target"], point["label"], point["seed"]) == (200, 0.02, "dangerous", 0)
    assert point["raised"] <= 3
    said = " ".join((folder / "said").read_text().split())
    chosen = f"alarm above {point['threshold']:.4f}, chosen on 200 fresh safe gestures for 2 % false alarms"
    assert chosen in said
    assert "dangerous/false_alarm_rate" in said
    assert re.search(r"false alarms: \d+ of 48 safe gestures, \d+\.\d % \(95 %: ", said)
    assert "2000 are needed" in (folder / "warned").read_text()
    metrics = dict(query(folder, "select key, value from latest_metrics"))
    assert metrics["alarm/threshold"] == point["threshold"]
    assert {"same/dangerous/alarm_recall", "device_shift/dangerous/false_alarm_rate"} <= metrics.keys()


def test_evaluate_raises_the_alarm_where_the_run_does(run, folder):
    with changed(folder, threshold=1e-9):
        done = run(folder, "evaluate", FEW, f"out={folder}/found")
    assert "false alarms: 48 of 48 safe gestures, 100.0 %" in done.stdout
    assert "alarm above 0.0000, chosen on 200 fresh safe gestures" in done.stdout
    page = next((folder / "found").glob("evaluation_simulated_*.md")).read_text()
    assert "| dangerous/false_alarm_rate | 100.0 |" in page
    assert "false alarms: 48 of 48 safe gestures" in page


def test_a_run_of_old_gets_its_threshold_now_and_that_is_said(run, folder):
    """It is the one that its training would have stored."""
    with changed(folder):
        done = run(folder, "evaluate", FEW, "device.seed=3", f"out={folder}/old")
    assert "stores no alarm threshold for 2 % false alarms, it is chosen now" in done.stderr
    assert f"alarm above {stored(folder)['threshold']:.4f}" in done.stdout


def test_an_unknown_profile_is_refused_before_anything_is_trained(run, folder, tmp_path):
    for where, words in ((folder, ["evaluate"]), (tmp_path, ["train", "experiment=rules", *SKIN])):
        done = run(where, *words, "evaluation.profile=none_such", code=2)
        assert done.stderr.count("\n") == 1
        assert "calibrated, drawn, harsh, mild, rough" in done.stderr
    assert not (tmp_path / "m.db").exists() or not query(tmp_path, "select * from runs")


@pytest.fixture
def port(played):
    """Give the port of a skin that is left alone for five seconds and then tapped, for each reader anew."""
    frames = np.zeros((60, 4))
    frames[54:57, 1] = 1.5
    rows = "".join(f"{n},{100_000 * n},{','.join(map(str, row))}\n" for n, row in enumerate(frames.tolist()))

    def say(reader, stop):
        reader.sendall(b"# skin proto=1 n=4 rate=10 unit=N\n" + rows.encode())
        reader.recv(1)  # until it has gone

    return f"device.port={played(say)}"


@pytest.mark.slow("starts a live view that waits for a tap")
@pytest.mark.parametrize(("above", "alarm"), [("0.00001", True), ("0.9999", False)])
def test_live_raises_the_alarm_where_it_is_told(run, folder, port, above, alarm):
    done = run(folder, "live.py", "device=serial", port, *LIVE, f"live.patience.above={above}")
    assert re.search(r"[1-9]\d* verdicts", done.stderr)
    assert ('"dangerous": true' in done.stdout) == alarm
    assert f"alarm above {float(above):g}" in done.stderr


@pytest.fixture(scope="module")
def published(run, folder):
    """Return the folder of the run, which is published there as ``small``."""
    assert run(folder, "export", "format=folder", "name=small", "licence=MIT").stdout == "models/small\n"
    return folder


@pytest.fixture
def model(published, tmp_path):
    shutil.copytree(published / "models" / "small", tmp_path / "models" / "small")
    return tmp_path / "models" / "small"


def test_the_folder_has_weights_configuration_hashes_and_card(published):
    assert [path.name for path in (published / "models").iterdir()] == ["small"]
    written = {path.name for path in (published / "models" / "small").iterdir()}
    assert written == {"README.md", "SHA256SUMS", "config.yaml", "rules.json", "run.json"}
    card = (published / "models" / "small" / "README.md").read_text()
    assert "`skin.learning.learner.Rules`" in card
    assert "Mlp" not in card


def test_its_name_is_a_run_where_the_run_itself_is_not(published, model, run):
    done = run(model.parents[1], "evaluate", "run=small")
    table = lambda text: [line for line in text.splitlines() if "accuracy" in line]  # noqa: E731
    assert len(table(done.stdout)) > 3
    assert table(done.stdout) == table((published / "said").read_text())


def test_an_altered_file_ends_a_command_with_a_sentence(model, run):
    with (model / "rules.json").open("a") as file:
        file.write(" ")
    for verb in ("evaluate", "live"):
        done = run(model.parents[1], verb, "run=small", code=2)
        assert "rules.json in " in done.stderr
        assert "differs from SHA256SUMS: restore the folder" in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (model.parents[1] / "results").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["licence=MIT"], "name=None is no name of a model"),
        (["name=../small", "licence=MIT"], "name=../small is no name of a model"),
        (["name=latest", "licence=MIT"], "name=latest is no name of a model"),
        (["name=new"], "add licence=MIT"),
        (["name=small", "licence=MIT"], "models/small exists"),
        (["name=new", "licence=MIT", "run=none"], "no finished training run none"),
        (["name=new", "licence=MIT", "out=x"], "not to out=x: add name=my_skin"),
    ],
)
def test_bad_input_ends_with_a_sentence(published, run, overrides, message):
    done = run(published, "export", "format=folder", *overrides, code=2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in (published / "models").iterdir()] == ["small"]


def test_weights_that_are_too_large_are_refused(published, run):
    code = "import skin.runs.run as m; from skin.commands.export import main; m._LARGEST = 100\n"
    code += "main(['format=folder', 'name=new', 'licence=MIT'{own}])"
    (published / "limited.py").write_text(code.format(own=f", 'tracking.uri=sqlite:///{published}/m.db'"))
    done = run(published, published / "limited.py", store=False, code=2)
    assert "are not one file of at most 0.0001 MB" in done.stderr
    assert [path.name for path in (published / "models").iterdir()] == ["small"]
