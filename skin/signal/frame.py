"""One frame of a skin, and the time of a stream of them."""

from typing import Literal, NamedTuple

import numpy as np

Check = Literal["crc16", "xor", "none"]
After = Literal["", "gap", "cut", "reset", "reconnect"]
"""Interruption before a frame: none; lost frames; another touch of a recording; a restart of the device; a
reconnection. Of several, the last in this list counts."""

_WEIGHT: dict[After, int] = {"": 0, "gap": 1, "cut": 2, "reset": 3, "reconnect": 4}


class Frame(NamedTuple):
    """The readings of all sensors at one moment.

    Attributes:
        seq: the device's frame number, as sent; None if it sends none.
        t: s, the device's clock, unwrapped, within a segment; the host's if the device sends no time.
        t_host: s, the host's monotonic clock (``time.monotonic``), never before the frame before.
        values: (S,), float64, as sent (raw counts, or N from a recording). Never NaN: where the device sent
            no number, the channel's last value, 0 before its first.
        valid: (S,), bool: False for stuck and dead channels, and where the device sent no number.
        segment: number of restarts, reconnections and cuts so far; a window should not span two segments.
        lost: number of frames known to be missing just before this one.
        after: interruption before this frame; empty if there is none.
        saturated: (S,), bool: the channel is at its limit, so the force is at least its value; None: no
            channel is.
        polarity: (S,), float64: -1 where the value falls with force, else 1; None: 1 for all.
    """

    seq: int | None
    t: float
    t_host: float
    values: np.ndarray
    valid: np.ndarray
    segment: int = 0
    lost: int = 0
    after: After = ""
    saturated: np.ndarray | None = None
    polarity: np.ndarray | None = None

    def behind(self, dropped: "Frame") -> "Frame":
        """Return this frame with the previous one, which was dropped, counted as lost."""
        after = max(self.after, dropped.after, "gap", key=_WEIGHT.__getitem__)
        return self._replace(lost=self.lost + dropped.lost + 1, after=after)


class StreamClock:
    """Time of a stream that goes on over restarts of its device, whose clock begins again then."""

    def __init__(self) -> None:
        self._segment: int | None = None
        self._shift = self._host = 0.0
        self._latest: float | None = None

    def __call__(self, frame: Frame) -> float:
        """Return the time of a frame, s: the device's clock, with the host's time between two segments."""
        if frame.segment != self._segment and self._latest is not None:
            self._shift = self._latest + max(frame.t_host - self._host, 0.0) - frame.t
        self._segment, self._host = frame.segment, frame.t_host
        self._latest = frame.t + self._shift
        return self._latest


class FrameError(Exception):
    """A frame that cannot be used.

    Attributes:
        reason: ``checksum``, ``fields`` (their count), ``number``, ``long``, ``structure`` or ``repeat``.
        found: number of fields, for the reason ``fields``.
    """

    def __init__(self, reason: str, count: int | None = None) -> None:
        super().__init__(reason)
        self.reason, self.found = reason, count
