"""Sequence numbers and device time: missing frames, restarts, segments."""

from collections import deque
from typing import NamedTuple

from skin.device.resampling import After, FrameError

_WRAP = 2**32  # microseconds: 71.6 minutes
_WRAPS = (2**16, 2**32)  # of seq: what firmware counts in
_ACROSS = 4096  # frames that may be missing where seq wraps
_WRAP_GAP = 60_000_000  # microseconds that may be missing where the clock wraps


class FramePosition(NamedTuple):
    """Time, segment and losses of a frame, as in :class:`skin.device.resampling.Frame`."""

    t: float
    segment: int
    lost: int
    after: After


def frames_ahead(before: int, seq: int) -> int:
    """Return by how many frames ``seq`` is ahead of ``before``, u16 or u32 wrapped; 0 if it is not."""
    if seq > before:
        return seq - before
    for wrap in _WRAPS:
        if wrap - _ACROSS <= before < wrap and seq - before + wrap <= _ACROSS:
            return seq - before + wrap
    return 0


class SequenceTracker:
    """Tracks seq and the device's clock from frame to frame."""

    def __init__(self) -> None:
        self.segment = 0
        self._after: After = ""
        self._last: tuple[int, float] | None = None
        self._wrapped = 0

    def cut(self, after: After) -> None:
        """Start a new segment with the next frame; ``after`` is the reason."""
        self._after = after

    def place(self, seq: int | None, t_us: float, missing: int) -> FramePosition:
        """Return the time, segment and losses of a frame.

        Args:
            seq: its number; None if the device sends none.
            t_us: the device's clock, microseconds.
            missing: number of bad frames since the last good one, used without seq.

        Raises:
            FrameError: ``repeat``: the same number at the same time once more.
        """
        if seq is None:
            return self._begin(t_us) if self._after else self._follow(t_us, missing)
        last, self._last = self._last, (seq, t_us)
        if self._after or last is None:
            return self._begin(t_us)
        if last == (seq, t_us):
            raise FrameError("repeat")
        ahead, elapsed = frames_ahead(last[0], seq), t_us - last[1]
        if elapsed < 0 and last[1] < _WRAP and elapsed + _WRAP <= _WRAP_GAP:
            elapsed += _WRAP
            self._wrapped += _WRAP
        if not ahead or elapsed < 0:
            self._after = "reset"
            return self._begin(t_us)
        return self._follow(t_us + self._wrapped, ahead - 1)

    def _follow(self, t_us: float, lost: int) -> FramePosition:
        return FramePosition(t_us * 1e-6, self.segment, lost, "gap" if lost else "")

    def _begin(self, t_us: float) -> FramePosition:
        after, self._after, self._wrapped = self._after, "", 0
        self.segment += bool(after)
        return FramePosition(t_us * 1e-6, self.segment, 0, after)


class FrameClock:
    """Time of frames that carry none, from their number and their arrival.

    Frames may arrive in bursts of up to a second. Their number tells how far apart they were measured, once
    the rate is known: measured over the last seconds, or that of the header until then.
    """

    _SPAN = 8.0  # s over which the rate is measured
    _ENOUGH = 1.5  # s
    _OFTEN = 0.02  # s between two counts: more often would not help
    _STEADY = 2.0  # s after which the shortest delay is removed
    _BEHIND = 1.5  # s: a longer pause is one of the device

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()
        self._count, self._period = 0, 0.0
        self._time: float | None = None
        self._shortest, self._since = float("inf"), 0.0

    def restart(self) -> None:
        """Begin another connection; the rate is kept."""
        self._counts.clear()
        self._time = None

    def __call__(self, arrival: float, frames: int, rate: float | None) -> float:
        """Return the time of a frame, s.

        Args:
            arrival: host's time, s.
            frames: 1, and those known to be missing before it.
            rate: of the header, Hz.
        """
        self._note(arrival, rate)
        self._count += frames
        if self._time is None or not self._period:
            time = arrival
        else:
            time = min(self._time + frames * self._period, arrival)
            time = arrival if arrival - time > self._BEHIND else time
        self._time = self._steady(time, arrival)
        return self._time

    def _note(self, arrival: float, rate: float | None) -> None:
        """Measure the rate from the counts before each arrival."""
        if self._counts and arrival - self._counts[-1][0] < self._OFTEN:
            return
        if self._counts and arrival - self._counts[-1][0] > self._BEHIND:
            self._counts.clear()
        self._counts.append((arrival, self._count))
        while arrival - self._counts[0][0] > self._SPAN:
            self._counts.popleft()
        passed = arrival - self._counts[0][0]
        received = self._count - self._counts[0][1]
        if passed >= self._ENOUGH and received:
            self._period = passed / received
        elif rate and not self._period:
            self._period = 1 / rate

    def _steady(self, time: float, arrival: float) -> float:
        """Return a time without the delay that all frames of the last seconds had."""
        self._shortest = min(self._shortest, arrival - time)
        if arrival - self._since > self._STEADY:
            time, self._shortest, self._since = time + self._shortest, float("inf"), arrival
        return time


class HostClock:
    """Maps the device's clock to the host's by the least delayed frames of the last seconds.

    Frames are buffered for different times: the smallest difference between arrival and the device's clock
    is the best estimate. It is updated every few seconds, so a clock error of 0.5 % (a ceramic resonator)
    causes an error of t_host of 20 ms at most.
    """

    _SPAN = 2.0  # s

    def __init__(self) -> None:
        self._latest = float("-inf")
        self.restart()

    def restart(self) -> None:
        """Reset the relation of the clocks after a restart of the device."""
        self._least = self._before = float("inf")
        self._since: float | None = None

    def __call__(self, t: float, arrival: float) -> float:
        """Return the host's time of a frame, s, from the device's and that of its arrival, s."""
        if self._since is None or arrival - self._since > self._SPAN:
            self._before, self._least, self._since = self._least, float("inf"), arrival
        self._least = min(self._least, arrival - t)
        self._latest = max(self._latest, t + min(self._least, self._before))
        return self._latest
