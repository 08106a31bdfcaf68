"""The processor time of each case, and its limit."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import SourceFileLoader
from time import process_time

import pytest

__all__ = ["Budget", "charge", "free"]
LIMIT = 2.0  # s of processor time; 25 of 599 cases took half of the time of all
REFERENCE = 0.22  # s that :func:`slowness` computes on the machine on which the limit was set
# By which the time of a case varied: beside other work by 2, between machines by 3.3 (a frame of
# docs/results/contact.csv took 5.4 and 18 ms).
SPREAD = 3.5
_others = 0.0  # s, of the commands that the starter has run for this process
_free = 0.0  # s, that no case is charged with
_depth = 0  # of blocks that are free


def charge(seconds: float) -> None:
    """Count the processor time of a process that is no child of this one, in s."""
    global _others
    _others += seconds


def spent() -> float:
    """Return the processor time of this process, its children and the commands of the starter, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime + _others


@contextmanager
def free() -> Iterator[None]:
    """Do not count what happens inside, because others share it."""
    global _free, _depth
    begin, _depth = spent(), _depth + 1
    try:
        yield
    finally:
        _depth -= 1
        if not _depth:
            _free += spent() - begin


def slowness() -> float:
    """Return how many times as long as on the reference a fixed computation takes now; at least 1.

    It waits for memory as much as it computes, as cases do: others on the machine delay that most.
    """
    begin = process_time()
    len({number * 7919 % 1_000_003 for number in range(1_000_000)})
    return max(1.0, (process_time() - begin) / REFERENCE)


class Budget:
    """Fail a case that is not marked slow and takes more than ``limit`` seconds of processor time.

    The call and the fixtures of one function count, with all processes that they wait for. What others
    share does not count: fixtures of modules and of the session, and the import of modules. On a slower or
    busier machine the limit grows, and it is multiplied by :data:`SPREAD`.

    Attributes:
        limit: s of processor time.
    """

    def __init__(self, limit: float = LIMIT) -> None:
        self.limit, self._begin = limit, 0.0

    def pytest_sessionstart(self) -> None:
        """Let imports be free."""
        load = SourceFileLoader.exec_module

        def exec_module(loader: SourceFileLoader, module) -> None:
            with free():
                load(loader, module)

        SourceFileLoader.exec_module = exec_module  # type: ignore[method-assign]

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Refuse slow cases that do not say why."""
        for item in items:
            if any(not any((*mark.args, *mark.kwargs.values())) for mark in item.iter_markers("slow")):
                raise pytest.UsageError(f"{item.nodeid}: give a reason, as slow('trains three models')")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        """Do not count what cases share."""
        if fixturedef.scope == "function":
            return (yield)
        with free():
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self):
        """Begin to count."""
        self._begin = spent() - _free
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item):
        """Compare with the limit."""
        result = yield
        seconds = spent() - _free - self._begin
        maximum = SPREAD * self.limit
        if seconds > maximum and not item.get_closest_marker("slow") and seconds > maximum * slowness():
            pytest.fail(
                f"{seconds:.1f} s of processor time: more than {self.limit} s needs pytest.mark.slow(reason)"
            )
        return result
