"""Order and time of frames: their counter, the device's clock, and the host's as its judge."""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from math import log10
from typing import NamedTuple

from skin.device.resampling import After, FrameError
from skin.wire.protocol import frames_ahead

# Ticks after which a clock wraps, by its unit: micros() and millis(), and what is computed from micros().
_CLOCK_WRAPS = {1e-6: (2**32,), 1e-3: (2**16, 2**32 / 1e3, 2**32), 1.0: (2**32 / 1e6, 2**32 / 1e3, 86_400.0)}
_WRAP_GAP = 60.0  # s that may be missing where the clock wraps
_WRAP_SHARE = 1 / 16  # of the range of the clock: less than 60 s where it is short
_NEAR = 16  # frames that may be missing where a counter wraps at a number that no firmware counts in
_UNEVEN = 0.25  # deviation of the time between two frames
_ROUND = frozenset([*(2**bits for bits in range(4, 33)), *(10**digits for digits in range(1, 10))])


class FramePosition(NamedTuple):
    """Time, segment and losses of a frame, as in :class:`skin.device.resampling.Frame`."""

    t: float
    segment: int
    lost: int
    after: After


class SequenceTracker:
    """Tracks seq and the device's clock from frame to frame.

    A counter that begins again while the time goes on as before has wrapped: the number at which it does is
    learned. A restarted device begins its clock again, too, or pauses.

    Args:
        unit: s per tick of the clock.
        modulus: of the counter; None: learned.

    Attributes:
        segment: number of restarts and reconnections so far.
        unit: as given.
        modulus: of the counter; None: not known.
    """

    def __init__(self, unit: float = 1e-6, modulus: int | None = None) -> None:
        self.segment, self.unit, self.modulus = 0, unit, modulus
        self._fixed = modulus is not None
        self._after: After = ""
        self._last: tuple[int | None, float] | None = None
        self._wrapped = self._period = 0.0
        self._fell: int | None = None  # modulus of an earlier fall that was taken for a restart

    def cut(self, after: After) -> None:
        """Start a new segment with the next frame; ``after`` is the reason."""
        self._after = after

    def place(self, seq: int | None, ticks: float, missing: int, clocked: bool = True) -> FramePosition:
        """Return the time, segment and losses of a frame.

        Args:
            seq: its number; None if the device sends none.
            ticks: the device's clock.
            missing: number of bad frames since the last good one, used without seq.
            clocked: whether the device sends the time; if not, it follows from the arrival.

        Raises:
            FrameError: ``repeat``: the same number at the same time once more.
        """
        last, self._last = self._last, (seq, ticks)
        if self._after or last is None:
            return self._begin(ticks)
        if seq is not None and last == (seq, ticks):
            raise FrameError("repeat")
        elapsed = ticks - last[1]
        if elapsed < 0:
            wrap = next((wrap for wrap in _CLOCK_WRAPS[self.unit] if self._wraps(last[1], ticks, wrap)), 0)
            elapsed += wrap
            self._wrapped += wrap
        ahead = 1 + missing if seq is None or last[0] is None else self._ahead(last[0], seq, elapsed, clocked)
        if not ahead or elapsed < 0:
            self._after = "reset"
            return self._begin(ticks)
        self._period = 0.9 * self._period + 0.1 * elapsed / ahead if self._period else elapsed / ahead
        return self._follow(ticks + self._wrapped, ahead - 1)

    def ahead(self, seq: int | None, missing: int) -> int:
        """Return the frames since the last one, at least 1: what is known before the time is."""
        before = None if self._last is None else self._last[0]
        if seq is None or before is None:
            return 1 + missing
        return max(1, frames_ahead(before, seq, self.modulus))

    def _ahead(self, before: int, seq: int, elapsed: float, clocked: bool) -> int:
        """Return by how many frames ``seq`` is ahead; 0 if the counter began again."""
        if seq == before and elapsed > 0:
            return 1  # a constant counter gives no information
        ahead = frames_ahead(before, seq, self.modulus)
        if ahead or self._fixed or elapsed < 0 or not self._period:
            return ahead
        frames = round(elapsed / self._period) if clocked else 1
        uneven = abs(elapsed - frames * self._period) > _UNEVEN * self._period and clocked
        modulus = before - seq + frames
        if not 0 < frames <= _NEAR or uneven or not 2 <= modulus <= before + frames or seq > frames:
            return 0
        if not clocked and modulus not in (*_ROUND, self._fell) and modulus + 1 not in _ROUND:
            self._fell = modulus
            return 0
        self.modulus = modulus
        return frames

    def _wraps(self, before: float, ticks: float, wrap: float) -> bool:
        gap = min(_WRAP_GAP / self.unit, _WRAP_SHARE * wrap)
        return wrap - gap <= before < wrap and ticks - before + wrap <= gap

    def _follow(self, ticks: float, lost: int) -> FramePosition:
        return FramePosition(ticks * self.unit, self.segment, lost, "gap" if lost else "")

    def _begin(self, ticks: float) -> FramePosition:
        after, self._after, self._wrapped = self._after, "", 0.0
        self.segment += bool(after)
        return FramePosition(ticks * self.unit, self.segment, 0, after)


_UNITS = {1.0: "s", 1e-3: "ms", 1e-6: "us"}
_JUDGED = 1.0, 10  # s and frames after which a clock is compared with the host's
_CLOSE = 0.7  # decades: a factor of 5, which bursts and a backlog explain; the units are three decades apart
_COUNTED = 8  # frames after which the rate of the header is compared


class ClockUnit:
    """Tells whether a device's clock counts s, ms or us, by the header's rate and the host's clock.

    Args:
        unit: s per tick, as far as it is known.
        fixed: the user set it.

    Attributes:
        unit: s per tick.
        summary: what the clock counts, and how that is known; empty as long as it is not.
    """

    def __init__(self, unit: float, fixed: bool) -> None:
        self.unit, self._fixed = unit, fixed
        self.summary = ""
        self._first: tuple[float, float] | None = None
        self._frames, self._rated, self._done = 0, False, False

    def restart(self) -> None:
        """Compare again: the device was restarted."""
        self._first, self._frames = None, 0

    def add(self, ticks: float, now: float, frames: int, rate: float | None) -> bool:
        """Return whether the unit changes with this frame.

        Args:
            ticks: the device's clock.
            now: s, arrival by the host's clock.
            frames: since the frame before.
            rate: of the header, Hz; None: unknown.
        """
        if self._done:
            return False
        if self._first is None or ticks < self._first[0]:
            self._first, self._frames = (ticks, now), 0
            return False
        self._frames += frames
        passed, received = ticks - self._first[0], now - self._first[1]
        if passed <= 0:
            return False
        if rate and not self._rated and self._frames >= _COUNTED:
            self._rated = True
            return self._judge(self._frames / rate / passed, f"the header's rate={rate:g}")
        if received >= _JUDGED[0] and self._frames >= _JUDGED[1]:
            self._done = True
            return self._judge(received / passed, "the host's clock")
        return False

    def _judge(self, measured: float, witness: str) -> bool:
        unit = min(_UNITS, key=lambda unit: abs(log10(measured / unit)))
        if abs(log10(measured / unit)) > _CLOSE:
            return False
        if unit != self.unit and self._fixed:
            return False  # the host's clock will rule
        before, self.unit = self.unit, unit
        self._fixed |= unit != before
        self.summary = f"the device's clock counts {_UNITS[unit]}, by {witness}"
        return unit != before


class ClockWatch:
    """Tells whether a device's clock can be trusted, by the host's.

    Over the longer of 2 s and four deliveries it must advance by half to twice as much, and in steps that are
    finer than the decisions of a live view if the frames are. What was buffered while host or bridge were
    suspended arrives at once and does not count against it.
    """

    _SPAN, _DELIVERIES = 2.0, 4  # s
    _COARSE = 0.05  # s
    _CAUGHT_UP = 0.2  # s in which a buffer is read

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Compare again: another segment of the device's clock has begun."""
        self._deliveries = deque[tuple[float, float, int, int]]()
        self._frames = self._steps = 0
        self._doubtful_since: float | None = None

    def trust(self, times: Sequence[float], arrival: float, speed: float) -> bool:
        """Return whether the clock is still trusted after a delivery.

        Args:
            times: of its frames by the device's clock, s.
            arrival: by the host's, s.
            speed: at which a replay declares to run its clock; 1 of a real device.
        """
        before = self._deliveries[-1][1] if self._deliveries else times[0]
        self._frames += len(times)
        self._steps += sum(time > last for last, time in pairwise([before, *times]))
        self._deliveries.append((arrival, times[-1], self._frames, self._steps))
        while len(self._deliveries) > self._DELIVERIES + 1 and arrival - self._deliveries[1][0] >= self._SPAN:
            self._deliveries.popleft()
        first = self._deliveries[0]
        passed = arrival - first[0]
        if len(self._deliveries) <= self._DELIVERIES or passed < self._SPAN:
            return True
        advanced, steps = (times[-1] - first[1]) / speed, self._steps - first[3]
        coarse = advanced > self._COARSE * steps and self._frames - first[2] >= 2 * steps
        doubtful = coarse or not passed / 2 <= advanced <= 2 * passed
        if not doubtful:
            self._doubtful_since = None
        elif self._doubtful_since is None:
            self._doubtful_since = arrival
        return self._doubtful_since is None or arrival - self._doubtful_since < self._CAUGHT_UP


class FrameClock:
    """Time of frames that carry none, from their number and their arrival.

    Frames may arrive in bursts of up to a second. Their number gives the time between them, once
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
