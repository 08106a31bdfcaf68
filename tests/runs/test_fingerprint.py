"""A run is the same one on another machine; results tell their code and processor."""

import subprocess
from copy import deepcopy
from dataclasses import replace

import pytest

from skin import __version__
from skin.runs import configuration
from skin.runs.configuration import ADDED, fingerprint, settings_hash, source_tags

RULES = ["experiment=rules", "simulator=naive", "data.gestures=80", "device.test_gestures=48",
         "evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=48"]  # fmt: skip


@pytest.mark.parametrize(
    ("overrides", "same"),
    [
        (["tracking.uri=sqlite:///elsewhere.db", "tracking.resume=false", "tracking.threads=1"], True),
        (["trainer.precision=bf16-mixed", "trainer.accelerator=gpu"], True),
        (["trainer.devices=2", "trainer.strategy=ddp", "+trainer.num_nodes=2"], True),
        (["+trainer.enable_progress_bar=true"], True),
        *(
            ([word], False)
            for word in ("seed=1", "simulator=naive", "device.noise=1", "trainer.max_epochs=3")
        ),
    ],
)
@pytest.mark.parametrize("learner", ["network", "ensemble"])
def test_only_what_results_depend_on_changes_the_fingerprint(configured, overrides, same, learner):
    plain = f"learner={learner}"
    assert (fingerprint(configured(plain, *overrides)) == fingerprint(configured(plain))) == same


def test_a_changed_layout_file_changes_the_fingerprint(configured, tmp_path):
    path, prints = tmp_path / "sensors.csv", []
    for y in (0.05, 0.05, 0.06):
        path.write_text(f"x_m,y_m\n0.05,{y}\n")
        prints.append(fingerprint(configured(f"layout.path={path}")))
    assert prints[0] == prints[1] != prints[2]


@pytest.mark.parametrize("device", ["simulated", "skins"])
@pytest.mark.parametrize("profile", ["mild", "rough", "harsh", "calibrated", "drawn"])
def test_settings_that_came_later_make_no_other_run(configured, device, profile):
    """A run that finished before them has their values without naming them, and is found again."""
    config = configured(f"device={device}", f"profile={profile}")
    former = deepcopy(config)
    groups = [former.device, former.device.get("skins", {}), former.device["touch"], former.touch]
    missing = [{name: group.pop(name) for name in ADDED if name in group} for group in groups]
    assert set().union(*missing) >= {"scale_spread", "independent", "aligned", "framed", "second"}
    assert all(value == ADDED[name] for group in missing for name, value in group.items())
    assert fingerprint(config) == fingerprint(former)
    others = {"scale_spread": 0.1, "independent": True, "aligned": False, "framed": 0.1}
    for name, value in others.items():
        assert fingerprint(replace(former, device=former.device | {name: value})) != fingerprint(former)


def test_a_data_set_counts_by_its_manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hashes = []
    for manifest in (None, "one", "other"):
        if manifest:
            (tmp_path / "touches").mkdir(exist_ok=True)
            (tmp_path / "touches" / "manifest.json").write_text(manifest)
        hashes.append({settings_hash({"path": path}) for path in ("touches", "./touches")})
    assert len(set.union(*hashes)) == 6


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A clone with one commit of code; returns a function that runs git in it."""

    def git(*arguments):
        identity = ["-c", "user.name=n", "-c", "user.email=e"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    git("init")
    (tmp_path / "skin").mkdir()
    (tmp_path / "skin" / "a.py").write_text("1")
    git("add", ".")
    git("commit", "-m", "code")
    monkeypatch.setattr(configuration, "ROOT", tmp_path)
    monkeypatch.setattr(configuration, "BUNDLED", tmp_path)
    monkeypatch.setattr(configuration, "_FOLDERS", ("skin",))
    return git


def tags():
    source_tags.cache_clear()
    try:
        return source_tags()
    finally:
        source_tags.cache_clear()


def test_the_commit_is_the_last_one_that_changed_code(repository, tmp_path):
    code = repository("rev-parse", "HEAD")
    assert (tags()["source_commit"], tags()["source_dirty"]) == (code, "false")
    (tmp_path / "results.md").write_text("numbers")
    repository("add", ".")
    repository("commit", "-m", "results")
    assert (tags()["source_commit"], tags()["source_dirty"]) == (code, "false")
    (tmp_path / "skin" / "new.py").write_text("2")
    assert (tags()["source_commit"], tags()["source_dirty"]) == (code, "true")


def test_without_git_the_version_stands_for_the_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(configuration, "ROOT", tmp_path)
    monkeypatch.setattr(configuration, "BUNDLED", tmp_path)
    assert (tags()["source_commit"], tags()["source_dirty"]) == (__version__, "unknown")


@pytest.mark.slow("trains and evaluates again")
def test_one_warning_tells_of_reused_results_of_other_code(run, tmp_path):
    from skin.runs.configuration import Tracking
    from skin.runs.store import Store

    words = ["-m", *RULES, "seed=0,1"]
    first = run(tmp_path, "train", *words)
    assert first.returncode == 0, first.stderr
    assert "reused" not in first.stderr
    store = Store.open(Tracking(f"sqlite:///{tmp_path}/m.db", f"{tmp_path}/a", "skin", True, None))
    for one in store.find("FINISHED", row="rules"):
        store.client.set_tag(one.info.run_id, "source_commit", "0" * 40)
    again = run(tmp_path, "train", *words, apart=True)  # a process warns once
    assert again.returncode == 0
    assert again.stderr.count("\n") == 3
    assert again.stderr.count("results of other code are reused") == 1
