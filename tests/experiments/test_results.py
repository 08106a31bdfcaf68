"""One command makes every published file, and goes on where it was killed."""

import re
import sqlite3
from contextlib import closing

import pytest
from omegaconf import OmegaConf

from experiments.studies.recorded_runs import read_records
from skin.paths import CONF, ROOT

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = ["simulator=naive", "data.gestures=160", "device.test_gestures=64", "evaluation.devices=0",
         "evaluation.layouts=0", "evaluation.safe_gestures=64", "trainer.max_epochs=1"]  # fmt: skip
PARTS = [
    "results.parts.table=[{run: 'train -m experiment=rules seed=0,1,2,3', hours: 1}, "
    "{run: 'table table.seeds=4 experiment=rules', hours: 1}]",
    "results.parts.studies=[{run: 'study study=pair study.rows=[rules] study.seeds=[0,1]', hours: 1}]",
    "results.parts.shifts=[]",
    "results.parts.peers=[]",
    "results.parts.sensors=[]",
    "results.parts.any_skin=[]",
    "results.parts.design=[]",
    "results.file=runs.parquet",
    "out=docs",
]


def runs(folder, name="m.db"):
    """Return name and status of each training."""
    with closing(sqlite3.connect(folder / name)) as store:
        found = store.execute("select name, status from runs where name like 'rules naive%'")
        return sorted(found.fetchall())


@pytest.mark.slow
def test_a_killed_command_goes_on_where_it_was(run, begin, tmp_path):
    store = [f"tracking.uri=sqlite:///{tmp_path}/m.db", f"tracking.artifacts={tmp_path}/a"]
    with begin(tmp_path, "results", *PARTS, *SMALL, *store) as killed:
        for line in killed.lines():
            if line.startswith("[3/4]"):
                break
        killed.kill()
        assert killed.wait() < 0
    finished = [name for name, status in runs(tmp_path) if status == "FINISHED"]
    assert len(finished) == 2
    done = run(tmp_path, "results", *PARTS, *SMALL)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("== [") == 3
    assert "about 3.0 h left" in done.stdout
    assert sorted(name for name, status in runs(tmp_path) if status == "FINISHED") == [
        f"rules naive max_epochs=1 seed {seed}" if "max_epochs" in finished[0] else f"rules naive seed {seed}"
        for seed in range(4)
    ]
    assert {"table.csv", "table_seeds.csv", "study_pair.csv"} <= {
        path.name for path in (tmp_path / "docs").iterdir()
    }
    assert len(read_records(tmp_path / "runs.parquet")) == 4
    # The file alone is enough, unless it is to be ignored.
    (tmp_path / "m.db").unlink()
    again = run(tmp_path, "results", *PARTS, *SMALL)
    assert (again.returncode, again.stdout.count("took")) == (0, 0), again.stderr
    fresh = run(
        tmp_path, "results", *PARTS, *SMALL, "results.fresh=true", "results.part=studies", store=False
    )
    assert fresh.returncode == 1, "study=pair trains nothing"
    assert (tmp_path / "results" / "fresh.db").is_file()


@pytest.mark.slow
def test_a_command_that_fails_does_not_stop_the_others(run, tmp_path):
    lines = "{run: 'study study=nope', hours: 1}, {run: 'study study=pair study.rows=[rules]', hours: 1}"
    words = [f"results.parts.studies=[{lines}]", "results.part=studies"]
    done = run(tmp_path, "results", *PARTS, *words, *SMALL)
    assert done.returncode == 1
    assert done.stdout.count("== [") == 2
    assert "failed:\nskin study study=nope" in done.stderr
    assert not (tmp_path / "runs.parquet").exists()


@pytest.mark.slow
def test_bounds_are_published_in_a_folder_of_their_own(run, tmp_path):
    parts = "results.parts.design=[{run: 'design design.touches=64 simulator=naive out=a/b', hours: 1}]"
    done = run(tmp_path, "results", *PARTS, parts, "results.part=design", "results.budget=smoke", *SMALL)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "docs" / "a" / "b" / "design.json").is_file()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (
            ["results.part=tables"],
            "results.part=tables is none of all, table, peers, shifts, sensors, any_skin, studies, "
            "design, images",
        ),
        (["results.parts.table=[{run: table, hours: 0}]"], "hours"),
        (["results.optional=[image]"], "results.optional=['image']: there is no part image"),
        (["results.action=show"], "results.action"),
        (["results.check.seed=-1"], "results.check.seed"),
    ],
)
def test_bad_settings_are_refused(run, tmp_path, words, reason):
    done = run(tmp_path, "results", *words, store=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert reason in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_runs_in_another_precision_are_found(run, tmp_path):
    small = SMALL[1:]
    for row, seed in (("best_fresh", "0"), ("rules", "0")):
        words = [f"experiment={row}", f"seed={seed}", "trainer.precision=bf16-mixed"]
        done = run(tmp_path, "train", *words, *SMALL)
        assert done.returncode == 0, done.stderr
    table = ["table.simulators=[naive]", "experiment=rules", *small]
    done = run(tmp_path, "table", *table)
    assert done.returncode == 0, done.stderr
    assert "was finished before" in done.stdout
    assert "best_fresh" in (tmp_path / "results" / "table.md").read_text()
    pair = ["study=pair", "study.rows=[best_fresh,rules]", "study.seeds=[0]"]
    done = run(tmp_path, "study", *pair, *SMALL)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_study_of_the_parts_exists():
    text = (CONF / "results.yaml").read_text()
    named = {
        line.split("study=")[1].split(",")[0].split()[0]
        for line in text.splitlines()
        if "study study=" in line
    }
    assert named <= {path.stem for path in (CONF / "study").glob("*.yaml")}
    assert len(named) > 10


def test_make_help_states_the_hours_of_each_part():
    settings = OmegaConf.load(CONF / "results.yaml").results
    hours = {name: sum(step.hours for step in steps) for name, steps in settings.parts.items()}
    (text,) = (line for line in (ROOT / "Makefile").read_text().splitlines() if line.startswith("results:"))
    stated = {name: float(value) for name, value in re.findall(r"(\w+) ([\d.]+) h", text)}
    every = sum(each for name, each in hours.items() if name not in settings.optional)
    assert stated.pop("in") == pytest.approx(every, rel=0.1)
    assert stated == pytest.approx(hours, rel=0.1)
