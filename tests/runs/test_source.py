"""Results tell their code and processor; reused results of other code are named in one warning."""

import subprocess

import pytest

from skin import __version__
from skin.runs import configuration as fingerprint
from skin.runs.configuration import source_tags

RULES = ["experiment=rules", "simulator=naive", "data.gestures=80", "device.test_gestures=48",
         "evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=48"]  # fmt: skip


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
    monkeypatch.setattr(fingerprint, "ROOT", tmp_path)
    monkeypatch.setattr(fingerprint, "BUNDLED", tmp_path)
    monkeypatch.setattr(fingerprint, "_FOLDERS", ("skin",))
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
    monkeypatch.setattr(fingerprint, "ROOT", tmp_path)
    monkeypatch.setattr(fingerprint, "BUNDLED", tmp_path)
    assert (tags()["source_commit"], tags()["source_dirty"]) == (__version__, "unknown")


def test_the_processor_has_a_name():
    assert len(tags()["processor"]) > 2


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
