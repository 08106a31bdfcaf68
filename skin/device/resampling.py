"""Resampling of a device's frames to the rate of a model, for live and recorded touches."""

from typing import Any, Literal, NamedTuple

import numpy as np

from skin.errors import InputError

# One frame of a skin, and the time of a stream of them.


Check = Literal["crc16", "xor", "none"]
After = Literal["", "gap", "cut", "reset", "reconnect"]
"""Interruption before a frame: none; lost frames; another touch of a recording; a restart of the device; a
reconnection. Of several, the last in this list counts."""

INWARDS = slice(2, None, 3)
"""Channels that measure inwards, of sites with three axes: a network of normal sensors takes these."""
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
        mask: (S,), int: why values are not valid or at their limit, bits of
            :class:`skin.wire.channels.Reason`; None: not known.
        three: the frame of all channels of sites with three axes, of which this one has those inwards; None:
            this one has all that the device sent.
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
    mask: np.ndarray | None = None
    three: "Frame | None" = None

    def inwards(self) -> "Frame":
        """Return the channels :data:`INWARDS` of this frame, which that keeps."""
        names = ("values", "valid", "saturated", "polarity", "mask")
        parts: Any = {name: part[INWARDS] for name in names if (part := getattr(self, name)) is not None}
        return self._replace(three=self, **parts)

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
        reason: ``checksum``, ``fields`` (their count), ``number``, ``long``, ``structure``, ``rows`` or
            ``repeat``.
        found: number of fields, for the reason ``fields``.
        word: the field, for the reason ``number``.
    """

    def __init__(self, reason: str, count: int | None = None, word: str = "") -> None:
        super().__init__(reason)
        self.reason, self.found, self.word = reason, count, word


_SLOWER = 1.05  # tolerance for the error of a ceramic resonator and for lost frames
_FEW = 8  # frames below which no rate is estimated
_MANY = 256  # frames over which the rate is estimated


class Resampled(NamedTuple):
    """A window of a stream at the rate of a model.

    Attributes:
        values: (T, S), the largest valid value of each interval, in the unit of the frames. The smallest
            where values fall with force; 0 without one.
        valid: (T, S), bool: the interval has a valid value.
        saturated: (T, S), bool: a valid value of the interval is at the sensor's limit.
        gap: whether frames are missing in the window.
        before: number of intervals that end before the first frame of the stream; they are not valid.
    """

    values: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    gap: bool = False
    before: int = 0


def resample(
    time: np.ndarray,
    values: np.ndarray,
    valid: np.ndarray,
    saturated: np.ndarray,
    end: float,
    interval: float,
    window: int,
    polarity: np.ndarray | None = None,
) -> Resampled:
    """Return the value of most force of each sensor over each of the ``window`` intervals before ``end``.

    Invalid values do not count. An interval without frames is invalid: nothing is interpolated. Frames on the
    edge between two intervals could fall in either: give an ``end`` halfway between two frames.

    Args:
        time: (F,), s, rising.
        values: (F, S).
        valid: (F, S), bool.
        saturated: (F, S), bool.
        end: of the window, s.
        interval: s.
        window: T.
        polarity: (S,), -1 where values fall with force; their minimum is taken. None: the maximum of all.
    """
    values = values if polarity is None else values * polarity
    age = np.floor((end - time) / interval)
    inside = np.flatnonzero((age >= 0) & (age < window))
    position = window - 1 - age[inside].astype(np.int64)
    begins = np.searchsorted(position, np.arange(window))
    some = np.diff(begins, append=len(position)) > 0
    good = valid[inside]
    highest = np.full((window, values.shape[1]), -np.inf)
    limited = np.zeros(highest.shape, dtype=bool)
    if some.any():
        known_values = np.where(good, values[inside], -np.inf)
        highest[some] = np.maximum.reduceat(known_values, begins[some], axis=0)
        limited[some] = np.logical_or.reduceat(good & saturated[inside], begins[some], axis=0)
    has_value = np.isfinite(highest)
    strongest = np.where(has_value, highest, 0.0)
    return Resampled(strongest if polarity is None else strongest * polarity, has_value, limited)


def frame_ages(ratios: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the gesture and the age of each frame of many windows, (N,), gesture by gesture, oldest first.

    As in a live window, the last frame is half its interval before the end.

    Args:
        ratios: (B,), frames of the device per interval of the model, at least 1.
        window: number of intervals.

    Returns:
        gesture, from 0; age before the end of the window, in intervals of the model.
    """
    counts = np.ceil(window * ratios - 0.5).astype(int)
    gesture = np.repeat(np.arange(len(counts)), counts)
    left = np.repeat(np.cumsum(counts), counts) - np.arange(len(gesture))
    return gesture, (left - 0.5) / ratios[gesture]


def highest_each(values: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the largest of the values (N, S) of every interval, whose ``number`` (N,) rises, (I, S)."""
    return np.maximum.reduceat(values, np.flatnonzero(np.diff(number, prepend=-1)), axis=0)


def check_rate(measured: float, rate: float, setting: str | None = None) -> None:
    """Check that a device is fast enough for a model.

    Args:
        measured: rate of the device, Hz.
        rate: of the model, Hz.
        setting: name of the setting with the rate of a simulated device; None: the device is real.

    Raises:
        InputError: the device is slower by more than 5 %.
    """
    if _SLOWER * measured < rate:
        remedy = (
            "let the firmware send faster, or train a model at the device's rate, as in "
            f"touch.rate={measured:.2g}"
            if setting is None
            else f"raise {setting}, or lower touch.rate, as in {setting}={rate:g}"
        )
        raise InputError(
            f"the device sends {measured:.3g} frames a second, the model needs {rate:g}: {remedy}"
        )


class Window:
    """A sliding window over the frames of a stream.

    A faster stream is reduced by the maximum over each interval of the model. A device that is slower by up
    to 5 % gives one frame to each interval. Another segment of the device's clock begins an empty window.
    Of sensors whose values fall with force, the minimum is taken instead: frames carry their polarity.

    Args:
        frames: T.
        rate: of the model, Hz.
        sensors: S.
    """

    def __init__(self, frames: int, rate: float, sensors: int) -> None:
        self.frames, self.rate, self.sensors = frames, rate, sensors
        self._period = 0.0
        self._polarity: np.ndarray | None = None
        each = (sensors,)
        columns = [("t", float), ("lost", int), ("values", float, each), ("valid", bool, each)]
        self._rows = np.empty(4 * frames, [*columns, ("saturated", bool, each)])  # of frames, grows
        self._end, self._segment = 0, -1

    def clear(self) -> None:
        """Remove all frames; the known period of the device is kept."""
        self._end, self._segment = 0, -1

    @property
    def period(self) -> float:
        """Time between two frames of the device, s; with few frames, that before; 0 if unknown.

        The smaller of median and mean: pauses distort the mean, bursts of frames the median.
        """
        rows = self._rows[max(0, self._end - _MANY) : self._end]
        times, lost = rows["t"], rows["lost"]
        if len(times) >= _FEW:
            mean = float(times[-1] - times[0]) / (len(times) - 1 + int(lost[1:].sum()))
            median = float(np.median(np.diff(times)))
            self._period = min(mean, median) if median > 0 else mean
        return self._period

    def add(self, frame: "Frame") -> None:
        """Add a frame."""
        if frame.segment != self._segment:
            self.clear()
            self._segment = frame.segment
        if self._end == len(self._rows):
            self._make_room()
        lost = max(frame.lost, int(frame.after == "gap"))
        saturated = False if frame.saturated is None else frame.saturated
        self._rows[self._end] = frame.t, lost, frame.values, frame.valid, saturated
        self._end, self._polarity = self._end + 1, frame.polarity

    def read(self, partial: bool = False) -> Resampled | None:
        """Return the window that ends with the latest frame; None before T intervals are complete.

        Args:
            partial: do not wait; missing intervals are invalid. None before the rate is known.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        period = self.period
        if not period:
            return None
        check_rate(1 / period, self.rate)
        interval, now = max(1 / self.rate, period), self._rows["t"][self._end - 1]
        if not partial and now - self._rows["t"][0] + 1.5 * period < self.frames * interval:
            return None
        return self._resample_until(now + 0.5 * period, interval)

    def since(self, begin: float) -> Resampled:
        """Return the window that began at ``begin``, s; read it before a frame behind its end is added.

        It is the window that :meth:`read` returned at its last frame. Intervals without frames are invalid.
        """
        period = self.period or 1 / self.rate
        interval = max(1 / self.rate, period)
        end = begin + self.frames * interval - 0.5 * period
        latest = self._rows["t"][self._end - 1] + 0.5 * period if self._end else end
        # Where the last frames were lost, the window ends without them.
        return self._resample_until(latest if abs(latest - end) <= period else end, interval)

    def _resample_until(self, end: float, interval: float) -> Resampled:
        times = self._rows["t"][: self._end]
        first = int(np.searchsorted(times, end - (self.frames + 1) * interval))
        rows = self._rows[first : int(np.searchsorted(times, end))]
        values, valid, saturated = rows["values"], rows["valid"], rows["saturated"]
        resampled = resample(rows["t"], values, valid, saturated, end, interval, self.frames, self._polarity)
        # A loss before the window's first frame is not in the window.
        inside = rows[rows["t"] > end - self.frames * interval]
        ages = np.unique(np.floor((end - inside["t"]) / interval))
        before = max(0, self.frames - 1 - int((end - times[0]) / interval)) if len(times) else self.frames
        missing = self.frames - before - len(ages)
        return resampled._replace(gap=bool(inside["lost"][1:].any()) or missing > 0, before=before)

    def _make_room(self) -> None:
        """Discard frames older than the window; double the capacity unless that frees half of it."""
        times, capacity = self._rows["t"], len(self._rows)
        since = np.searchsorted(times, times[-1] - 1.1 * _SLOWER * self.frames / self.rate)
        kept = self._rows[min(int(since), max(0, capacity - _MANY)) :]
        room = (capacity if 2 * len(kept) <= capacity else 2 * capacity) - len(kept)
        self._rows, self._end = np.concatenate([kept, np.empty(room, kept.dtype)]), len(kept)
