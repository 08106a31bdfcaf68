"""The command finds finished runs, trains what is missing, measures, and gives verdicts."""

import csv
import sqlite3
from contextlib import closing

import pytest
from PIL import Image

from skin.runs.configuration import fingerprint
from skin.runs.store import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = ["data.gestures=160", "device.test_gestures=64", "evaluation.devices=0", "evaluation.layouts=0",
         "evaluation.safe_gestures=64"]  # fmt: skip
NAIVE = ["simulator=naive", *SMALL]


def runs(folder):
    """Return the names and statuses of all runs."""
    with closing(sqlite3.connect(folder / "m.db")) as store:
        return store.execute("select name, status from runs order by start_time").fetchall()


def evaluated_accuracy(folder):
    """Return the accuracy of the first evaluation."""
    with closing(sqlite3.connect(folder / "m.db")) as store:
        (value,) = store.execute(
            "select value from latest_metrics join runs using (run_uuid) where name like 'evaluation of%' "
            "and key = 'same/overall/accuracy'"
        ).fetchone()
    return value


def lines(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, configured):
    """A store with finished runs of one study: silu has 80, 81, 82 %, relu 10 points less, elu 10 more."""
    folder = tmp_path_factory.mktemp("studies")
    row = ["experiment=temporal_graph", "evaluation.devices=0"]
    row += ["evaluation.layouts=0", "tracking.experiment=studies", f"tracking.uri=sqlite:///{folder}/m.db"]
    for activation, gain in (("silu", 0.0), ("relu", -0.1), ("elu", 0.1)):
        for seed in range(3):
            own = [f"model.activation={activation}", f"learner.activation={activation}", f"seed={seed}"]
            config = configured(*row, *own)
            store = Store.open(config.tracking)
            # 0.002 more or less, that the differences have a spread
            value = 0.8 + gain * (1 + 0.02 * seed) + 0.01 * seed
            with store.run("made up", {"fingerprint": fingerprint(config)}) as run:
                store.log_metrics(run, {"same/overall/accuracy": value, "seconds_per_epoch": 1.0})
    return folder


@pytest.mark.slow("composes nine runs twice and draws their page")
def test_finished_runs_are_found_and_judged(run, folder):
    done = run(
        folder, "study", "study=models", "study.part=activation", "study.seeds=[0,1,2]", f"out={folder}/r"
    )
    assert done.returncode == 0, done.stderr
    assert "…" not in done.stdout, "nothing was to be trained"
    page = (folder / "r" / "study_activation.md").read_text()
    assert "| activation=silu | 81.0 ± 2.5 |" in page
    assert "+10.2 ± 0.5 points (activation=relu); -10.2 ± 0.5 points (activation=elu) | disagree |" in page
    assert len(lines(folder / "r" / "study_activation.csv")) == 9
    assert {path.suffix for path in (folder / "r").iterdir()} == {".md", ".csv", ".png"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "which study"),
        (["study=margin"], "margins"),
        (["study=models", "study.statements=[{id: a, says: b}]"], "study.statements[0]"),
    ],
)
def test_bad_input_ends_with_code_2_and_imports_nothing_heavy(arguments, named, light, tmp_path):
    done = light(tmp_path, "study", *arguments)
    assert (done.returncode, {*done.stdout.split()} - {"numpy"}) == (2, set()), done.stderr
    assert named in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("trains several rows")
def test_what_is_missing_is_trained_and_what_failed_is_told(run, tmp_path):
    # graph convolutions know this pooling, the transformer does not
    few = ["smoke=true", "study.seeds=[0]", "simulator=naive", "+model.pooling=attention", "out=r"]
    done = run(tmp_path, "study", "study=models", "study.part=transformer", *few)
    assert done.returncode == 1, done.stderr
    assert done.stdout.count("took") == 1
    assert all(
        setting in done.stdout.replace("\n", "")
        for setting in ("data.gestures=80", "device.test_gestures=48")
    )
    page = (tmp_path / "r" / "smoke" / "study_transformer.md").read_text()
    assert "SMOKE" in done.stdout
    assert "SMOKE" in page
    body = page.split("\n\n")[2].splitlines()[2:]
    assert [line.count("(1 failed) | failed |") for line in body] == [0, 1, 1]
    assert done.stderr.count("failed: model.pooling=attention must be 'mean' or 'max'") == 2


@pytest.fixture(scope="module")
def trained(run, tmp_path_factory):
    """A folder with finished runs of two rows."""
    folder = tmp_path_factory.mktemp("finished")
    for words in (["experiment=rules"], ["experiment=temporal_graph", "trainer.max_epochs=1"]):
        done = run(folder, "train", *words, *NAIVE)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow("evaluates trained rows")
def test_finished_runs_are_tried_under_conditions_once(run, trained):
    words = ["study=robustness", "study.part=dead", "simulator=naive", "study.devices=2"]
    words += ["device.test_gestures=48", "out=dead"]
    done = run(trained, "study", *words)
    assert done.returncode == 0, done.stderr
    found = lines(trained / "dead" / "study_dead.csv")
    assert [line["condition"] for line in found[::2]] == ["0 dead", "1 dead", "3 dead", "5 dead"] * 2
    assert {line["variant"].split()[0] for line in found} == {"rules", "temporal_graph"}
    assert all(0.25 < float(line["same/overall/accuracy"]) < 1 for line in found)
    assert "undecided" in done.stdout
    before, files = runs(trained), {path: path.stat().st_mtime_ns for path in trained.rglob("*-*.parquet")}
    assert len(files) == 2 * 4 * 2
    again = run(trained, "study", *words)
    assert (again.returncode, again.stdout) == (0, done.stdout), again.stderr
    assert runs(trained) == before
    assert [name for name, _ in before].count("study dead") == 1
    assert {path: path.stat().st_mtime_ns for path in trained.rglob("*-*.parquet")} == files
    assert lines(trained / "dead" / "study_dead.csv") == found
    refused = run(trained, "study", *words[:3], "study.rows=[gru]")
    assert refused.returncode == 2
    assert "no finished run of gru" in refused.stderr


@pytest.mark.slow("evaluates trained rows")
def test_a_condition_changes_the_device_as_an_evaluation_does(run, trained):
    """Independent answer: skin evaluate with the same settings."""
    few = ["simulator=naive", "study.rows=[rules]", "study.devices=1", "device.test_gestures=48"]
    done = run(trained, "study", "study=robustness", "study.part=misplaced", *few, "out=misplaced")
    assert done.returncode == 0, done.stderr
    found = {line["condition"]: line for line in lines(trained / "misplaced" / "study_misplaced.csv")}
    device = ["device.seed=1", "device.position_error=0.005", "device.test_gestures=48"]
    done = run(trained, "evaluate", f"run={found['5 mm']['run']}", *device, "evaluation.devices=0",
               "evaluation.layouts=0", "out=e")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert float(found["5 mm"]["same/overall/accuracy"]) == pytest.approx(evaluated_accuracy(trained))
    assert found["5 mm"]["same/overall/accuracy"] != found["0 mm"]["same/overall/accuracy"]


@pytest.mark.slow("evaluates trained rows")
def test_verdicts_are_sorted_by_margins(run, trained):
    few = ["study.rows=[rules,temporal_graph]", "simulator=naive", "out=margins"]
    done = run(trained, "study", "study=margins", "study.measure.gestures=400", *few)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert "within 10 % of their thresholds lie " in said[0]
    assert "chosen on 64 fresh safe gestures for 2 % false alarms, finds " in said[0]
    (path,) = (trained / "margins").glob("margins_rules_*.csv")
    ways = [
        [one for one in lines(path) if (one["label"], one["by"]) == ("big", way)]
        for way in ("threshold", "reading")
    ]
    assert [sum(int(one["touches"]) for one in each) for each in ways] == [400, 400]
    wrong, also = (sum(int(one["wrong"]) for one in each) for each in ways)
    assert wrong == also > 0
    assert f"of {wrong} errors of big" in said[0]
    assert "## alarm by threshold" in path.with_suffix(".md").read_text()
    with Image.open(path.with_suffix(".png")) as picture:
        assert picture.size[0] > 800
    joined, head = lines(trained / "margins" / "study_margins.csv"), list(lines(path)[0])
    assert {one["variant"].split()[0] for one in joined} == {"rules", "temporal_graph"}
    own = [one for one in joined if one["variant"].startswith("rules")]
    assert [{name: one[name] for name in head} for one in own] == lines(path)


@pytest.mark.slow("evaluates trained rows")
def test_every_course_is_played_and_no_alarm_ends_early(run, trained):
    few = ["study.rows=[rules]", "simulator=naive", "out=holds"]
    done = run(trained, "study", "study=holds", "study.measure.gestures=2", "study.measure.rate=10", *few)
    assert done.returncode == 0, done.stderr
    found = lines(next((trained / "holds").glob("holds_rules_*.csv")))
    assert len(found) == 9
    assert {one["course"] for one in found} >= {"tap", "press", "hold 600 s", "ramp 10 s"}
    assert all(one["kept"] == one["touches"] for one in found)
    assert sum(int(one["alarms"]) for one in found) > 0
    assert f"course {found[0]['course']}, touches 2" in done.stdout


@pytest.mark.slow("evaluates trained rows")
def test_a_run_is_probed_beside_graph_embeddings(run, trained):
    few = ["train=80", "test=40", "seeds=[0]", "epochs=2", "layouts=2", "attributes=[reading]"]
    words = ["study.rows=[temporal_graph]", "simulator=naive", *(f"study.measure.{one}" for one in few)]
    done = run(trained, "study", "study=embeddings", *words, "out=embeddings")
    assert done.returncode == 0, done.stderr
    (path,) = (trained / "embeddings").glob("embeddings_temporal_graph_*.md")
    assert path.with_suffix(".png").is_file()
    text = path.read_text()
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")]
    assert rows == ["input", "Graph2Vec, reading",
                    "GL2Vec, reading", "IGE, reading", "trained encoder", "readings, one frame",
                    "readings, window"]  # fmt: skip
    assert text.count("**undecided**") == 3  # one seed decides nothing


@pytest.mark.slow("trains with every simulator")
def test_every_simulator_against_every_other(run, tmp_path):
    skin = ["body.cells=[8,8]", "layout=grid", "layout.rows=3", "layout.columns=3", "touch.redraws=100",
            "touch.small_area=[0.1,0.3]", "study.rows=[rules]", "study.seeds=[0]", "out=r"]  # fmt: skip
    done = run(tmp_path, "study", "study=mechanics", "study.part=crosscheck", *skin, *SMALL)
    assert done.returncode == 0, done.stderr
    found = lines(tmp_path / "r" / "study_crosscheck.csv")
    names = ["naive", "fem, equation 10", "fem, interface", "solid"]
    assert [(line["variant"], line["condition"]) for line in found] == [(a, b) for a in names for b in names]
    assert all(0.4 < float(line["same/overall/accuracy"]) <= 1 for line in found)
    assert "| variant | naive | fem, equation 10 |" in (tmp_path / "r" / "study_crosscheck.md").read_text()


@pytest.mark.slow("trains several rows")
def test_skins_of_one_study_feel_the_same_touches(run, tmp_path):
    few = ["study.seeds=[0]", "study.rows=[features]", "body.cells=[8,8]", "+simulator.divisions=1"]
    done = run(tmp_path, "study", "study=mechanics", "study.part=direction", *few, *SMALL)
    assert done.returncode == 0, done.stderr
    found = lines(tmp_path / "results" / "study_direction.csv")
    assert [line["variant"] for line in found] == [
        "upright",
        "upright with friction",
        "leaning with friction",
    ]
    assert all(0 < float(line["same/direction/degrees"]) < 180 for line in found)
    with closing(sqlite3.connect(tmp_path / "m.db")) as store:
        hashes = store.execute("select distinct value from tags where key = 'data_hash'").fetchall()
    assert len(hashes) == 3
    again = run(tmp_path, "study", "study=mechanics", "study.part=direction", *few, *SMALL)
    assert again.returncode == 0, again.stderr
    assert "took" not in again.stdout


@pytest.mark.slow("evaluates trained rows")
def test_rows_decide_together(run, trained):
    words = [
        "study=models",
        "study.part=ensemble",
        "study.rows=[rules,temporal_graph]",
        "study.seeds=[0]",
        "trainer.max_epochs=1",
    ]
    done = run(trained, "study", *words, *NAIVE, "out=ensemble")
    assert done.returncode == 0, done.stderr
    found = {line["variant"]: line for line in lines(trained / "ensemble" / "study_ensemble.csv")}
    assert list(found) == ["rules", "temporal_graph", "vote"]
    assert 0 < float(found["vote"]["same/any/disagreement"]) < 1


@pytest.mark.slow("trains several rows")
def test_a_study_of_ones_own_needs_a_file_only(run, tmp_path):
    (tmp_path / "own" / "study").mkdir(parents=True)
    (tmp_path / "own" / "experiment").mkdir()
    (tmp_path / "own" / "experiment" / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /learner: rules\nrow: mine\n"
    )
    (tmp_path / "own" / "study" / "noise.yaml").write_text(
        "about: noise\ntrainings: [{experiment: mine, device.noise: [0.05, 0.5]}]\ndifferences: greater\n"
    )
    few = ["--config-dir", tmp_path / "own", "study.seeds=[0]"]
    done = run(tmp_path, "study", *few, "study=noise", *NAIVE)
    assert done.returncode == 0, done.stderr
    found = lines(tmp_path / "results" / "study_noise.csv")
    assert [line["variant"] for line in found] == ["noise=0.05", "noise=0.5"]
    assert "| noise=0.5 |  | " in (tmp_path / "results" / "study_noise.md").read_text()


@pytest.mark.slow("evaluates trained rows")
def test_a_row_that_cannot_take_a_skin_is_named_so_also_where_thresholds_are_chosen(run, trained):
    (trained / "own" / "study").mkdir(parents=True)
    (trained / "own" / "study" / "four.yaml").write_text(
        "about: four sensors\nrows: [gru]\ntest: {evaluation.profile: mild}\n"
        "conditions: {own: {}, four: {layout: grid, layout.rows: 2, layout.columns: 2}}\n"
    )
    done = run(trained, "train", "experiment=gru", *NAIVE)
    assert done.returncode == 0, done.stderr
    words = ["study.seeds=[0]", "evaluation.safe_gestures=64", "out=four"]
    done = run(trained, "study", "--config-dir", trained / "own", "study=four", *words, *NAIVE)
    assert done.returncode == 0, done.stderr
    found = {line["condition"]: line for line in lines(trained / "four" / "study_four.csv")}
    assert float(found["own"]["same/overall/accuracy"]) > 0
    assert not found.get("four", {}).get("same/overall/accuracy")
    assert "cannot" in (trained / "four" / "study_four.md").read_text()


@pytest.mark.slow("evaluates trained rows")
def test_a_multirun_of_studies_is_no_run_itself(run, trained):
    few = [
        "study=models",
        "study.part=ensemble",
        "study.train=false",
        "study.seeds=[0]",
        "study.rows=[rules]",
        "out=one,two",
    ]
    before = runs(trained)
    done = run(trained, "study", "-m", *few, *NAIVE)
    assert done.returncode == 0, done.stderr
    assert [(trained / name / "study_ensemble.md").is_file() for name in ("one", "two")] == [True, True]
    assert {*runs(trained)} - {*before} <= {("study ensemble", "FINISHED")}


@pytest.mark.slow("trains several rows")
def test_a_simulator_that_selects_runs_keeps_their_settings(run, tmp_path):
    """Independent answer: skin evaluate, which changes nothing but the device."""
    done = run(tmp_path, "train", "experiment=rules", "simulator=fem", "simulator.reading=interface", *SMALL)
    assert done.returncode == 0, done.stderr
    few = ["device.test_gestures=48", "evaluation.devices=0", "evaluation.layouts=0"]
    words = ["study.part=dead", "simulator=fem", "study.rows=rules", "study.devices=1", few[0]]
    done = run(tmp_path, "study", "study=robustness", *words)
    assert done.returncode == 0, done.stderr
    found = lines(tmp_path / "results" / "study_dead.csv")[0]
    done = run(tmp_path, "evaluate", "run=latest", "device.seed=1", "device.dead=0", *few)
    assert done.returncode == 0, done.stderr
    assert float(found["same/overall/accuracy"]) == pytest.approx(evaluated_accuracy(tmp_path))


@pytest.mark.slow("trains several rows")
def test_the_table_is_a_study_with_the_reports_numbers_and_its_figures(run, trained):
    """Rows that it does not train stand in it once they have finished; two trainings run at a time."""
    done = run(trained, "train", "experiment=best_fresh", "trainer.max_epochs=1", *NAIVE)
    assert done.returncode == 0, done.stderr
    rows = "study.trainings.0.experiment=[rules,temporal_graph,gru]"
    words = [
        "study=table",
        "study.trainings.0.simulator=[naive]",
        rows,
        "study.jobs=2",
        "trainer.max_epochs=1",
    ]
    done = run(trained, "study", *words, *SMALL, "out=table", apart=True)
    assert done.returncode == 0, done.stderr
    found = {line["variant"]: line for line in lines(trained / "table" / "study_table.csv")}
    assert list(found) == ["rules", "temporal_graph", "gru", "best_fresh"]
    assert found["temporal_graph"]["reference"] == "0.85"
    assert " (85.0) | " in (trained / "table" / "study_table.md").read_text()
    names = {path.name for path in (trained / "table").iterdir()}
    assert names >= {"figure07_speed_naive.csv", "figure08_confusion_naive.png", "figure10_naive_naive.png"}
    assert "took" in done.stdout
    again = run(trained, "study", *words, *SMALL, "out=table")
    assert "took" not in again.stdout
