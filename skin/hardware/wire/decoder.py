"""Decode bytes into frames, without input or output: their order, their time, and statistics."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, log10
from typing import Literal, NamedTuple

import numpy as np

from skin.device.resampling import After, Frame, FrameError
from skin.errors import InputError
from skin.hardware.wire.adapter import Adapter
from skin.hardware.wire.formats import FrameFormat
from skin.hardware.wire.protocol import Format, Header, RawFrame, frames_ahead, parse_header

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
            return 1  # a counter that stands still tells nothing
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
        fixed: the user set it: a contradiction is an error.

    Attributes:
        unit: s per tick.
        summary: what the clock counts, and how that is known; empty as long as it is not.
        error: contradiction of the clocks; None if there is none.
    """

    def __init__(self, unit: float, fixed: bool) -> None:
        self.unit, self._fixed = unit, fixed
        self.summary = ""
        self.error: InputError | None = None
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
            self.error = InputError(
                f"the device's clock counts {_UNITS[unit]} by {witness}, not {_UNITS[self.unit]}: correct "
                "time_unit of the adapter, or the rate that the firmware sends"
            )
            self._done = True
            return False
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


@dataclass
class Stats:
    """Numbers of frames and errors of a connection, and its state.

    Attributes:
        bytes: received.
        frames: good frames.
        bad: reason -> number of frames that could not be decoded.
        skipped: pieces before the first good frame of a connection: half a line, a banner, noise.
        resyncs: good frames after bad ones.
        gaps: interruptions by missing frames.
        lost: missing frames, according to frame numbers.
        resets: restarts of the device.
        invalid: values in good frames for which the device sent no number, such as ``nan`` or ``ovf``.
        weak: frames accepted without a CRC, which may have wrong values.
        dropped: good frames dropped from a full queue.
        reconnects: reconnections.
        rate_hz: frames per second by the device's clock, Hz; 0 if unknown.
        format: ``text`` or ``binary``; empty if not known yet, or if the source sends no bytes.
        check: ``crc16``, ``xor`` or ``none``; empty likewise.
        clock: what the device's clock and its counter were found to count; empty: as they should, or unknown.
        clock_trusted: False: the host's clock is used instead.
        trouble: a message about the current problem; empty if there is none.
    """

    bytes: int = 0
    frames: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    resyncs: int = 0
    gaps: int = 0
    lost: int = 0
    resets: int = 0
    invalid: int = 0
    weak: int = 0
    dropped: int = 0
    reconnects: int = 0
    rate_hz: float = 0.0
    format: str = ""
    check: str = ""
    clock: str = ""
    clock_trusted: bool = True
    trouble: str = ""

    @property
    def bad_frames(self) -> int:
        """Number of frames that could not be decoded."""
        return self.bad.total()

    def list_counts(self, **words: str) -> list[str]:
        """Return counts above 0 in words, as ``3 lost``; ``words`` has the word of each."""
        return [f"{count} {word}" for name, word in words.items() if (count := getattr(self, name))]


Identity = Literal["known", "missing", "other", "changed"]
"""Of the device by its headers: known; none since it was connected again; another; another without that."""

_CORRECTED = (
    6.0  # s in which the next header must correct one that has changed: many devices repeat it every five
)
_LONGEST = 65536  # bytes of a line
_ENOUGH = 4096  # bytes in which the format must show
_PATIENCE = 2.0  # s of receiving in which it must
_MANY, _LONG = 65536, 4.0  # the same of an adapter, which may need a dozen frames of many lines
_NEWS = 1 / 16  # share of the first bytes that must be new before the format is looked for again
_PAUSE = 0.2  # s that a silence counts for at most, because a board may take seconds to start
_PER_FIELD = 12  # bytes
_SPAN = 2.0  # s over which good frames are compared with bad ones
_FEW = 3  # bad frames, too few for a conclusion


class Decoder:
    """Decodes bytes into frames; resynchronises at the next delimiter and never raises for its input.

    The format is detected, as the adapter describes it (of our protocol: two binary frames with a correct
    CRC, or three lines with equal numbers of fields), and then kept. Without a CRC, the bytes before the
    first delimiter are skipped: they may be half a frame.

    After a reconnection another device may be at the port. If the one before sent a header, frames count only
    once the same header has arrived, apart from its rate.

    Args:
        sensors: S; None: taken from the header or from eight lines.
        format: ``auto``, ``text`` or ``binary``.
        channels: the device's channel, from 0, of every sensor; empty: frames keep the device's order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        adapter: describes the frames; None: our protocol.

    Attributes:
        stats: numbers of frames and errors; kept by :meth:`restart`.
        frame_format: the format, once it is known.
        header: of the device; None until it sends one.
    """

    def __init__(
        self,
        sensors: int | None = None,
        format: Format = "auto",
        channels: Sequence[int] = (),
        polarity: Sequence[int] = (),
        adapter: Adapter | None = None,
    ) -> None:
        self.sensors, self.adapter = sensors, adapter or Adapter(format=format)
        self.stats = Stats()
        self._compared_at: float | None = None
        self._good = self._bad = 0
        self._latest_bad = FrameError("")
        self.header: Header | None = None
        self._identity: Identity = "known"
        self._changed_at = inf  # s, when another header came on an open connection
        self._order, self._clock, self._counted = (
            SequenceTracker(modulus=self.adapter.modulus),
            HostClock(),
            FrameClock(),
        )
        self._unit = ClockUnit(self._order.unit, False)
        self._watch, self._clocked = ClockWatch(), False
        self._latest = np.zeros(sensors or 0)
        self._channels = np.array(channels) if len(channels) else None
        self._polarity = np.array(polarity, dtype=float) if min(polarity, default=1) < 0 else None
        self._begin()

    def _begin(self) -> None:
        self.frame_format: FrameFormat | None = None
        self.stats.format = self.stats.check = ""
        self._buffer = b""
        self._count_seen: int | None = None
        self._receiving, self._fed_at, self._unseen = 0.0, float("nan"), 0
        self._whole = self._overlong = self._synchronous = False
        self._missing = 0

    def restart(self, after: After = "reconnect") -> None:
        """Start another connection: detect the format again, with the same number of sensors."""
        self._begin()
        self._order.cut(after)
        self._identity, self._changed_at = "missing" if self.header else "known", inf
        self.stats.trouble = self._doubt
        self._counted.restart()
        self._unit.restart()
        self._watch.restart()
        self.stats.clock_trusted = True

    def feed(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """Return the frames that end in ``data``.

        Args:
            data: any bytes, cut anywhere.
            now: s, the host's monotonic clock at their arrival.
        """
        self.stats.bytes += len(data)
        passed, self._fed_at = now - self._fed_at, now
        if self.frame_format is None:
            self._receiving += min(passed, _PAUSE) if passed > 0 else 0.0
            # Bounds the search while no format is recognised.
            self._buffer = self._buffer[-2 * self._enough :]
        self._buffer += data
        if self.frame_format is None and not self._recognise(data):
            return []
        assert self.frame_format is not None
        pieces, self._buffer = self.frame_format.split(self._buffer)
        good, bad = self.stats.frames, self.stats.bad_frames
        frames = [frame for piece in pieces if (frame := self._frame(piece, now))]
        if frames and self.stats.clock_trusted:
            self._judge_clock(frames, now)
        if len(self._buffer) > _LONGEST:
            self._buffer, self._overlong = b"", True
        self._compare(now, self.stats.frames - good, self.stats.bad_frames - bad)
        return frames

    def error(self) -> InputError | None:
        """Return an error once 2 s of receiving or 4 kB (or four frames) show no format; else None.

        Also if the device's clock contradicts what is said of it, or its header has changed.
        """
        if self.frame_format is not None and self._unit.error is not None:
            return self._unit.error
        if self._fed_at - self._changed_at > _CORRECTED:
            return InputError(f"{self._doubt}: start the command again to read this device")
        patience = _PATIENCE if self.adapter.kind == "protocol" else _LONG
        if self.frame_format or (self._receiving < patience and len(self._buffer) < self._enough):
            return None
        return self.explain()

    def explain(self) -> InputError:
        """Return why no format was detected so far."""
        return self.adapter.explain(self._buffer, self._count_seen, self.sensors)

    @property
    def _enough(self) -> int:
        """Bytes in which the format must show: 4 kB, or four frames."""
        if self.adapter.kind != "protocol":
            return _MANY
        return max(_ENOUGH, 4 * _PER_FIELD * (2 + (self.sensors or 0)))

    def _recognise(self, data: bytes) -> bool:
        """Buffer the first bytes until they show the format; they are then decoded from the first one on."""
        self._unseen += len(data)
        # What is left unread grows with what was read, or the time to read it all would grow as its square.
        if not self.adapter.may_end(data) or self._unseen < _NEWS * len(self._buffer):
            return False
        self._unseen = 0
        detected = self.adapter.detect(self._buffer, self.sensors)
        self.frame_format, self._count_seen = detected.frame_format, detected.count_seen
        if self.frame_format is None:
            return False
        self._update_header(detected.header)
        self.sensors = self.frame_format.sensors
        self.stats.format, self.stats.check = self.frame_format.name, self.frame_format.check
        if detected.unit is not None and self._unit.unit == self._order.unit and not self._unit.summary:
            self._order.unit = detected.unit
            self._unit = ClockUnit(detected.unit, detected.settled)
        self._all_valid = np.ones(self.sensors, dtype=bool)
        self._all_valid.flags.writeable = False
        if len(self._latest) != self.sensors:
            self._latest = np.zeros(self.sensors)
        return True

    def _frame(self, piece: bytes, now: float) -> Frame | None:
        assert self.frame_format is not None
        first, self._whole = not self._whole, True
        try:
            if self._overlong or len(piece) > _LONGEST:
                self._overlong = False
                raise FrameError("long")
            raw = self.frame_format.read(piece)
            if isinstance(raw, bytes):
                self._update_header(parse_header(raw))
                return None
            if first and self.frame_format.check != "crc16":
                raise FrameError("structure")
            return self._place_frame(raw, now) if self._identity == "known" else None
        except FrameError as bad:
            if self._synchronous or self._missing:
                self._synchronous, self._latest_bad = False, bad
                self._missing += 1
                self.stats.bad[bad.reason] += 1
            else:
                self.stats.skipped += 1
            return None

    def _update_header(self, header: Header | None) -> None:
        """Take a header. One that differs is of another device: frames count once the one before is back."""
        if header is None:
            return
        if self.header is None or not header.changes(self.header):
            self.header = self.header or header
            self._identity, self._changed_at = "known", inf
        elif self._identity in ("known", "changed"):
            self._identity, self._changed_at = "changed", min(self._changed_at, self._fed_at)
        else:
            self._identity = "other"
        self._other = header
        self.stats.trouble = self._doubt

    @property
    def _doubt(self) -> str:
        """Why frames do not count, in words; empty if they do."""
        if self._identity == "known" or self.header is None:
            return ""
        if self._identity == "missing":
            return "the device has not sent its header since it was connected again"
        if self._identity == "other":
            return f"another device is connected: {self._other}"
        return f"the header of the device has changed, {self._other.changes(self.header)}"

    def _place_frame(self, raw: RawFrame, now: float) -> Frame:
        ticks, rate = raw.ticks, None if self.header is None else self.header.rate
        self._clocked = ticks is not None and self.stats.clock_trusted
        frames = self._order.ahead(raw.seq, self._missing)
        if ticks is None or not self._clocked:
            ticks = self._counted(now, frames, rate) / self._order.unit
        elif self._unit.add(ticks, now, frames, rate):
            self._order.unit = self._unit.unit
            self._order.cut("reset")
        t, segment, lost, after = self._order.place(raw.seq, ticks, self._missing, self._clocked)
        if self._unit.summary and self.stats.clock_trusted:
            modulus = f", its counter wraps at {self._order.modulus}" if self._order.modulus else ""
            self.stats.clock = self._unit.summary + modulus
        stats = self.stats
        stats.frames += 1
        stats.resyncs += self._missing > 0
        stats.lost += lost
        stats.gaps += after == "gap"
        stats.resets += after == "reset"
        stats.weak += stats.check != "crc16"
        self._synchronous, self._missing = True, 0
        if after and after != "gap":
            self._clock.restart()
        if self._channels is not None:
            raw = raw._replace(values=raw.values[self._channels])
        values, valid = raw.values, self._all_valid
        if not raw.finite:
            valid = np.isfinite(values)
            stats.invalid += len(valid) - int(np.count_nonzero(valid))
            values = np.where(valid, values, self._latest)
        self._latest = values
        frame = Frame(raw.seq, t, self._clock(t, now), values, valid, segment, lost, after)
        if self._polarity is None:
            return frame
        # Channels whose values fall with force end at 0 counts.
        counted = self.header is not None and self.header.bits is not None
        at_limit = (self._polarity < 0) & (values <= 0)
        return frame._replace(polarity=self._polarity, saturated=at_limit if counted else None)

    def _judge_clock(self, frames: Sequence[Frame], now: float) -> None:
        """From the next frame on, take the time from the host if the device's clock cannot be trusted."""
        if frames[0].segment != frames[-1].segment or frames[-1].after not in ("", "gap"):
            self._watch.restart()
        speed = (self.header and self.header.speed) or 1.0
        if self._clocked and not self._watch.trust([frame.t for frame in frames], now, speed):
            self.stats.clock_trusted = False
            self._order.cut("reset")
            self.stats.clock = "the device's clock cannot be trusted: the host's is used"

    def _compare(self, now: float, good: int, bad: int) -> None:
        """Compare the good frames received by ``now``, s, with the bad ones, over two seconds at a time."""
        self._compared_at = now if self._compared_at is None else self._compared_at
        self._good += good
        self._bad += bad
        if now - self._compared_at < _SPAN:
            return
        trouble = self._doubt
        if self._bad > max(self._good, _FEW):
            share = f"{self._bad} of {self._bad + self._good} frames in {_SPAN:g} s were bad"
            trouble = f"{share} ({self._latest_bad.reason}): wrong baud rate or format?"
            if self._latest_bad.reason == "fields":
                trouble = f"{share}: the device sends {self._latest_bad.found} values per frame now"
        self.stats.trouble, self._compared_at, self._good, self._bad = trouble, now, 0, 0
