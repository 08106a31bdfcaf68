"""One command makes every published file, and goes on where it was killed."""

import re
from shlex import split

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from experiments.studies.study import chosen_studies
from skin.core.files import CONF, ROOT
from skin.runs.configuration import shorten, validate_config
from skin.runs.sweep import sweep_jobs
from tests.commands.conftest import query

SMALL = ["simulator=naive", "data.gestures=160", "device.test_gestures=64", "evaluation.devices=0",
         "evaluation.layouts=0", "evaluation.safe_gestures=64", "trainer.max_epochs=1"]  # fmt: skip
PARTS = [
    "results.parts.table=[['train -m experiment=rules seed=0,1,2,3', 1], "
    "['study study=table study.rows=[rules] study.seeds=[0,1,2,3]', 1]]",
    "results.parts.studies=[['study study=models study.part=ensemble study.rows=[rules] study.seeds=[0,1] "
    "study.train=false', 1]]",
    "out=docs",
]
OTHERS = ("table_solid", "best_fresh", "best_fresh_solid", "sensors", "any_skin", "design")
PARTS += [f"results.parts.{part}=[]" for part in OTHERS]
LINES = [run for steps in OmegaConf.load(CONF / "results.yaml").results.parts.values() for run, _ in steps]


def runs(folder):
    return sorted(query(folder, "select name, status from runs where name like 'rules naive%'"))


@pytest.mark.slow("trains rows, twice")
def test_a_killed_command_goes_on_where_it_was(run, begin, tmp_path):
    store = [f"tracking.uri=sqlite:///{tmp_path}/m.db", f"tracking.artifacts={tmp_path}/a"]
    with begin(tmp_path, "results", *PARTS, *SMALL, *store) as killed:
        for line in killed.lines():
            if line.startswith("[3/4]"):
                break
        killed.kill()
        assert killed.wait() < 0
    finished = [name for name, status in runs(tmp_path) if status == "FINISHED"]
    assert 2 <= len(finished) < 4  # the third may end before the signal arrives
    done = run(tmp_path, "results", *PARTS, *SMALL)
    assert done.stdout.count("== [") == 3
    assert "at most 3.0 h left" in done.stdout
    small = "gestures=160 test_gestures=64 devices=0 layouts=0 safe_gestures=64"
    assert sorted(name for name, status in runs(tmp_path) if status == "FINISHED") == [
        shorten(f"rules naive {small}", f" seed {seed}") for seed in range(4)
    ]
    assert {"study_table.csv", "study_ensemble.csv"} <= {path.name for path in (tmp_path / "docs").iterdir()}
    before = runs(tmp_path)
    run(tmp_path, "results", *PARTS, *SMALL)
    assert runs(tmp_path) == before, "a finished training was repeated"


@pytest.mark.slow("trains several rows")
def test_a_command_that_fails_does_not_stop_the_others(run, tmp_path):
    lines = "['study study=nope', 1], "
    lines += "['study study=models study.part=ensemble study.rows=[rules] study.train=false', 1]"
    words = [f"results.parts.studies=[{lines}]", "results.part=studies"]
    done = run(tmp_path, "results", *PARTS, *words, *SMALL, code=1)
    assert done.stdout.count("== [") == 2
    assert "failed:\nskin study study=nope" in done.stderr


@pytest.mark.slow("designs a skin")
def test_bounds_are_published_in_a_folder_of_their_own(run, tmp_path):
    parts = "results.parts.design=[['design design.touches=64 simulator=naive out=a/b', 1]]"
    run(tmp_path, "results", *PARTS, parts, "results.part=design", *SMALL)
    assert (tmp_path / "docs" / "a" / "b" / "design.json").is_file()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["results.part=tables"], "results.part=tables is none of all, table, table_solid, best_fresh, "),
        (["results.parts.table=[[study, 0]]"], "results.parts="),
        (["results.jobs=0"], "results.jobs"),
    ],
)
def test_bad_settings_are_refused(run, tmp_path, words, reason):
    done = run(tmp_path, "results", *words, store=False, code=2)
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("line", LINES)
def test_every_command_of_the_plan_composes(line):
    verb, *words = split(line)
    words = [word for word in words if word != "-m"]
    search = []
    if "--config-dir" in words:
        position = words.index("--config-dir")
        search = [f"hydra.searchpath=['file://{ROOT / words[position + 1]}']"]
        del words[position : position + 2]
    jobs = [[f"{key}={value}" for key, value in job.items()] for job in sweep_jobs(words, {})]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for job in (jobs[0], *jobs[1:][-1:]):  # each row, and each setting of a row, is composed elsewhere
            config = compose(verb, [*search, *job], return_hydra_config=True)
            HydraConfig.instance().set_config(config)
            validate_config(config)
            settings = OmegaConf.to_container(config, resolve=False).get("study")
            for study in chosen_studies(settings) if verb == "study" else []:
                assert study.about


def test_the_plan_takes_a_night_and_make_help_states_the_hours_of_each_part():
    settings = OmegaConf.load(CONF / "results.yaml").results
    hours = {name: sum(hours for _, hours in steps) for name, steps in settings.parts.items()}
    every = sum(each for name, each in hours.items() if name not in settings.optional)
    assert max(hours.values()) <= 2.5
    assert every <= 8
    (text,) = (line for line in (ROOT / "Makefile").read_text().splitlines() if line.startswith("results:"))
    stated = {name: float(value) for name, value in re.findall(r"(\w+) ([\d.]+) h", text)}
    assert stated.pop("in") == pytest.approx(every, rel=0.1)
    assert stated == pytest.approx(hours, rel=0.1)
