"""Progress of a sweep or of a command, and the estimated duration."""

import csv
import math
import sys
import threading
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from skin.core.files import ROOT

if TYPE_CHECKING:
    from skin.runs.configuration import Config
    from skin.runs.store import Store


class SweepProgress:
    """Estimates the remaining time of a sweep.

    Args:
        seconds: earlier duration of each job on some machine, in order; None if unknown.
        finished: numbers of the jobs that have finished before, and take no time.
        partial: numbers of the jobs that continue an interrupted run, so that the time they take says nothing
            about the speed of the machine.
    """

    def __init__(
        self,
        seconds: list[float | None],
        finished: Collection[int] = (),
        partial: Collection[int] = (),
    ) -> None:
        measured = [value for value in seconds if value is not None]
        typical = sum(measured) / len(measured) if measured else 1.0
        self._expected = [typical if value is None else value for value in seconds]
        for number in finished:
            self._expected[number] = 0.0
        self._partial = frozenset(partial)
        self._sure = bool(measured)
        self._spent = self._done = 0.0

    def finish(self, number: int, seconds: float, skipped: bool) -> None:
        """Record the end of a job; skipped and continued jobs do not count for the machine's speed."""
        if not skipped and number not in self._partial:
            self._spent += seconds
            self._done += self._expected[number]
        self._expected[number] = 0.0

    def left(self) -> float | None:
        """Return the estimated remaining time, s, scaled by this machine's speed so far; None if unknown."""
        if not self._done:
            return sum(self._expected) if self._sure else None
        return sum(self._expected) * self._spent / self._done


def expected_seconds(store: "Store", config: "Config", tags: Mapping[str, str]) -> float | None:
    """Return the duration of the last finished run of the same row and simulator, s.

    Without one, it is estimated from the published table: seconds per epoch times epochs, plus a third for
    the evaluation. None if the row is not in the table.
    """
    same = {name: tags[name] for name in ("row", "simulator")}
    if finished := store.find("FINISHED", **same):
        info = finished[0].info
        return (info.end_time - info.start_time) / 1e3
    published = ROOT / "docs" / "results" / "table.csv"
    if not published.is_file():
        return None
    with published.open(newline="") as file:
        for line in csv.DictReader(file):
            if same.items() <= line.items() and line["seconds_per_epoch"]:
                return 5 + 1.3 * config.trainer["max_epochs"] * float(line["seconds_per_epoch"])
    return None


def format_duration(duration: float) -> str:
    """Return a duration in s as text."""
    minutes = math.ceil(duration / 60)
    if duration > 2 * 3600:
        return f"{duration / 3600:.1f} h"
    return f"{duration:.0f} s" if duration < 90 else f"{minutes} min"


class Steps:
    """Prints how far a command is, on standard error, every ten seconds; use it in a ``with`` statement.

    Args:
        seconds: duration of each step on some machine, in order, by what the command does in it.
        pause: s between two lines.

    Attributes:
        silent: whether to print nothing for now, such as while a person is prompted.
    """

    def __init__(self, seconds: Mapping[str, float], pause: float = 10.0) -> None:
        self._seconds, self._pause = dict(seconds), pause
        self._name, self.silent = next(iter(self._seconds)), False
        self._done = 0.0  # s of the steps that have ended, as expected
        self._began = self._step_began = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._report, daemon=True)

    def __enter__(self) -> "Steps":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def begin(self, name: str) -> None:
        """Say which step begins; those before it have ended."""
        names = list(self._seconds)
        self._done = sum(self._seconds[before] for before in names[: names.index(name)])
        self._name, self._step_began = name, time.monotonic()

    def line(self) -> str:
        """Return the step, the share that is done, and the estimated remaining time."""
        now, whole = time.monotonic(), sum(self._seconds.values())
        spent = self._step_began - self._began
        pace = spent / self._done if self._done and spent else 1.0  # s for each expected one
        # A step that takes longer than expected is almost done, never done.
        share = (now - self._step_began) / (pace * self._seconds[self._name])
        done = self._done + self._seconds[self._name] * min(share, 0.95)
        left = (now - self._began) * (whole / done - 1) if done else pace * whole
        return f"{self._name}: {100 * done / whole:.0f} % done, about {format_duration(left)} left"

    def _report(self) -> None:
        while not self._ended.wait(self._pause):
            if not self.silent:
                print(self.line(), file=sys.stderr, flush=True)
