"""What the views show: written by the one who classifies, read by the terminal and the page."""

from collections import deque
from dataclasses import dataclass
from threading import Event, Lock

import numpy as np

from skin.live.verdict import Verdict
from skin.port.frame import Frame

__all__ = ["Board", "Facts", "Look"]

_KEPT = 8192  # frames that a view may be late by


@dataclass(frozen=True)
class Facts:
    """What does not change while a skin is watched.

    Attributes:
        title: of the run.
        port: where frames come from.
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        top: N at the end of the colour scale.
        window: s that a verdict is about.
    """

    title: str
    port: str
    positions: np.ndarray
    size: tuple[float, float]
    top: float
    window: float = 3.0


@dataclass(frozen=True)
class Look:
    """What there is to show now.

    Attributes:
        number: of frames so far; ask the next time for what came since.
        values: (S,), N, the largest of each sensor since the last look, so that no peak is missed.
        valid: (S,), bool, of the latest frame.
        verdict: None where there is none now.
        trouble: why there is none, for a person; empty if all is well.
        line: rate, lost frames and latency, for a person.
    """

    number: int
    values: np.ndarray
    valid: np.ndarray
    verdict: Verdict | None
    trouble: str
    line: str


class Board:
    """The latest frames, verdict and state; one thread writes, any number look.

    Attributes:
        facts: as given.
        closed: set at the end.
    """

    def __init__(self, facts: Facts) -> None:
        self.facts, self.closed = facts, Event()
        self._lock = Lock()
        sensors = len(facts.positions)
        self._frames: deque[np.ndarray] = deque([np.zeros(sensors)], maxlen=_KEPT)
        self._valid = np.ones(sensors, dtype=bool)
        self._number = 0
        self._verdict: Verdict | None = None
        self._trouble, self._line = "waiting for the first frame", ""

    def show(self, frame: Frame) -> None:
        """Take a frame in N."""
        with self._lock:
            self._number += 1
            self._frames.append(np.where(frame.valid, frame.values, 0.0))
            self._valid = frame.valid

    def say(self, verdict: Verdict | None, trouble: str = "") -> None:
        """Take a verdict, or why there is none."""
        with self._lock:
            self._verdict, self._trouble = verdict, trouble

    def tell(self, line: str) -> None:
        """Take the line about rate, lost frames and latency."""
        with self._lock:
            self._line = line

    def look(self, since: int = 0) -> Look:
        """Return what there is to show to whom has seen ``since`` frames."""
        with self._lock:
            fresh = min(max(1, self._number - since), len(self._frames))
            latest = [self._frames[-1 - back] for back in range(fresh)]
            state = self._valid, self._verdict, self._trouble, self._line
            number = self._number
        return Look(number, np.max(latest, axis=0), *state)
