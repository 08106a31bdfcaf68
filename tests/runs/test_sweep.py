"""A sweep counts its jobs as Hydra does, goes on after a failure, resumes, and tells what it found."""

import socket
import subprocess
import sys

import pytest
from hydra import initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.configuration import shorten
from skin.runs.sweep import Shard, SweepCallback, sweep_jobs, sweep_title

SMALL = [
    "experiment=rules", "simulator=naive", "data.gestures=64", "device.test_gestures=32",
    "evaluation.devices=1", "evaluation.layouts=1", "evaluation.safe_gestures=64",
]  # fmt: skip


def named(seed, more=""):
    name = f"rules naive gestures=64 test_gestures=32 devices=1 layouts=1 safe_gestures=64{more}"
    return shorten(name, f" seed {seed}")


@pytest.mark.parametrize(
    ("words", "parameters", "jobs"),
    [
        (["seed=0,1", "row=x"], {"simulator": "naive,fem"},
         [{"simulator": name, "seed": seed, "row": "x"} for name in ("naive", "fem") for seed in "01"]),
        (["simulator=fem"], {"simulator": "naive,fem", "seed": "0,1"},
         [{"simulator": "fem", "seed": seed} for seed in "01"]),
        (["seed=range(0,3)"], {}, [{"seed": seed} for seed in "012"]),
        (["model.widths=[32,32],[32,128]"], {}, [{"model.widths": each} for each in ("[32,32]", "[32,128]")]),
        (["+device.calibration='a,b.yaml',c.yaml"], {},
         [{"+device.calibration": each} for each in ("'a,b.yaml'", "c.yaml")]),
        (["simulator=glob(*)"], {}, [{"simulator": name} for name in ("fem", "naive", "solid")]),
    ],
)  # fmt: skip
def test_jobs_are_those_of_hydra_and_the_command_line_wins_over_the_sweeps_file(words, parameters, jobs):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert sweep_jobs(words, parameters) == jobs


def test_an_interval_and_a_shard_of_a_search_are_refused():
    with pytest.raises(InputError, match=r"^optimizer.lr=interval\(0.1,1\) names .* hydra/sweeper=optuna$"):
        sweep_jobs(["optimizer.lr=interval(0.1,1)"], {})
    sweeper = {"_target_": "hydra_plugins.x.Search"}
    hydra = {"sweeper": sweeper, "overrides": {"task": ["seed=interval(0,3)"]}}
    with pytest.raises(InputError, match=r"^shard=1/2 divides a list of jobs, which this sweeper does not"):
        SweepCallback()._begin(OmegaConf.create({"shard": "1/2", "hydra": hydra}))


def test_a_title_tells_what_is_swept():
    jobs = [{"row": "x", "+model.norm": norm, "seed": seed} for norm in ("none", "layer") for seed in "01"]
    assert sweep_title(jobs, ["+model.norm", "seed"]) == "model.norm=none,layer × seed=0,1"
    assert sweep_title(jobs, []) == ""


def sweep(folder, *overrides):
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
    return ["train.py", "-m", *SMALL, *own, *overrides, f"hydra.sweep.dir={folder}/out"]


def runs(store):
    """Return (name, status, parent) of every run that the UI shows, oldest first."""
    found = store.find()[::-1]
    return [(r.info.run_name, r.info.status, r.data.tags.get("mlflow.parentRunId")) for r in found]


def parents(store):
    return [run for run in store.find() if "sweep" in run.data.tags]


@pytest.mark.slow("trains several runs")
def test_a_run_is_named_by_its_changes_and_a_skipped_one_prints_its_scores(run, tmp_path, opened):
    words = ["train", *SMALL, "device.offset=0.2", "layout=grid", "model=mlp"]
    first = run(tmp_path, *words)
    (made,) = opened(tmp_path).find()
    assert made.info.run_name == named(0, " offset=0.2 layout=grid")
    assert len(made.info.run_name) == 80
    expected = {"device.offset": "0.2", "layout": "grid", "seed": "0", "learner": "rules"}
    assert expected.items() <= made.data.params.items()
    assert not {"representation", "model", "fusion"} & set(made.data.params)  # rules use none of them
    again = run(tmp_path, *words)
    assert "did this before" in again.stderr
    rows = [line for line in first.stdout.splitlines() if line.startswith("│")]
    assert rows == [line for line in again.stdout.splitlines() if line.startswith("│")]
    assert rows


@pytest.mark.slow("trains several runs")
def test_a_bad_job_fails_and_the_others_run(run, tmp_path, opened):
    done = run(tmp_path, *sweep(tmp_path, "device.offset=-1,0.1"), store=False, code=1)
    assert "[1/2] device.offset=-1: device.offset=-1 must be" in done.stderr
    store = opened(tmp_path)
    assert [each[:2] for each in runs(store) if each[2]] == [(named(0, " offset=0.1"), "FINISHED")]
    assert parents(store)[0].info.status == "FAILED"


@pytest.mark.slow("trains several runs")
def test_a_run_is_nested_under_the_sweep_that_trained_it(run, tmp_path, opened):
    for seeds in ("0,1,0", "1,0", "shuffle(0,1,2)"):
        done = run(tmp_path, *sweep(tmp_path, f"seed={seeds}"), store=False)
    assert done.stderr.count("did this before") == 2
    assert done.stdout.count(" on validation gestures\n") == 3
    store = opened(tmp_path)
    second, first = (parent.info for parent in parents(store))  # the one in between trained nothing
    assert (first.run_name, first.status) == ("seed=0,1", "FINISHED")
    children = {name: parent for name, _, parent in runs(store) if parent}
    assert children == {named(0): first.run_id, named(1): first.run_id, named(2): second.run_id}


@pytest.mark.slow("trains several runs in processes that import anew")
def test_parallel_jobs_end_in_a_finished_parent(run, tmp_path, opened):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    parallel = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    run(tmp_path, *sweep(tmp_path, "device.gain_spread=0.05,0.1", *parallel), store=False)
    (parent,) = parents(opened(tmp_path))
    assert parent.info.status == "FINISHED"


@pytest.mark.slow("composes several sweeps with trained runs")
@pytest.mark.parametrize("given", [["device.offset=-1,-2"], ["seed=x,y"], ["model=cn", "seed=0,1"]])
def test_a_sweep_that_trains_nothing_leaves_no_parent(run, tmp_path, given, opened):
    done = run(tmp_path, *sweep(tmp_path, *given), store=False, code=None)
    assert done.returncode in (1, 2)
    assert given[0].split("=")[1].split(",")[0] in done.stderr
    assert not (tmp_path / "m.db").exists() or not runs(opened(tmp_path))


@pytest.mark.slow("trains several runs")
def test_shards_train_every_job_once(run, tmp_path, opened):
    said = []
    for shard in ("1/2", "2/2", "3/3"):
        done = run(tmp_path, *sweep(tmp_path, "seed=0,1,0", f"shard={shard}"), store=False)
        said.append(done.stdout)
    assert "shard 3/3 has no job: the sweep has only 2" in said[2]
    store = opened(tmp_path)
    children = [(name, status) for name, status, parent in runs(store) if parent]
    assert sorted(children) == sorted((named(seed), "FINISHED") for seed in (0, 1))
    assert [parent.info.status for parent in parents(store)] == ["FINISHED", "FINISHED"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["shard=1/2"], "shard=1/2 divides the jobs of a multirun or a study: add -m"),
        (["-m", "shard=0/2"], "shard=0/2 names no part: give i/n"),
        (["-m", "+typo=1", "seed=0,1"], "typo"),
    ],
)
def test_what_no_job_could_accept_is_refused_once(run, tmp_path, words, said):
    done = run(tmp_path, "train", *words, *SMALL, code=2)
    assert (done.stdout, done.stderr.count(said)) == ("", 1)
    assert not (tmp_path / "m.db").exists()


@pytest.mark.parametrize("words", [["seed=0"], ["-m", "seed=0,1"]])
def test_a_server_that_is_away_is_told_before_anything_heavy_is_imported(words):
    with socket.create_server(("127.0.0.1", 0)) as closed:
        uri = f"http://127.0.0.1:{closed.getsockname()[1]}"
    code = "import atexit, sys\natexit.register(lambda: print('torch' in sys.modules))\n"
    code += f"from skin.__main__ import main\nmain({['train', *words, f'tracking.uri={uri}']})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, "False\n")
    assert f"the tracking server {uri} does not answer" in done.stderr


# Shards.


@given(st.lists(st.text()), st.integers(1, 20))
def test_parts_are_disjoint_complete_and_of_equal_size(names, count):
    parts = [Shard(number, count).part(names) for number in range(1, count + 1)]
    assert sorted(name for part in parts for name in part) == sorted(set(names))
    assert parts == [Shard(number, count).part(names[::-1]) for number in range(1, count + 1)]
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["0/8", "9/8", "3", "3/", "a/8", "-1/8", "1/0", "3/8/2", "", "1.0/2", "١/٢"])
def test_a_shard_is_written_as_number_and_count(text):
    assert Shard.parse("3/8") == Shard(3, 8)
    with pytest.raises(InputError, match="names no part: give i/n with i from 1 to n, as in shard=3/8"):
        Shard.parse(text)
