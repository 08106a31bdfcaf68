"""Decode bytes into frames, without input or output: their order, their time, and statistics."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from skin.device.resampling import After, Frame, FrameError
from skin.errors import InputError
from skin.hardware.wire.protocol import (
    Format,
    FrameFormat,
    Header,
    RawFrame,
    detect_format,
    detection_error,
    frames_ahead,
    parse_header,
)

_WRAP = 2**32  # microseconds: 71.6 minutes
_WRAP_GAP = 60_000_000  # microseconds that may be missing where the clock wraps


class FramePosition(NamedTuple):
    """Time, segment and losses of a frame, as in :class:`skin.device.resampling.Frame`."""

    t: float
    segment: int
    lost: int
    after: After


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
    trouble: str = ""

    @property
    def bad_frames(self) -> int:
        """Number of frames that could not be decoded."""
        return self.bad.total()

    def list_counts(self, **words: str) -> list[str]:
        """Return counts above 0 in words, as ``3 lost``; ``words`` has the word of each."""
        counts = [(getattr(self, name), word) for name, word in words.items()]
        return [f"{count} {word}" for count, word in counts if count]


_LONGEST = 65536  # bytes of a line
_ENOUGH = 4096  # bytes in which the format must show
_PATIENCE = 2.0  # s of receiving in which it must
_PAUSE = 0.2  # s that a silence counts for at most, because a board may take seconds to start
_PER_FIELD = 12  # bytes
_SPAN = 2.0  # s over which good frames are compared with bad ones
_FEW = 3  # bad frames, too few for a conclusion


class Decoder:
    """Decodes bytes into frames; resynchronises at the next delimiter and never raises for its input.

    The format is detected (two binary frames with a correct CRC, or three lines with equal numbers of fields)
    and then kept. Without a CRC, the bytes before the first delimiter are skipped: they may be half a frame.

    Args:
        sensors: S; None: taken from the header or from eight lines.
        format: ``auto``, ``text`` or ``binary``.
        channels: the device's channel, from 0, of every sensor; empty: frames keep the device's order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.

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
    ) -> None:
        self.sensors, self.format = sensors, format
        self.stats = Stats()
        self._compared_at: float | None = None
        self._good = self._bad = 0
        self._latest_bad = FrameError("")
        self.header: Header | None = None
        self._order, self._clock, self._counted = SequenceTracker(), HostClock(), FrameClock()
        self._latest = np.zeros(sensors or 0)
        self._channels = np.array(channels) if len(channels) else None
        self._polarity = np.array(polarity, dtype=float) if min(polarity, default=1) < 0 else None
        self._begin()

    def _begin(self) -> None:
        self.frame_format: FrameFormat | None = None
        self.stats.format = self.stats.check = ""
        self._buffer = b""
        self._count_seen: int | None = None
        self._receiving, self._fed_at = 0.0, float("nan")
        self._whole = self._overlong = self._synchronous = False
        self._missing = 0

    def restart(self, after: After = "reconnect") -> None:
        """Start another connection: detect the format again, with the same number of sensors."""
        self._begin()
        self._order.cut(after)
        self._counted.restart()

    def feed(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """Return the frames that end in ``data``.

        Args:
            data: any bytes, cut anywhere.
            now: s, the host's monotonic clock at their arrival.
        """
        self.stats.bytes += len(data)
        if self.frame_format is None:
            # Bounds the search while no format is recognised.
            self._buffer = self._buffer[-2 * self._enough :]
        self._buffer += data
        if self.frame_format is None and not self._recognise(data, now):
            return []
        assert self.frame_format is not None
        *pieces, self._buffer = self._buffer.split(self.frame_format.delimiter)
        good, bad = self.stats.frames, self.stats.bad_frames
        frames = [frame for piece in pieces if (frame := self._frame(piece, now))]
        if len(self._buffer) > _LONGEST:
            self._buffer, self._overlong = b"", True
        self._compare(now, self.stats.frames - good, self.stats.bad_frames - bad)
        return frames

    def error(self) -> InputError | None:
        """Return an error once 2 s of receiving or 4 kB (or four frames) show no format; else None."""
        if self.frame_format or (self._receiving < _PATIENCE and len(self._buffer) < self._enough):
            return None
        return detection_error(self._buffer, self._count_seen, self.sensors)

    @property
    def _enough(self) -> int:
        """Bytes in which the format must show: 4 kB, or four frames."""
        return max(_ENOUGH, 4 * _PER_FIELD * (2 + (self.sensors or 0)))

    def _recognise(self, data: bytes, now: float) -> bool:
        """Buffer the first bytes until they show the format; they are then decoded from the first one on."""
        passed = now - self._fed_at
        self._receiving += min(passed, _PAUSE) if passed > 0 else 0.0
        self._fed_at = now
        if b"\n" not in data and b"\0" not in data:
            return False
        self.frame_format, self._count_seen, header = detect_format(self._buffer, self.sensors, self.format)
        if self.frame_format is None:
            return False
        self.header = header or self.header
        self.sensors = self.frame_format.sensors
        self.stats.format, self.stats.check = self.frame_format.name, self.frame_format.check
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
                self.header = parse_header(raw) or self.header
                return None
            if first and self.frame_format.check != "crc16":
                raise FrameError("structure")
            return self._place_frame(raw, now)
        except FrameError as bad:
            if self._synchronous or self._missing:
                self._synchronous, self._latest_bad = False, bad
                self._missing += 1
                self.stats.bad[bad.reason] += 1
            else:
                self.stats.skipped += 1
            return None

    def _place_frame(self, raw: RawFrame, now: float) -> Frame:
        t_us = raw.t_us
        if t_us is None:
            rate = None if self.header is None else self.header.rate
            t_us = 1e6 * self._counted(now, 1 + self._missing, rate)
        t, segment, lost, after = self._order.place(raw.seq, t_us, self._missing)
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

    def _compare(self, now: float, good: int, bad: int) -> None:
        """Compare the good frames received by ``now``, s, with the bad ones, over two seconds at a time."""
        self._compared_at = now if self._compared_at is None else self._compared_at
        self._good += good
        self._bad += bad
        if now - self._compared_at < _SPAN:
            return
        trouble = ""
        if self._bad > max(self._good, _FEW):
            share = f"{self._bad} of {self._bad + self._good} frames in {_SPAN:g} s were bad"
            trouble = f"{share} ({self._latest_bad.reason}): wrong baud rate or format?"
            if self._latest_bad.reason == "fields":
                trouble = f"{share}: the device sends {self._latest_bad.found} values per frame now"
        self.stats.trouble, self._compared_at, self._good, self._bad = trouble, now, 0, 0
