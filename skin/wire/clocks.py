"""Order and time of frames: their counter, the device's clock, and the host's clock as its judge."""

from collections import deque
from math import inf, log10

import numpy as np

from skin.device.resampling import After, Frame, FrameError
from skin.wire.protocol import frames_ahead

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
"""s per tick of a clock."""
# Ticks after which a clock wraps, by its unit: micros() and millis(), and what is computed from micros().
_WRAPS = {1e-6: (2**32,), 1e-3: (2**16, 2**32 / 1e3, 2**32), 1.0: (2**32 / 1e6, 2**32 / 1e3, 86_400.0)}
# Moduli in which firmware counts. Without a clock, a counter that falls elsewhere begins again.
_ROUND = frozenset([*(2**bits for bits in range(4, 33)), *(10**digits for digits in range(1, 10))])


_NONE = np.zeros(0)
_STEADY = 2.0  # s after which the shortest delay is renewed
_SLOW = 0.03  # by which a device's clock may be slow: that of an oscillator without crystal


class FrameClock:
    """Places frames in time by their numbers, the device's clock and their arrival.

    A counter that begins again while the time goes on as before has wrapped: the number at which it does is
    learned. A restarted device begins its clock again, too, or pauses. The unit of the clock is corrected by
    the host's clock. Where the device's clock disagrees with the host's, or no frame has
    a time, frames are placed by their number and arrival, which may be in bursts of up to a second.

    Args:
        unit: s per tick of the device's clock, as far as it is known.
        fixed: the user set it.
        modulus: of the counter; None: learned.

    Attributes:
        segment: number of restarts and reconnections so far.
        unit: s per tick.
        confirmed: the host's clock has shown the unit.
        modulus: of the counter; None: not known.
        trusted: False: the host's clock is used instead.
    """

    def __init__(self, unit: float = UNITS["us"], fixed: bool = False, modulus: int | None = None) -> None:
        self.segment, self.modulus = 0, modulus
        self.unit, self._fixed = unit, fixed
        self.confirmed = self._judged = False
        self._last: tuple[int | None, float] | None = None
        self._period = self._wrapped = self._t = 0.0
        self._count, self._arrival_period = 0, 0.0
        self._arrivals = deque[tuple[float, int]]()
        self._latest = -inf
        self.restart("")

    def restart(self, after: After = "reconnect") -> None:
        """Begin another connection; unit, modulus and rate are kept."""
        self._after: After = after  # why the next frame starts a new segment
        self.trusted = True
        self._first: tuple[float, float] | None = None
        self._arrivals.clear()
        self._arrived: float | None = None
        self._shortest, self._shortest_since = inf, 0.0
        self._compare_anew()

    def expect(self, unit: float, fixed: bool) -> None:
        """Take the unit of the first frames, s per tick, unless it is known; ``fixed``: the user set it."""
        if not self.confirmed:
            self.unit, self._fixed = unit, fixed

    def _compare_anew(self) -> None:
        """Forget the relation of both clocks: another segment has begun."""
        self._least, self._since = inf, 0.0
        self._deliveries = deque[tuple[float, float, int, int]]()
        self._frames = self._steps = 0
        self._doubtful_since: float | None = None

    def place(
        self, seq: int | None, ticks: float | None, now: float, missing: int = 0, rate: float | None = None
    ) -> Frame:
        """Return a frame with its times, segment and losses, without values.

        Args:
            seq: its number; None if the device sends none.
            ticks: the device's clock; None if it sends no time.
            now: s, arrival by the host's clock.
            missing: number of bad frames since the last good one, used without seq.
            rate: of the header, Hz; None: unknown.

        Raises:
            FrameError: ``repeat``: the same number at the same time once more.
        """
        last = self._last
        known = seq is not None and last is not None and last[0] is not None
        ahead = max(1, frames_ahead(last[0], seq, self.modulus)) if known else 1 + missing  # type: ignore[index, arg-type]
        clocked = ticks is not None and self.trusted
        if ticks is None or not clocked:
            ticks = self._estimate(now, ahead, rate) / self.unit
        elif self._correct_unit(ticks, now, ahead):
            self._after = "reset"
        self._last = seq, ticks
        if self._after or last is None:
            return self._begin(seq, ticks, now)
        if seq is not None and last == (seq, ticks):
            raise FrameError("repeat")
        elapsed = ticks - last[1]
        self._frames, self._steps = self._frames + 1, self._steps + (elapsed != 0)
        if elapsed < 0:
            wrap = next((wrap for wrap in _WRAPS[self.unit] if self._wraps(last[1], ticks, wrap)), 0)
            elapsed += wrap
            self._wrapped += wrap
        if known:
            ahead = self._count_ahead(last[0], seq, elapsed, clocked)  # type: ignore[arg-type]
        if not ahead or elapsed < 0:
            self._after = "reset"
            return self._begin(seq, ticks, now)
        self._period = 0.9 * self._period + 0.1 * elapsed / ahead if self._period else elapsed / ahead
        t = (ticks + self._wrapped) * self.unit
        if elapsed == 0 and clocked:  # two frames in one tick: spread by the rate, before the next tick
            t = self._t + min(self._period * self.unit or inf, max(0.0, t + self.unit - self._t) / 2)
        self._t = t
        after: After = "gap" if ahead > 1 else ""
        return Frame(seq, t, self._to_host(t, now), _NONE, _NONE, self.segment, ahead - 1, after)

    def judge(
        self,
        now: float,
        speed: float = 1.0,
        span: float = 2.0,
        deliveries: int = 4,
        coarsest: float = 0.05,
        caught_up: float = 0.2,
    ) -> None:
        """Stop trusting the device's clock if it and the host's disagree; after the frames of a delivery.

        Over the longer of a span and some deliveries it must advance by half to twice as much as the host's,
        and in fine steps if the frames are. What was buffered while host or bridge were suspended arrives at
        once and does not count against it.

        Args:
            now: s, arrival by the host's clock.
            speed: at which a replay declares to run its clock; 1 of a real device.
            span, deliveries: s and deliveries over which both clocks are compared.
            coarsest: s per step of the clock: coarser than the decisions of a live view is too coarse.
            caught_up: s in which the buffer of a host that was suspended is read.
        """
        self._deliveries.append((now, self._t, self._frames, self._steps))
        while len(self._deliveries) > deliveries + 1 and now - self._deliveries[1][0] >= span:
            self._deliveries.popleft()
        since, t, frames, steps = self._deliveries[0]
        passed = now - since
        if len(self._deliveries) <= deliveries or passed < span or not self.trusted:
            return
        advanced, steps = (self._t - t) / speed, self._steps - steps
        coarse = advanced > coarsest * steps and self._frames - frames >= 2 * steps
        if not coarse and passed / 2 <= advanced <= 2 * passed:
            self._doubtful_since = None
        elif self._doubtful_since is None:
            self._doubtful_since = now
        if self._doubtful_since is not None and now - self._doubtful_since >= caught_up:
            self.trusted = False
            self._after = "reset"

    def _begin(self, seq: int | None, ticks: float, now: float) -> Frame:
        after, self._after, self._wrapped, self._t = self._after, "", 0.0, ticks * self.unit
        if after:
            self.segment += 1
            self._compare_anew()
        return Frame(seq, self._t, self._to_host(self._t, now), _NONE, _NONE, self.segment, 0, after)

    def _count_ahead(
        self, before: int, seq: int, elapsed: float, clocked: bool, near: int = 16, uneven: float = 0.25
    ) -> int:
        """Return by how many frames ``seq`` is ahead; 0 if the counter began again.

        Up to ``near`` frames may be missing where it wraps at a number that no firmware counts in, and the
        time between two frames may deviate by ``uneven``.
        """
        if seq == before and elapsed > 0:
            return 1  # a counter that stands still tells nothing
        ahead = frames_ahead(before, seq, self.modulus)
        if ahead or self.modulus is not None or elapsed < 0 or not self._period:
            return ahead
        frames = round(elapsed / self._period) if clocked else 1
        irregular = abs(elapsed - frames * self._period) > uneven * self._period and clocked
        modulus = before - seq + frames
        unusual = not clocked and modulus not in _ROUND and modulus + 1 not in _ROUND
        if irregular or unusual or not (max(1, seq) <= frames <= near and 2 <= modulus <= before + frames):
            return 0
        self.modulus = modulus
        return frames

    def _wraps(self, before: float, ticks: float, wrap: float, gap: float = 60.0) -> bool:
        """Return whether the clock wraps, where up to ``gap`` s or a 16th of its range may be missing."""
        gap = min(gap / self.unit, wrap / 16)
        return wrap - gap <= before < wrap and ticks - before + wrap <= gap

    def _correct_unit(
        self, ticks: float, now: float, frames: int, judged: int = 10, close: float = 0.7
    ) -> bool:
        """Return whether the unit changes with a frame, by the host's clock.

        It is compared after a second and ``judged`` frames. Bursts explain a factor of ``10**close``, and
        units are 1000 apart.
        """
        if self._judged:
            return False
        if self._first is None or ticks < self._first[0]:
            self._first, self._since_first = (ticks, now), 0
            return False
        self._since_first += frames
        passed, received = ticks - self._first[0], now - self._first[1]
        if passed <= 0 or received < 1.0 or self._since_first < judged:
            return False
        self._judged, measured, before = True, received / passed, self.unit
        unit = min(UNITS.values(), key=lambda unit: abs(log10(measured / unit)))
        if abs(log10(measured / unit)) > close or (unit != before and self._fixed):
            return False  # the host's clock will rule
        self.unit, self.confirmed = unit, True
        return unit != before

    def _estimate(
        self,
        arrival: float,
        frames: int,
        rate: float | None,
        span: float = 8.0,
        enough: float = 1.5,
        often: float = 0.02,
        pause: float = 1.5,
    ) -> float:
        """Return the time of a frame that carries none, s: from its number, the rate and its arrival.

        Frames may arrive in bursts. Their number tells how far apart they were measured, once the rate is
        known: measured over the last seconds, or that of the header until then.

        Args:
            arrival: s, by the host's clock.
            frames: since the frame before.
            rate: of the header, Hz.
            span, enough: s over which the rate is measured, at most and at least.
            often: s between two counts of arrivals: more often would not help.
            pause: s without arrivals: longer than a burst, a pause of the device.
        """
        counts = self._arrivals
        if not counts or arrival - counts[-1][0] >= often:
            if counts and arrival - counts[-1][0] > pause:
                counts.clear()
            counts.append((arrival, self._count))
            while arrival - counts[0][0] > span:
                counts.popleft()
            passed, received = arrival - counts[0][0], self._count - counts[0][1]
            if passed >= enough and received:
                self._arrival_period = passed / received
            elif rate and not self._arrival_period:
                self._arrival_period = 1 / rate
        self._count += frames
        time = arrival
        if self._arrived is not None and self._arrival_period:
            time = min(self._arrived + frames * self._arrival_period, arrival)
            time = arrival if arrival - time > pause else time
        self._shortest = min(self._shortest, arrival - time)
        if arrival - self._shortest_since > _STEADY:
            time, self._shortest, self._shortest_since = time + self._shortest, inf, arrival
        self._arrived = time
        return time

    def _to_host(self, t: float, arrival: float) -> float:
        """Return the host's time of a frame, s: by the least delayed frame, and the slowest clock since.

        Frames that come later and later, through a link that is too slow, become older and older by that.
        """
        slowed = self._least + _SLOW * (arrival - self._since)
        self._least, self._since = min(slowed, arrival - t), arrival
        self._latest = max(self._latest, t + self._least)
        return self._latest
