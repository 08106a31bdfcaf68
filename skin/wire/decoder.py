"""Decode bytes into frames, without input or output."""

from collections.abc import Sequence

import numpy as np

from skin.errors import InputError
from skin.signal.frame import After, Counters, Frame, FrameError
from skin.wire.format_detection import (
    DetectionResult,
    Format,
    FrameFormat,
    RawFrame,
    detect_format,
    detection_error,
)
from skin.wire.sequence import FrameClock, HostClock, SequenceTracker
from skin.wire.text import Header, parse_header

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
        counters: numbers of frames and errors; kept by :meth:`restart`.
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
        self.counters, self.quality = Counters(), _Quality()
        self.header: Header | None = None
        self._order, self._clock, self._counted = SequenceTracker(), HostClock(), FrameClock()
        self._all_valid = np.ones(sensors or 0, dtype=bool)
        self._latest = np.zeros(sensors or 0)
        self._channels = np.array(channels) if len(channels) else None
        self._polarity = np.array(polarity, dtype=float) if min(polarity, default=1) < 0 else None
        self._begin()

    def _begin(self) -> None:
        self.frame_format: FrameFormat | None = None
        self._buffer = b""
        self._found = DetectionResult(None, None, None)
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
        self.counters.bytes += len(data)
        if self.frame_format is None:
            # Bounds the search while no format is recognised.
            self._buffer = self._buffer[-2 * self._enough :]
        self._buffer += data
        if self.frame_format is None and not self._recognise(data, now):
            return []
        assert self.frame_format is not None
        *pieces, self._buffer = self._buffer.split(self.frame_format.delimiter)
        good, bad = self.counters.frames, sum(self.counters.bad.values())
        frames = [frame for piece in pieces if (frame := self._frame(piece, now))]
        if len(self._buffer) > _LONGEST:
            self._buffer, self._overlong = b"", True
        self.quality.count(now, self.counters.frames - good, sum(self.counters.bad.values()) - bad)
        return frames

    def error(self) -> InputError | None:
        """Return an error once 2 s of receiving or 4 kB (or four frames) show no format; else None."""
        if self.frame_format or (self._receiving < _PATIENCE and len(self._buffer) < self._enough):
            return None
        return detection_error(self._buffer, self._found, self.sensors)

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
        self._found = detect_format(self._buffer, self.sensors, self.format)
        self.frame_format = self._found.frame_format
        if self.frame_format is None:
            return False
        self.header = self._found.header or self.header
        self.sensors = self.frame_format.sensors
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
            if raw is None:
                self._comment(piece)
                return None
            if first and self.frame_format.check != "crc16":
                raise FrameError("structure")
            return self._placed(raw, now)
        except FrameError as bad:
            self._count_bad(bad)
            return None

    def _comment(self, piece: bytes) -> None:
        assert self.frame_format is not None
        if text := self.frame_format.comment(piece):
            self.header = parse_header(text) or self.header

    def _count_bad(self, bad: FrameError) -> None:
        if not self._synchronous and not self._missing:
            self.counters.skipped += 1
            return
        self._synchronous = False
        self._missing += 1
        self.counters.bad[bad.reason] += 1
        self.quality.note(bad)

    def _placed(self, raw: RawFrame, now: float) -> Frame:
        t_us = raw.t_us
        if t_us is None:
            rate = None if self.header is None else self.header.rate
            t_us = 1e6 * self._counted(now, 1 + self._missing, rate)
        t, segment, lost, after = self._order.place(raw.seq, t_us, self._missing)
        counters = self.counters
        counters.frames += 1
        counters.resyncs += self._missing > 0
        counters.lost += lost
        counters.gaps += after == "gap"
        counters.resets += after == "reset"
        counters.weak += self.frame_format is not None and self.frame_format.check != "crc16"
        self._synchronous, self._missing = True, 0
        if after and after != "gap":
            self._clock.restart()
        if self._channels is not None:
            raw = raw._replace(values=raw.values[self._channels])
        values, valid = (raw.values, self._all_valid) if raw.finite else self._masked(raw)
        self._latest = values
        frame = Frame(raw.seq, t, self._clock(t, now), values, valid, segment, lost, after)
        return frame if self._polarity is None else self._oriented(frame, self._polarity)

    def _oriented(self, frame: Frame, polarity: np.ndarray) -> Frame:
        """Return a frame with its polarity; channels whose values fall with force end at 0 counts."""
        at_limit = (polarity < 0) & (frame.values <= 0)
        counted = self.header is not None and self.header.bits is not None
        return frame._replace(polarity=polarity, saturated=at_limit if counted else None)

    def _masked(self, raw: RawFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return values without NaN, (S,), and which of them the device sent, (S,), bool."""
        valid = np.isfinite(raw.values)
        self.counters.invalid += len(valid) - int(np.count_nonzero(valid))
        return np.where(valid, raw.values, self._latest), valid


class _Quality:
    """Compares good with bad frames over two seconds at a time.

    Attributes:
        trouble: a message; empty while most frames are good.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._since: float | None = None
        self._good = self._bad = 0
        self._latest = FrameError("")

    def note(self, bad: FrameError) -> None:
        """Remember the latest bad frame."""
        self._latest = bad

    def count(self, now: float, good: int, bad: int) -> None:
        """Add the numbers of frames received by ``now``, s."""
        self._since = now if self._since is None else self._since
        self._good += good
        self._bad += bad
        if now - self._since >= _SPAN:
            self.trouble = self._sentence() if self._bad > max(self._good, _FEW) else ""
            self._since, self._good, self._bad = now, 0, 0

    def _sentence(self) -> str:
        share = f"{self._bad} of {self._bad + self._good} frames in {_SPAN:g} s were bad"
        if self._latest.reason == "fields":
            return f"{share}: the device sends {self._latest.found} values per frame now"
        return f"{share} ({self._latest.reason}): wrong baud rate or format?"
