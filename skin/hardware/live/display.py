"""State shared by the classifying loop and the views."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Lock

import numpy as np

from skin.hardware.live.verdict import Verdict
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion

Observer = Callable[[Verdict | None, str, bool], None]
"""Takes the arguments of :meth:`Display.set_verdict`; it must return at once."""

_KEPT = 8192  # frames that are kept for slow views


@dataclass(frozen=True)
class DisplayInfo:
    """Constant information about a live view.

    Attributes:
        title: of the run.
        port: source of the frames.
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        top: upper end of the colour scale, N.
        window: length of the classified window, s.
    """

    title: str
    port: str
    positions: np.ndarray
    size: tuple[float, float]
    top: float
    window: float = 3.0


@dataclass(frozen=True)
class DisplayState:
    """State of the live view at one moment.

    Attributes:
        number: of frames so far, to be passed to the next :meth:`Display.state`.
        values: (S,), N, the largest of each sensor since the last call, so that no peak is missed; the limit
            of a saturated sensor, 0 of an invalid one.
        valid: (S,), bool, of the latest frame.
        saturated: (S,), bool, since the last call: the force is at least the value.
        verdict: the latest one; None if there is none now.
        trouble: message about why there is no verdict; else empty.
        alarm: the latest verdict was dangerous, and the contact has not ended as far as known.
        line: text with rate, lost frames and latency.
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
    """The latest frames, verdict and status, shared by one writing thread and any number of views.

    Attributes:
        info: as given.
        closed: event, set at the end.
        tare: event, set by a view to request a new baseline; cleared by the live loop.
        observers: called with each verdict, in the thread that classifies.
    """

    def __init__(self, info: DisplayInfo) -> None:
        self.info, self.closed, self.tare = info, Event(), Event()
        self.observers: list[Observer] = []
        self._lock = Lock()
        sensors = len(info.positions)
        first = np.zeros(sensors), np.zeros(sensors, dtype=bool)
        self._frames: deque[tuple[np.ndarray, np.ndarray]] = deque([first], maxlen=_KEPT)
        self._valid, self._alarm = np.ones(sensors, dtype=bool), False
        self._number = 0
        self._verdict: Verdict | None = None
        self._trouble, self._line = "waiting for the first frame", ""

    def add_frame(self, frame: Frame, conversion: UnitConversion) -> None:
        """Add a frame as sent, with the conversion of its values to N."""
        values, valid = conversion(frame.values, frame.valid)
        saturated = np.zeros_like(valid) if frame.saturated is None else frame.saturated & valid
        with self._lock:
            self._number += 1
            self._frames.append((values, saturated))
            self._valid = valid

    def set_verdict(self, verdict: Verdict | None, trouble: str = "", alarm: bool = False) -> None:
        """Set the verdict; or None with the reason and whether an alarm continues."""
        with self._lock:
            self._verdict, self._trouble = verdict, trouble
            self._alarm = alarm if verdict is None else verdict.dangerous
        for observer in self.observers:
            observer(verdict, trouble, alarm)

    def set_status(self, line: str) -> None:
        """Set the text with rate, lost frames and latency."""
        with self._lock:
            self._line = line

    def state(self, since: int = 0) -> DisplayState:
        """Return the state, with the largest values after the first ``since`` frames."""
        with self._lock:
            fresh = min(max(1, self._number - since), len(self._frames))
            latest = [self._frames[-1 - back] for back in range(fresh)]
            state = self._verdict, self._trouble, self._line, self._alarm
            number, valid = self._number, self._valid
        values, saturated = (np.max(part, axis=0) for part in zip(*latest, strict=True))
        return DisplayState(number, np.where(valid, values, 0.0), valid, saturated & valid, *state)
