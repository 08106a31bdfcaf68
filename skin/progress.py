"""Progress of a sweep and its estimated duration."""

import csv
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from skin.paths import ROOT

if TYPE_CHECKING:
    from skin.tracking import Store


class SweepProgress:
    """Estimates the remaining time of a sweep.

    Args:
        seconds: earlier duration of each job on some machine, in order; None if unknown.
    """

    def __init__(self, seconds: list[float | None]) -> None:
        known = [value for value in seconds if value is not None]
        typical = sum(known) / len(known) if known else 1.0
        self._expected = [typical if value is None else value for value in seconds]
        self._sure = bool(known)
        self._spent = self._done = 0.0

    def finish(self, number: int, seconds: float, skipped: bool) -> None:
        """Record the end of a job; skipped jobs do not count for the machine's speed."""
        if not skipped:
            self._spent += seconds
            self._done += self._expected[number]
        self._expected[number] = 0.0

    def left(self) -> float | None:
        """Return the estimated remaining time, s, scaled by this machine's speed so far; None if unknown."""
        if not self._done:
            return sum(self._expected) if self._sure else None
        return sum(self._expected) * self._spent / self._done


def expected_seconds(store: "Store", config: DictConfig, tags: Mapping[str, str]) -> float | None:
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
                return 5 + 1.3 * config.trainer.max_epochs * float(line["seconds_per_epoch"])
    return None


def format_duration(duration: float) -> str:
    """Return a duration in s as text."""
    minutes = math.ceil(duration / 60)
    if duration > 2 * 3600:
        return f"{duration / 3600:.1f} h"
    return f"{duration:.0f} s" if duration < 90 else f"{minutes} min"
