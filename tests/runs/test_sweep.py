"""A sweep counts its jobs as Hydra does, goes on after a failure, resumes, and tells what it found."""

import os
import socket
import sqlite3
import subprocess
import sys

import pytest
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.configuration import Tracking, shorten
from skin.runs.store import Store
from skin.runs.sweep import SweepCallback, sweep_jobs, sweep_title

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = [
    "experiment=rules",
    "simulator=naive",
    "data.gestures=64",
    "device.test_gestures=32",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
]


def named(seed, more=""):
    """Return the name of a run of ``SMALL``."""
    name = f"rules naive gestures=64 test_gestures=32 devices=1 layouts=1 safe_gestures=64{more}"
    return shorten(name, f" seed {seed}")


def test_jobs_come_in_hydras_order_and_the_command_line_wins_over_the_sweeps_file():
    found = sweep_jobs(["seed=0,1", "row=x"], {"simulator": "naive,fem"})
    assert [(job["simulator"], job["seed"], job["row"]) for job in found] == [
        (simulator, seed, "x") for simulator in ("naive", "fem") for seed in ("0", "1")
    ]
    found = sweep_jobs(["simulator=fem"], {"simulator": "naive,fem", "experiment": "rules,features"})
    assert found == [{"simulator": "fem", "experiment": name} for name in ("rules", "features")]


@pytest.mark.parametrize(
    ("override", "values"),
    [
        ("seed=range(0,3)", ["0", "1", "2"]),
        ("model.widths=[32,32],[32,128]", ["[32,32]", "[32,128]"]),
        ("+device.calibration='a,b.yaml',c.yaml", ["'a,b.yaml'", "c.yaml"]),
    ],
)
def test_every_way_to_write_values_is_hydras(override, values):
    assert [list(job.values()) for job in sweep_jobs([override], {})] == [[value] for value in values]


def test_an_interval_is_refused():
    with pytest.raises(InputError, match=r"^optimizer.lr=interval\(0.1,1\) names .* hydra/sweeper=optuna$"):
        sweep_jobs(["optimizer.lr=interval(0.1,1)"], {})


def test_a_glob_means_the_options_of_its_group():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert sweep_jobs(["simulator=glob(*)"], {}) == [
            {"simulator": name} for name in ("fem", "naive", "solid")
        ]


def sweep(folder, *overrides):
    """Return the arguments of a sweep."""
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    return ["train.py", "-m", *SMALL, *own, *overrides, f"hydra.sweep.dir={folder}/out"]


def runs(folder):
    """Return (name, status, parent) of every run that the UI shows, oldest first."""
    with sqlite3.connect(folder / "m.db") as database:
        found = database.execute(
            "select name, status, (select value from tags where tags.run_uuid = runs.run_uuid "
            "and key = 'mlflow.parentRunId') from runs where lifecycle_stage = 'active' order by start_time"
        ).fetchall()
    database.close()
    return found


@pytest.mark.slow("trains several runs")
def test_a_sweep_that_was_killed_goes_on_where_it_was(run, begin, tmp_path):
    with begin(tmp_path, *sweep(tmp_path, "seed=0,1,2")) as first:
        next(line for line in first.lines() if line.startswith("[1/3]"))
    assert [one[:2] for one in runs(tmp_path)][:2] == [
        ("seed=0,1,2", "RUNNING"),
        (named(0), "FINISHED"),
    ]
    again = run(tmp_path, *sweep(tmp_path, "seed=0,1,2"), store=False)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("did this before") == 1
    assert "[3/3] seed=2: done" in again.stdout
    finished = [name for name, status, parent in runs(tmp_path) if status == "FINISHED" and parent]
    assert finished == [named(0), named(1), named(2)]


@pytest.mark.slow("trains several runs")
def test_a_run_is_named_by_its_changes_and_logs_them_and_a_skipped_one_prints_its_scores(run, tmp_path):
    given = ["train", *SMALL, "device.offset=0.2", "layout=grid", "model=mlp"]
    first = run(tmp_path, *given)
    assert first.returncode == 0, first.stderr
    with sqlite3.connect(tmp_path / "m.db") as database:
        (name,) = database.execute("select name from runs").fetchone()
        params = dict(database.execute("select key, value from params"))
    database.close()
    assert name.startswith("rules naive ")
    assert name == named(0, " offset=0.2 layout=grid")
    assert len(name) == 80
    assert (params["device.offset"], params["layout"], params["seed"]) == ("0.2", "grid", "0")
    assert params["learner"] == "rules"
    assert not {"representation", "model", "fusion"} & set(params)  # rules use none of them
    again = run(tmp_path, *given)
    assert again.returncode == 0, again.stderr
    assert "did this before" in again.stderr
    rows = [line for line in first.stdout.splitlines() if line.startswith("│")]
    assert rows == [line for line in again.stdout.splitlines() if line.startswith("│")]
    assert rows


@pytest.mark.slow("trains several runs")
def test_a_bad_job_fails_and_the_others_run(run, tmp_path):
    done = run(tmp_path, *sweep(tmp_path, "device.offset=-1,0.1"), store=False)
    assert done.returncode == 1
    assert "offset" in done.stderr
    assert [one[:2] for one in runs(tmp_path) if one[2]] == [(named(0, " offset=0.1"), "FINISHED")]
    (parent,) = parents(tmp_path)
    assert parent.info.status == "FINISHED"
    assert "device.offset=-1 must be" in parent.data.tags["refused_0"]
    assert "refused_1" not in parent.data.tags


def parents(folder):
    """Return the parent runs of sweeps, newest first."""
    store = Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))
    return [run for run in store.find() if "sweep" in run.data.tags]


def test_a_title_tells_what_is_swept():
    jobs = [{"row": "x", "+model.norm": norm, "seed": seed} for norm in ("none", "layer") for seed in "01"]
    assert sweep_title(jobs, ["+model.norm", "seed"]) == "model.norm=none,layer × seed=0,1"
    assert sweep_title(jobs, []) == ""


@pytest.mark.slow("trains six networks in a process that shares nothing")
@pytest.mark.parametrize("sweeper", ["ask", "optuna"])
def test_a_sweeper_gets_the_objective_and_draws_from_an_interval(sweeper, tmp_path):
    if sweeper == "optuna":
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    (tmp_path / "hydra_plugins").mkdir()
    (tmp_path / "hydra_plugins/ask.py").write_text(ASK)
    given = ["train", "-m", *SMALL, "device.noise=interval(0.05,0.3)", f"tracking.artifacts={tmp_path}/a"]
    given += [f"hydra/sweeper={sweeper}", "hydra.sweeper.n_trials=6", f"hydra.sweep.dir={tmp_path}/out"]
    given += ["hydra.sweeper.n_jobs=1"] * (sweeper == "optuna")
    paths = os.pathsep.join([str(tmp_path), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    done = subprocess.run(
        [sys.executable, "-m", "skin", *given, f"tracking.uri=sqlite:///{tmp_path}/m.db"],
        capture_output=True, text=True, timeout=300, cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line.startswith("[6] device.noise=0.")]
    (parent,) = parents(tmp_path)
    assert (parent.info.run_name, parent.info.status) == ("device.noise=interval(0.05,0.3)", "FINISHED")
    store = Store.open(Tracking(f"sqlite:///{tmp_path}/m.db"))
    trials = [run.data for run in store.find(**{"mlflow.parentRunId": parent.info.run_id})]
    assert len(trials) == 6
    assert all(0.05 <= float(trial.params["device.noise"]) <= 0.3 for trial in trials)
    best = max(trial.metrics["best_val_accuracy"] for trial in trials)
    (result,) = (tmp_path / "out").glob("optimization_results.yaml")
    assert OmegaConf.load(result).best_value == pytest.approx(best)


ASK = """
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from omegaconf import OmegaConf


class Ask(Sweeper):
    # Narrows an interval around the best value so far.

    def __init__(self, n_trials):
        self.n_trials = n_trials

    def setup(self, *, hydra_context, task_function, config):
        self.folder, plugins = config.hydra.sweep.dir, Plugins.instance()
        self.launcher = plugins.instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments):
        parsed = OverridesParser.create().parse_overrides(arguments)
        (drawn,) = [override for override in parsed if override.is_sweep_override()]
        others = [override.input_line for override in parsed if override is not drawn]
        low, high = drawn.value().start, drawn.value().end
        told = {}
        for number in range(self.n_trials):
            value = (low + high) / 2 if told else low
            job = [*others, f"{drawn.get_key_element()}={value}"]
            (result,) = self.launcher.launch([job], initial_job_idx=number)
            told[value] = float(result.return_value)
            low, high = (low, value) if max(told, key=told.get) < value else (value, high)
        OmegaConf.save({"best_value": max(told.values())}, f"{self.folder}/optimization_results.yaml")


ConfigStore.instance().store(
    group="hydra/sweeper", name="ask", node={"_target_": "hydra_plugins.ask.Ask", "n_trials": 1}
)
"""


def test_a_shard_of_a_search_is_refused(tmp_path, monkeypatch):
    sweeper = {"_target_": "hydra_plugins.x.Search"}
    hydra = {"sweeper": sweeper, "overrides": {"task": ["seed=interval(0,3)"]}}
    with pytest.raises(InputError, match=r"^shard=1/2 divides a list of jobs, which this sweeper does not"):
        SweepCallback()._begin(OmegaConf.create({"shard": "1/2", "hydra": hydra}))


@pytest.mark.slow("trains several runs")
def test_a_run_is_nested_under_the_sweep_that_trained_it(run, tmp_path):
    for seeds in ("0,1,0", "1,0", "shuffle(0,1,2)"):
        done = run(tmp_path, *sweep(tmp_path, f"seed={seeds}"), store=False)
        assert done.returncode == 0, done.stderr
    assert done.stderr.count("did this before") == 2
    second, first = parents(tmp_path)  # the one in between trained nothing
    assert (first.info.run_name, first.info.status) == ("seed=0,1", "FINISHED")
    children = {one[0]: one[2] for one in runs(tmp_path) if one[2]}
    assert children == {
        named(0): first.info.run_id,
        named(1): first.info.run_id,
        named(2): second.info.run_id,
    }


@pytest.mark.slow("trains several runs in processes that import anew")
def test_parallel_jobs_end_in_a_finished_parent(run, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    parallel = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = run(tmp_path, *sweep(tmp_path, "device.gain_spread=0.05,0.1", *parallel), store=False)
    assert done.returncode == 0, done.stderr
    (parent,) = parents(tmp_path)
    assert parent.info.status == "FINISHED"


@pytest.mark.slow("composes several sweeps with trained runs")
@pytest.mark.parametrize("given", [["device.offset=-1,-2"], ["seed=x,y"], ["model=cn", "seed=0,1"]])
def test_a_sweep_that_trains_nothing_leaves_no_parent(run, tmp_path, given):
    done = run(tmp_path, *sweep(tmp_path, *given), store=False)
    assert done.returncode in (1, 2)
    assert given[0].split("=")[1].split(",")[0] in done.stderr
    assert not (tmp_path / "m.db").exists() or not runs(tmp_path)


def test_what_no_job_could_accept_is_refused_once():
    command = [sys.executable, "-m", "skin", "train", "-m", "+typo=1", "seed=0,1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert "typo" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow("trains several runs")
def test_a_job_may_take_a_value_from_another_setting(run, tmp_path):
    words = [*SMALL, "device.noise=0.05,0.1", "device.offset=${device.noise}"]
    done = run(tmp_path, "train", "-m", *words, f"hydra.sweep.dir={tmp_path}/out")
    assert done.returncode == 0, done.stderr
    with sqlite3.connect(tmp_path / "m.db") as database:
        found = database.execute("select name, status from runs where name like 'device.noise%'").fetchall()
    database.close()
    assert found == [("device.noise=0.05,0.1", "FINISHED")]


@pytest.mark.slow("trains several runs")
def test_shards_train_every_job_once(run, tmp_path):
    said = []
    for shard in ("1/2", "2/2", "3/3"):
        done = run(tmp_path, *sweep(tmp_path, "seed=0,1,0", f"shard={shard}"), store=False)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout)
    assert "shard 3/3 has no job: the sweep has only 2" in said[2]
    children = [(name, status) for name, status, parent in runs(tmp_path) if parent]
    assert sorted(children) == sorted((named(seed), "FINISHED") for seed in (0, 1))
    assert [parent.info.status for parent in parents(tmp_path)] == ["FINISHED", "FINISHED"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["shard=1/2"], "shard=1/2 divides the jobs of a multirun or a study: add -m"),
        (["-m", "shard=0/2"], "shard=0/2 names no part: give i/n"),
    ],
)
def test_a_shard_of_nothing_is_refused(run, tmp_path, words, said):
    done = run(tmp_path, "train", *words, *SMALL)
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert not (tmp_path / "m.db").exists()


@pytest.mark.parametrize("words", [[], ["-m"]])
def test_a_server_that_is_away_is_told_before_anything_heavy_is_imported(words):
    with socket.create_server(("127.0.0.1", 0)) as closed:
        uri = f"http://127.0.0.1:{closed.getsockname()[1]}"
    given = ["train", *words, "seed=0,1" if words else "seed=0", f"tracking.uri={uri}"]
    code = "import atexit, sys\natexit.register(lambda: print('torch' in sys.modules))\n"
    code += f"from skin.__main__ import main\nmain({given})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, "False\n")
    assert f"the tracking server {uri} does not answer" in done.stderr
