"""The budget of processor time counts what a case itself takes, and nothing that others share."""

import subprocess
import sys
from contextlib import nullcontext, suppress
from importlib import import_module
from time import process_time
from types import SimpleNamespace

import pytest

from tests.budget import Budget, slowness

WORK = "sum(range(10_000_000))"


@pytest.fixture
def case(monkeypatch):
    """Return a function that runs a case of 0.05 s at most: the scope of its fixture, and its work."""
    monkeypatch.setattr("tests.budget.slowness", lambda: 1.0)
    budget = Budget(0.05)

    def run(work=lambda: None, scope="function", prepare=lambda: None, slow=False):
        item = SimpleNamespace(get_closest_marker=lambda name: name == "slow" and slow)
        through(budget.pytest_runtest_setup(), lambda: None)
        through(budget.pytest_fixture_setup(SimpleNamespace(scope=scope)), prepare)
        through(budget.pytest_runtest_call(item), work)

    return run


def through(hook, work):
    next(hook)
    work()
    with suppress(StopIteration):
        hook.send(None)


def spend():
    end = process_time() + 0.2
    while process_time() < end:
        pass


def test_a_case_that_takes_long_fails_unless_it_is_slow(case):
    case()
    case(spend, slow=True)
    with pytest.raises(pytest.fail.Exception, match=r"0\.\d s of processor time: more than 0\.05 s needs"):
        case(spend)


def test_processes_count_however_they_are_started(case, begin, tmp_path):
    script = tmp_path / "work.py"
    script.write_text(WORK)
    begin(tmp_path, script).wait()  # the starter, which all share
    for work in (
        lambda: subprocess.run([sys.executable, "-c", WORK], check=True),
        lambda: begin(tmp_path, script).wait(),
    ):
        with pytest.raises(pytest.fail.Exception, match="processor time"):
            case(work)


def test_what_others_share_is_free(case, tmp_path, monkeypatch):
    case(scope="module", prepare=spend)
    with pytest.raises(pytest.fail.Exception, match="processor time"):
        case(prepare=spend)
    (tmp_path / "imported_for_the_budget.py").write_text(WORK)
    monkeypatch.syspath_prepend(tmp_path)
    case(lambda: import_module("imported_for_the_budget"))


def test_a_busy_machine_gets_more(case, monkeypatch):
    assert slowness() >= 1
    monkeypatch.setattr("tests.budget.slowness", lambda: 100.0)
    case(spend)


@pytest.mark.parametrize(("mark", "refused"), [(pytest.mark.slow, True), (pytest.mark.slow("trains"), False)])
def test_a_slow_case_without_a_reason_is_refused(mark, refused):
    item = SimpleNamespace(nodeid="test_x", iter_markers=lambda name: [mark.mark])
    with pytest.raises(pytest.UsageError, match="test_x: give a reason") if refused else nullcontext():
        Budget().pytest_collection_modifyitems([item])
