"""The last frames of a stream, at the rate that a model knows."""

from typing import NamedTuple

import numpy as np

from skin.errors import InputError
from skin.port.frame import Frame

__all__ = ["Seen", "Window"]

_SLOWER = 1.05  # by this much a device's clock may be wrong before it is too slow
_FEW = 8  # frames from which no rate can be told
_MANY = 256  # frames over which it is taken


class Seen(NamedTuple):
    """What a window shows.

    Attributes:
        readings: (T, S), the maximum over each interval, float32; 0 where nothing is valid.
        valid: (T, S), bool.
        gap: frames are missing in it.
    """

    readings: np.ndarray
    valid: np.ndarray
    gap: bool


class Window:
    """Slides at every frame of a device and shows T intervals of a model's rate, the latest ending now.

    A faster stream is reduced by the maximum over each interval. An interval without frames is not valid: a
    gap is never filled. Nothing is shown before T intervals have come since the device started.

    A value that is not valid but above all valid ones of its channel in the window stays: a sensor that a
    hard press drives to its limit says at least that much, and masking it would hide the press.

    Args:
        frames: T.
        rate: of the model, Hz.
        sensors: S.
    """

    def __init__(self, frames: int, rate: float, sensors: int) -> None:
        self.frames, self.rate, self.sensors = frames, rate, sensors
        self._clear(4 * frames)

    def _clear(self, room: int) -> None:
        self._times, self._lost = np.empty(room), np.zeros(room, dtype=np.int64)
        self._values = np.empty((room, self.sensors))
        self._valid = np.empty((room, self.sensors), dtype=bool)
        self._end, self._segment = 0, -1

    @property
    def period(self) -> float:
        """Seconds from one frame of the device to the next; 0 if too few came.

        The least of median and mean: a pause spoils the mean, frames that come in bursts spoil the median.
        """
        first = max(0, self._end - _MANY)
        times, lost = self._times[first : self._end], self._lost[first : self._end]
        if len(times) < _FEW:
            return 0.0
        mean = float(times[-1] - times[0]) / (len(times) - 1 + int(lost[1:].sum()))
        median = float(np.median(np.diff(times)))
        return min(mean, median) if median > 0 else mean

    @property
    def filled(self) -> float:
        """How much of the window has come, from 0 to 1."""
        if not self._end:
            return 0.0
        came = self._times[self._end - 1] - self._times[0]
        return float(min(1.0, came * self.rate / self.frames))

    def add(self, frame: Frame) -> None:
        """Take a frame; another segment begins another window."""
        if frame.segment != self._segment:
            self._clear(len(self._times))
            self._segment = frame.segment
        if self._end == len(self._times):
            self._make_room()
        here, self._end = self._end, self._end + 1
        self._times[here], self._lost[here] = frame.t, max(frame.lost, int(frame.after == "gap"))
        self._values[here], self._valid[here] = frame.values, frame.valid

    def read(self) -> Seen | None:
        """Return what the window shows now; None while it is not full.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        period, interval = self.period, 1 / self.rate
        if not period:
            return None
        if period > _SLOWER * interval:
            raise InputError(
                f"the device sends {1 / period:.3g} frames a second, the model needs {self.rate:g}: let the "
                f"device send faster, or train with device.rate={1 / period:.2g}"
            )
        interval = max(interval, period)
        now, span = self._times[self._end - 1], self.frames * interval
        if now - self._times[0] + 1.5 * period < span:
            return None
        first = int(np.searchsorted(self._times[: self._end], now + 0.5 * period - span, side="right"))
        # Half a period off the edges, so that a frame that comes a little late falls where it belongs.
        age = (now + 0.5 * period - self._times[first : self._end]) / interval
        place = self.frames - 1 - np.minimum(age.astype(np.int64), self.frames - 1)
        return self._reduced(first, place)

    def _reduced(self, first: int, place: np.ndarray) -> Seen:
        """Return the maxima over each interval, of frames from ``first`` on at ``place`` (F,), rising."""
        values, valid = self._values[first : self._end], self._valid[first : self._end]
        known = np.where(valid, values, -np.inf)
        if not valid.all():
            highest = known.max(axis=0)
            with np.errstate(invalid="ignore"):
                known = np.where(np.isfinite(highest) & (values > highest), values, known)
        begins = np.searchsorted(place, np.arange(self.frames))
        some = np.diff(begins, append=len(place)) > 0
        readings = np.full((self.frames, self.sensors), -np.inf)
        readings[some] = np.maximum.reduceat(known, begins[some], axis=0)
        found = np.isfinite(readings)
        gap = bool(self._lost[first + 1 : self._end].any()) or not some.all()
        return Seen(np.where(found, readings, 0).astype(np.float32), found, gap)

    def _make_room(self) -> None:
        """Forget what no window will show again, and double the room if that is not half of it."""
        since = self._times[self._end - 1] - 1.1 * _SLOWER * self.frames / self.rate
        first = min(int(np.searchsorted(self._times[: self._end], since)), max(0, self._end - _MANY))
        kept = slice(first, self._end)
        old = self._times[kept], self._lost[kept], self._values[kept], self._valid[kept]
        segment, room = self._segment, len(self._times)
        self._clear(room if 2 * len(old[0]) <= room else 2 * room)
        self._end, self._segment = len(old[0]), segment
        new = self._times, self._lost, self._values, self._valid
        for target, source in zip(new, old, strict=True):
            target[: self._end] = source
