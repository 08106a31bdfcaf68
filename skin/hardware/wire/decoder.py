"""Decode bytes into frames, without input or output.

The format is detected from two binary frames or three lines with equal numbers of fields.
"""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import isfinite, nan
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from skin.device.resampling import After, Check, Frame, FrameError
from skin.errors import InputError
from skin.hardware.wire.protocol import (
    Header,
    Line,
    decode_comment,
    decode_frame,
    ends_with_separator,
    parse_header,
    parse_line,
)
from skin.hardware.wire.sequence import FrameClock, HostClock, SequenceTracker, frames_ahead

Format = Literal["auto", "text", "binary"]

_LINES, _FRAMES = 3, 2
_LINES_UNKNOWN = 8  # three lines of noise may count upwards by chance, eight hardly
_STEP = 1000  # frames that may be missing between two consecutive lines


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


class RawFrame(NamedTuple):
    """Content of one frame.

    Attributes:
        seq: number of the frame, or None.
        t_us: the device's clock, microseconds, or None.
        values: (S,); NaN or infinite where the device sent no number.
        finite: whether all values are numbers.
    """

    seq: int | None
    t_us: float | None
    values: np.ndarray
    finite: bool = True


class FrameFormat(Protocol):
    """A detected format.

    Attributes:
        name: ``text`` or ``binary``.
        delimiter: the end of a frame.
        check: kind of its checksum.
        sensors: S.
    """

    @property
    def name(self) -> str: ...
    @property
    def delimiter(self) -> bytes: ...
    @property
    def check(self) -> Check: ...
    @property
    def sensors(self) -> int: ...
    def read(self, piece: bytes) -> RawFrame | None:
        """Return the frame between two delimiters; None for a comment or an empty piece; or FrameError."""

    def comment(self, piece: bytes) -> bytes | None:
        """Return a piece as a comment line; None if it is not a comment."""


@dataclass(frozen=True)
class TextFormat:
    """Lines.

    Attributes:
        counted: seq and t_us stand before the values.
        trailing: every line ends with a separator, so no line means an empty field by it.
    """

    sensors: int
    counted: bool
    check: Check
    trailing: bool = False
    name: ClassVar[str] = "text"
    delimiter: ClassVar[bytes] = b"\n"

    def read(self, piece: bytes) -> RawFrame | None:
        """Return the frame in a line."""
        line = piece.removesuffix(b"\r")
        if not line or line.startswith(b"#"):
            return None
        fields, check, finite = parse_line(line)
        if check != self.check:
            raise FrameError("checksum")
        if (missing := self.sensors + 2 * self.counted - len(fields)) != 0:
            if missing != 1 or self.trailing or not ends_with_separator(line):
                raise FrameError("fields", len(fields) - 2 * self.counted)
            fields, finite = [*fields, nan], False
        if not self.counted:
            return RawFrame(None, None, np.array(fields), finite)
        seq, t_us = fields[:2]
        if not (seq >= 0 and t_us >= 0) or seq % 1:
            raise FrameError("number")
        return RawFrame(int(seq), t_us, np.array(fields[2:]), finite)

    def comment(self, piece: bytes) -> bytes | None:
        """Return the comment line; None if it is not a comment."""
        return piece.removesuffix(b"\r") if piece.startswith(b"#") else None


@dataclass(frozen=True)
class BinaryFormat:
    """COBS frames."""

    sensors: int
    name: ClassVar[str] = "binary"
    delimiter: ClassVar[bytes] = b"\0"
    check: ClassVar[Check] = "crc16"

    def read(self, piece: bytes) -> RawFrame | None:
        """Return the frame between two zeros."""
        if not piece or self.comment(piece) is not None:
            return None
        seq, t_us, values = decode_frame(piece)
        if len(values) != self.sensors:
            raise FrameError("fields", len(values))
        return RawFrame(seq, t_us, values, bool(np.isfinite(values).all()))

    def comment(self, piece: bytes) -> bytes | None:
        """Return the text of a comment; None if it is not a comment."""
        return decode_comment(piece)


@dataclass(frozen=True)
class DetectionResult:
    """Result of :func:`detect_format`.

    Attributes:
        frame_format: the format, or None if it is not known yet.
        sensors: number of values in readable frames that do not match the layout; or None.
        header: the last one received.
    """

    frame_format: FrameFormat | None
    sensors: int | None
    header: Header | None


def detect_format(data: bytes, sensors: int | None, format: Format) -> DetectionResult:
    """Detect the format from the first bytes of a connection.

    Args:
        data: from the first byte on; an incomplete piece at the end is ignored.
        sensors: S, or None to detect it.
        format: only this format, or ``auto``.
    """
    count_seen = None
    if format != "text":
        counts = _binary_counts(data)
        for count in counts:
            if counts.count(count) >= _FRAMES and sensors in (None, count):
                return DetectionResult(BinaryFormat(count), None, None)
            count_seen = count
    if format == "binary":
        return DetectionResult(None, count_seen, None)
    return _detect_text(data, sensors, count_seen)


def detection_error(data: bytes, result: DetectionResult, sensors: int | None) -> InputError:
    """Return the error for data in which no format was detected."""
    if _has_constant_time(run := _lines(data)):
        return stopped_clock_error(len(run), run[0].fields[1])
    if result.sensors is not None and sensors is not None:
        return InputError(
            f"the device sends {result.sensors} values per frame, the layout has {sensors} sensors: give its "
            "own layout, as in layout=file layout.path=FILE.csv"
        )
    return InputError(
        f"no frame in {len(data)} bytes, which begin with {data[:64].hex(' ')}: is the baud rate right, "
        "as in device.baudrate=115200? Or give the format, as in device.format=text or device.format=binary"
    )


def stopped_clock_error(frames: int, t_us: float) -> InputError:
    """Return the error for frames whose clock does not move: no window would ever fill."""
    return InputError(
        f"the device's clock stands still: t_us was {t_us:.0f} in all of {frames} frames; let the firmware "
        "send micros(), or lines of values alone"
    )


def _is_numeric(line: Line) -> bool:
    """Return whether more than half of the fields are numbers; only such lines show a format."""
    return line.finite or 2 * sum(map(isfinite, line.fields)) > len(line.fields)


def _has_constant_time(run: Sequence[Line]) -> bool:
    """Return whether the first column counts while the next one, the time, is constant."""
    run = [line for line in run if len(line.fields) > 2]
    times = {line.fields[1] for line in run}
    if len(run) < _LINES_UNKNOWN or len(times) > 1 or not all(map(isfinite, times)):
        return False
    return _all_count([Line([line.fields[0], place, 0], line.check) for place, line in enumerate(run)])


def _lines(data: bytes) -> list[Line]:
    """Return the lines of numbers; the first piece may be half a line."""
    lines = []
    for piece in data.split(b"\n")[1:-1]:
        with suppress(FrameError):
            lines.append(parse_line(piece.removesuffix(b"\r")))
    return [line for line in lines if _is_numeric(line)]


def _binary_counts(data: bytes) -> list[int]:
    counts = []
    for piece in data.split(b"\0")[:-1]:
        with suppress(FrameError):
            counts.append(len(decode_frame(piece).values))
    return counts


def _detect_text(data: bytes, sensors: int | None, count_seen: int | None) -> DetectionResult:
    header, run = None, list[Line]()
    for piece in data.split(b"\n")[:-1]:
        line = piece.removesuffix(b"\r")
        if line.startswith(b"#"):
            header = parse_header(line) or header
            continue
        try:
            read = parse_line(line)
        except FrameError:
            run = []
            continue
        if not _is_numeric(read):
            run = []
            continue
        if run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check):
            run = []
        run = [*run[1 - _LINES_UNKNOWN :], read] if read.fields else []
        expected = sensors or (header.n if header else None)
        if frame_format := _judge(run, expected, learn=sensors is None):
            detected = replace(frame_format, trailing=ends_with_separator(line))
            return DetectionResult(detected, None, header)
        if len(run) >= _LINES:
            count_seen = len(read.fields) - 2 * _all_count(run[-_LINES:])
    return DetectionResult(None, count_seen, header)


def _judge(run: Sequence[Line], sensors: int | None, learn: bool) -> TextFormat | None:
    """Return the format of similar lines, or None if they do not determine it."""
    if len(run) < _LINES:
        return None
    count, check = len(run[-1].fields), run[-1].check
    counting = _all_count(run[-_LINES:])
    if count == sensors:
        return TextFormat(count, False, check)
    if sensors is not None and count == sensors + 2 and counting:
        return TextFormat(sensors, True, check)
    if not learn or len(run) < _LINES_UNKNOWN or _has_constant_time(run):
        return None
    counting = _all_count(run)
    return TextFormat(count - 2 * counting, counting, check)


def _all_count(run: Sequence[Line]) -> bool:
    """Return whether the two columns before the values are a frame number and a time."""
    return len(run) > 1 and all(_counts(before.fields, line.fields) for before, line in pairwise(run))


def _counts(before: Sequence[float], line: Sequence[float]) -> bool:
    if len(line) < 3 or any(field < 0 or field % 1 for field in (before[0], line[0])):
        return False
    later = line[1] > before[1] or line[1] < 2**31 < before[1]
    return later and 0 < frames_ahead(int(before[0]), int(line[0])) <= _STEP


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
        self.stats, self.quality = Stats(), _Quality()
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
        self.quality.count(now, self.stats.frames - good, self.stats.bad_frames - bad)
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
            return self._place_frame(raw, now)
        except FrameError as bad:
            self._count_bad(bad)
            return None

    def _comment(self, piece: bytes) -> None:
        assert self.frame_format is not None
        if text := self.frame_format.comment(piece):
            self.header = parse_header(text) or self.header

    def _count_bad(self, bad: FrameError) -> None:
        if not self._synchronous and not self._missing:
            self.stats.skipped += 1
            return
        self._synchronous = False
        self._missing += 1
        self.stats.bad[bad.reason] += 1
        self.quality.note(bad)

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
        stats.weak += self.frame_format is not None and self.frame_format.check != "crc16"
        self._synchronous, self._missing = True, 0
        if after and after != "gap":
            self._clock.restart()
        if self._channels is not None:
            raw = raw._replace(values=raw.values[self._channels])
        values, valid = (raw.values, self._all_valid) if raw.finite else self._mask_missing(raw)
        self._latest = values
        frame = Frame(raw.seq, t, self._clock(t, now), values, valid, segment, lost, after)
        return frame if self._polarity is None else self._apply_polarity(frame, self._polarity)

    def _apply_polarity(self, frame: Frame, polarity: np.ndarray) -> Frame:
        """Return a frame with its polarity; channels whose values fall with force end at 0 counts."""
        at_limit = (polarity < 0) & (frame.values <= 0)
        counted = self.header is not None and self.header.bits is not None
        return frame._replace(polarity=polarity, saturated=at_limit if counted else None)

    def _mask_missing(self, raw: RawFrame) -> tuple[np.ndarray, np.ndarray]:
        """Return values without NaN, (S,), and which of them the device sent, (S,), bool."""
        valid = np.isfinite(raw.values)
        self.stats.invalid += len(valid) - int(np.count_nonzero(valid))
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
