"""State shared by the classifying loop and the views."""

from collections import deque
from dataclasses import dataclass
from threading import Event, Lock

import numpy as np

from skin.hardware.live.verdict import Verdict
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion

_KEPT = 8192  # frames that a view may be late by


@dataclass(frozen=True)
class DisplayInfo:
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
class DisplayState:
    """What there is to show now.

    Attributes:
        number: of frames so far; ask the next time for what came since.
        values: (S,), N, the largest of each sensor since the last look, so that no peak is missed; the limit
            of a saturated sensor, 0 of an unknown one.
        valid: (S,), bool, of the latest frame: False where a sensor's force is unknown.
        saturated: (S,), bool, since the last look: the force is at least the value.
        verdict: None where there is none now.
        trouble: why there is none, for a person; empty if all is well.
        alarm: the latest verdict there was is dangerous, and nobody knows that the contact has ended.
        line: rate, lost frames and latency, for a person.
    """

    number: int
    values: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    verdict: Verdict | None
    trouble: str
    line: str
    alarm: bool = False


class Display:
    """The latest frames, verdict and state; one thread writes, any number look.

    Attributes:
        info: as given.
        closed: set at the end.
        tare: set by a view whose operator asks for a new baseline; cleared by the one who takes it.
    """

    def __init__(self, info: DisplayInfo) -> None:
        self.info, self.closed, self.tare = info, Event(), Event()
        self._lock = Lock()
        sensors = len(info.positions)
        first = np.zeros(sensors), np.zeros(sensors, dtype=bool)
        self._frames: deque[tuple[np.ndarray, np.ndarray]] = deque([first], maxlen=_KEPT)
        self._valid, self._alarm = np.ones(sensors, dtype=bool), False
        self._number = 0
        self._verdict: Verdict | None = None
        self._trouble, self._line = "waiting for the first frame", ""

    def add_frame(self, frame: Frame, conversion: UnitConversion) -> None:
        """Take a frame as the device sent it, and what its values mean."""
        values, valid = conversion(frame.values, frame.valid)
        saturated = np.zeros_like(valid) if frame.saturated is None else frame.saturated & valid
        with self._lock:
            self._number += 1
            self._frames.append((values, saturated))
            self._valid = valid

    def set_verdict(self, verdict: Verdict | None, trouble: str = "", alarm: bool = False) -> None:
        """Take a verdict, or why there is none and whether an alarm has not ended."""
        with self._lock:
            self._verdict, self._trouble = verdict, trouble
            self._alarm = alarm if verdict is None else verdict.dangerous

    def set_status(self, line: str) -> None:
        """Take the line about rate, lost frames and latency."""
        with self._lock:
            self._line = line

    def state(self, since: int = 0) -> DisplayState:
        """Return what there is to show to whom has seen ``since`` frames."""
        with self._lock:
            fresh = min(max(1, self._number - since), len(self._frames))
            latest = [self._frames[-1 - back] for back in range(fresh)]
            state = self._verdict, self._trouble, self._line, self._alarm
            number, valid = self._number, self._valid
        values, saturated = (np.max(part, axis=0) for part in zip(*latest, strict=True))
        return DisplayState(number, np.where(valid, values, 0.0), valid, saturated & valid, *state)
