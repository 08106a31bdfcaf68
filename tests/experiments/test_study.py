"""The command finds finished runs, trains what is missing, measures, and gives verdicts."""

import csv

import pandas as pd
import pytest
from PIL import Image

from skin.core.files import write
from skin.runs.configuration import fingerprint
from skin.runs.store import Store
from tests.commands.conftest import query

SMALL = ["data.gestures=160", "device.test_gestures=64", "evaluation.devices=0", "evaluation.layouts=0",
         "evaluation.safe_gestures=64"]  # fmt: skip
NAIVE = ["simulator=naive", *SMALL]
ACCURACY = "same/overall/accuracy"
NO_METRIC = "study.statements=[{id: a, says: b}]"


def runs(folder):
    return query(folder, "select name, status from runs order by start_time")


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
    words = ["study=models", "study.part=activation", "study.seeds=[0,1,2]", f"out={folder}/r"]
    done = run(folder, "study", *words)
    assert "…" not in done.stdout, "nothing was to be trained"
    page = (folder / "r" / "study_activation.md").read_text()
    assert "| activation=silu | 81.0 ± 2.5 |" in page
    assert "+10.2 ± 0.5 points (activation=relu); -10.2 ± 0.5 points (activation=elu) | disagree |" in page
    assert len(lines(folder / "r" / "study_activation.csv")) == 9
    assert {path.suffix for path in (folder / "r").iterdir()} == {".md", ".csv", ".png"}


@pytest.mark.parametrize(
    ("arguments", "named"),
    [((), "which study"), (["study=margin"], "margins"), (["study=models", NO_METRIC], "statements[0]")],
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
    done = run(tmp_path, "study", "study=models", "study.part=transformer", *few, code=1)
    assert done.stdout.count(": done") == 1
    said = done.stdout.replace("\n", "")
    assert all(setting in said for setting in ("data.gestures=80", "device.test_gestures=48"))
    page = (tmp_path / "r" / "smoke" / "study_transformer.md").read_text()
    assert "SMOKE" in done.stdout
    assert "SMOKE" in page
    body = page.split("\n\n")[2].splitlines()[2:]
    assert [line.count("(1 failed) | failed |") for line in body] == [0, 1, 1]
    assert done.stderr.count("model.pooling=attention must be 'mean' or 'max'") >= 2


@pytest.fixture(scope="module")
def trained(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    for words in (["experiment=rules"], ["experiment=temporal_graph", "trainer.max_epochs=1"]):
        run(folder, "train", *words, *NAIVE)
    return folder


@pytest.mark.slow("evaluates trained rows")
def test_finished_runs_are_tried_under_conditions_once(run, trained):
    words = ["study=robustness", "study.part=dead", "simulator=naive", "study.devices=2"]
    words += ["device.test_gestures=48", "out=dead"]
    done = run(trained, "study", *words)
    found = lines(trained / "dead" / "study_dead.csv")
    assert [line["condition"] for line in found[::2]] == ["0 dead", "1 dead", "3 dead", "5 dead"] * 2
    assert {line["variant"].split()[0] for line in found} == {"rules", "temporal_graph"}
    assert all(0.25 < float(line[ACCURACY]) < 1 for line in found)
    assert "undecided" in done.stdout
    before, files = runs(trained), {path: path.stat().st_mtime_ns for path in trained.rglob("*-*.parquet")}
    assert len(files) == 2 * 4 * 2
    assert run(trained, "study", *words).stdout == done.stdout
    assert runs(trained) == before
    assert {path: path.stat().st_mtime_ns for path in trained.rglob("*-*.parquet")} == files
    assert lines(trained / "dead" / "study_dead.csv") == found
    refused = run(trained, "study", *words[:3], "study.rows=[gru]", code=2)
    assert "no finished run of gru" in refused.stderr


@pytest.mark.slow("evaluates trained rows")
def test_a_condition_changes_the_device_as_an_evaluation_does(run, trained):
    """Independent answer: skin evaluate with the same settings."""
    few = ["simulator=naive", "study.rows=[rules]", "study.devices=1", "device.test_gestures=48"]
    run(trained, "study", "study=robustness", "study.part=misplaced", *few, "out=misplaced")
    found = {line["condition"]: line for line in lines(trained / "misplaced" / "study_misplaced.csv")}
    device = ["device.seed=1", "device.position_error=0.005", "device.test_gestures=48"]
    run(trained, "evaluate", f"run={found['5 mm']['run']}", *device, *SMALL[2:4], "out=e")
    question = "select value from latest_metrics join runs using (run_uuid) where name like 'evaluation of%'"
    ((evaluated,),) = query(trained, f"{question} and key = '{ACCURACY}'")[:1]
    assert float(found["5 mm"][ACCURACY]) == pytest.approx(evaluated)
    assert found["5 mm"][ACCURACY] != found["0 mm"][ACCURACY]


@pytest.mark.slow("evaluates trained rows")
def test_verdicts_are_sorted_by_margins(run, trained):
    few = ["study.rows=[rules,temporal_graph]", "simulator=naive", "out=margins"]
    said = run(trained, "study", "study=margins", "study.measure.gestures=400", *few).stdout.splitlines()
    assert "chosen on 64 fresh safe gestures for 2 % false alarms, finds " in said[0]
    (path,) = (trained / "margins").glob("margins_rules_*.csv")
    table = pd.read_csv(path)
    sums = table[table.label == "big"].groupby("by")[["touches", "wrong"]].sum()
    assert sums.touches.tolist() == [400, 400]
    assert sums.wrong.nunique() == 1
    assert "## alarm by threshold" in path.with_suffix(".md").read_text()
    with Image.open(path.with_suffix(".png")) as picture:
        assert picture.size[0] > 800
    joined = pd.read_csv(trained / "margins" / "study_margins.csv")
    assert {variant.split()[0] for variant in joined.variant} == {"rules", "temporal_graph"}
    own = joined[joined.variant.str.startswith("rules")].reset_index(drop=True)
    pd.testing.assert_frame_equal(own[table.columns], table)


@pytest.mark.slow("evaluates trained rows")
def test_a_run_is_probed_beside_graph_embeddings(run, trained):
    few = ["train=80", "test=40", "seeds=[0]", "epochs=2", "layouts=2", "attributes=[reading]"]
    words = ["study.rows=[temporal_graph]", "simulator=naive", *(f"study.measure.{one}" for one in few)]
    run(trained, "study", "study=embeddings", *words, "out=embeddings")
    (path,) = (trained / "embeddings").glob("embeddings_temporal_graph_*.md")
    assert path.with_suffix(".png").is_file()
    rows = [line.split("|")[1].strip() for line in path.read_text().splitlines() if line.startswith("| ")]
    graphs = [f"{name}, reading" for name in ("Graph2Vec", "GL2Vec", "IGE")]
    assert rows == ["input", *graphs, "trained encoder", "readings, one frame", "readings, window"]
    assert path.read_text().count("**undecided**") == 3  # one seed decides nothing


@pytest.mark.slow("trains several rows")
def test_a_study_of_ones_own_needs_a_file_only(run, tmp_path):
    mine = "# @package _global_\ndefaults:\n  - override /learner: rules\nrow: mine\n"
    noise = "about: noise\ntrainings: [{experiment: mine, device.noise: [0.05, 0.5]}]\ndifferences: greater\n"
    for name, text in (("experiment/mine", mine), ("study/noise", noise)):
        write(text, tmp_path / "own" / f"{name}.yaml")
    few = ["--config-dir", tmp_path / "own", "study.seeds=[0]"]
    run(tmp_path, "study", *few, "study=noise", *NAIVE)
    found = lines(tmp_path / "results" / "study_noise.csv")
    assert [line["variant"] for line in found] == ["noise=0.05", "noise=0.5"]
    assert "| noise=0.5 |  | " in (tmp_path / "results" / "study_noise.md").read_text()


@pytest.mark.slow("evaluates trained rows")
def test_a_row_that_cannot_take_a_skin_is_named_so_also_where_thresholds_are_chosen(run, trained):
    text = "about: four sensors\nrows: [gru]\ntest: {evaluation.profile: mild}\n"
    text += "conditions: {own: {}, four: {layout: grid, layout.rows: 2, layout.columns: 2}}\n"
    write(text, trained / "own" / "study" / "four.yaml")
    run(trained, "train", "experiment=gru", *NAIVE)
    words = ["study.seeds=[0]", "evaluation.safe_gestures=64", "out=four"]
    run(trained, "study", "--config-dir", trained / "own", "study=four", *words, *NAIVE)
    found = {line["condition"]: line for line in lines(trained / "four" / "study_four.csv")}
    assert float(found["own"][ACCURACY]) > 0
    assert not found.get("four", {}).get(ACCURACY)
    assert "cannot" in (trained / "four" / "study_four.md").read_text()


@pytest.mark.slow("trains several rows")
def test_the_table_is_a_study_with_the_reports_numbers_and_its_figures(run, trained):
    """Rows that it does not train stand in it once they have finished; two trainings run at a time."""
    run(trained, "train", "experiment=best_fresh", "trainer.max_epochs=1", *NAIVE)
    words = ["study=table", "study.trainings.0.simulator=[naive]", "study.jobs=2", "trainer.max_epochs=1"]
    words += ["study.trainings.0.experiment=[rules,temporal_graph,gru]", *SMALL, "out=table"]
    done = run(trained, "study", *words, apart=True)
    found = {line["variant"]: line for line in lines(trained / "table" / "study_table.csv")}
    assert list(found) == ["rules", "temporal_graph", "gru", "best_fresh"]
    assert found["temporal_graph"]["reference"] == "0.85"
    assert " (85.0) | " in (trained / "table" / "study_table.md").read_text()
    names = {path.name for path in (trained / "table").iterdir()}
    assert names >= {"figure07_speed_naive.csv", "figure08_confusion_naive.png", "figure10_naive_naive.png"}
    assert ": done" in done.stdout
    assert ": done" not in run(trained, "study", *words).stdout
