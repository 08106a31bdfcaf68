"""Formats of frames: how bytes are cut into pieces, and what the fields of a piece are."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite, nan
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.errors import InputError
from skin.wire.protocol import (
    Format,
    Header,
    Line,
    RawFrame,
    decode_comment,
    decode_frame,
    ends_with_separator,
    frames_ahead,
    parse_header,
    parse_line,
)


class FrameFormat(Protocol):
    """A format: S ``sensors``, a ``name`` and the kind of its ``check``."""

    @property
    def name(self) -> str:
        """Word for the user."""

    @property
    def sensors(self) -> int:
        """S."""

    @property
    def check(self) -> Check:
        """Kind of checksum."""

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the complete pieces of ``data``, and what is left."""

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame that ends with a piece; bytes where none does; else raise FrameError."""


@dataclass(frozen=True)
class Roles:
    """What the fields of a frame are.

    Attributes:
        count: number of fields.
        values: the fields that are sensors.
        counter: the field that numbers the frames; None: none does.
        time: the field with the device's clock; None: none has it.
        invalid: numbers that firmware sends instead of a value.
        magnitude: whether three values in a row are the axes of one sensor, whose value is their length.
    """

    count: int
    values: tuple[int, ...]
    counter: int | None = None
    time: int | None = None
    invalid: frozenset[float] = frozenset()
    magnitude: bool = False

    @property
    def sensors(self) -> int:
        """S."""
        return len(self.values) // (3 if self.magnitude else 1)

    def __post_init__(self) -> None:
        first, last = self.values[0], self.values[-1] + 1
        contiguous = self.values == tuple(range(first, last))
        object.__setattr__(self, "_take", slice(first, last) if contiguous else list(self.values))

    def frame(self, fields: Sequence[float] | np.ndarray, finite: bool) -> RawFrame:
        """Return the frame of (``count``,) fields, NaN where there is no number.

        Raises:
            FrameError: counter or time are no ``number``.
        """
        seq = None if self.counter is None else fields[self.counter]
        ticks = None if self.time is None else float(fields[self.time])
        if (seq is not None and (not 0 <= seq < np.inf or seq % 1)) or (
            ticks is not None and not 0 <= ticks < np.inf
        ):
            raise FrameError("number")
        values = np.array(fields, dtype=np.float64)[self._take]  # type: ignore[attr-defined]
        if self.invalid and not self.invalid.isdisjoint(values.tolist()):
            values[np.isin(values, list(self.invalid))] = nan
            finite = False
        if self.magnitude:
            values = np.linalg.norm(values.reshape(-1, 3), axis=1)
        return RawFrame(None if seq is None else int(seq), ticks, values, finite)


@dataclass(frozen=True)
class TextFormat:
    """Lines, or other pieces of text with a delimiter.

    Attributes:
        roles: of the fields.
        check: kind of checksum.
        trailing: every line ends with a separator, so no line means an empty field by it.
        parse: returns the fields of a line.
        delimiter: between two frames; LF also stands for CRLF and LF CR.
        padded: whether a line may lack its last field, where a separator ends it.
    """

    roles: Roles
    check: Check = "none"
    trailing: bool = False
    parse: Callable[[bytes], Line] = parse_line
    delimiter: bytes = b"\n"
    padded: bool = True
    name: str = "text"

    @property
    def sensors(self) -> int:
        """S."""
        return self.roles.sensors

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the complete lines, and what is left."""
        *pieces, left = data.split(self.delimiter)
        return pieces, left

    def fields(self, piece: bytes) -> Line | bytes:
        """Return the fields of a line, or the line where it is empty or a comment; else raise FrameError."""
        line = piece.strip(b"\r\n")
        if not line or line.startswith(b"#"):
            return line
        read = self._parse(line)
        if read.check != self.check:
            raise FrameError("checksum")
        if (missing := self.roles.count - len(read.fields)) == 0:
            return read
        if missing != 1 or self.trailing or not self.padded or not ends_with_separator(line):
            extra = self.roles.count - len(self.roles.values)
            raise FrameError("fields", len(read.fields) - extra)
        return Line([*read.fields, nan], read.check, False)

    def _parse(self, line: bytes) -> Line:
        """Return the fields of a line; a word in place of a value, such as for over-range, costs only it."""
        try:
            return self.parse(line)
        except FrameError as bad:
            if 2 * sum(map(isfinite, bad.numbers)) <= self.roles.count:
                raise
            return Line(bad.numbers, bad.check, False)

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame in a line, or the line where it is empty or a comment; else raise FrameError."""
        read = self.fields(piece)
        return read if isinstance(read, bytes) else self.roles.frame(read.fields, read.finite)


class RowsFormat:
    """Several lines per frame: the rows of a matrix, or an index and its values.

    A frame counts only if each of its rows arrived, in order.

    Args:
        line: format of a row.
        rows: of a frame.
        index: field with the number of the row; None: other lines stand between two frames.
        first: the smallest index.
    """

    name: ClassVar[str] = "rows"

    def __init__(self, line: TextFormat, rows: int, index: int | None, first: int) -> None:
        self._line, self.rows, self._index, self._first = line, rows, index, first
        self._partial: list[Line] = []
        self._open, self._told = False, True
        self.sensors, self.check = rows * line.sensors, line.check

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the complete lines, and what is left."""
        return self._line.split(data)

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame whose last row this line is; bytes within a frame; else raise FrameError."""
        try:
            row = self._line.fields(piece)
        except FrameError:
            if self._index is not None:
                return self._break()
            row = b""
        if isinstance(row, bytes):
            broken = self._index is None and not row.startswith(b"# skin") and self._begin()
            return self._break() if broken else row
        broken = False
        if self._index is not None:
            number = row.fields[self._index]
            if number == self._first:
                broken = self._begin()
            elif number != self._first + len(self._partial):
                return self._break()
        if not self._open:
            return self._break()
        self._partial.append(row)
        if broken:
            raise FrameError("rows")
        if len(self._partial) < self.rows:
            return b""
        self._open = self._told = False
        return self._join()

    def _begin(self) -> bool:
        """Begin a frame; return whether the one before it is incomplete."""
        broken = self._open and bool(self._partial)
        self._partial, self._open, self._told = [], True, False
        return broken

    def _break(self) -> bytes:
        """Skip the rows up to the next frame; the first of them counts as a bad frame."""
        told, self._told = self._told, True
        self._partial = []
        self._open = self._open and self._index is None and not told
        if told:
            return b""
        raise FrameError("rows")

    def _join(self) -> RawFrame:
        frames = [self._line.roles.frame(row.fields, row.finite) for row in self._partial]
        self._partial = []
        values = np.concatenate([frame.values for frame in frames])
        return RawFrame(frames[0].seq, frames[0].ticks, values, all(frame.finite for frame in frames))


@dataclass(frozen=True)
class FixedFormat:
    """Frames of a fixed length, which only their own bytes delimit.

    Attributes:
        roles: of the fields.
        parse: returns the fields of a frame.
        length: bytes.
        pattern: regular expression of a frame.
        follow: that of what must follow it, because a lost byte would shift the values; empty: nothing.
        margin: bytes that ``follow`` takes.
    """

    roles: Roles
    parse: Callable[[bytes], Line]
    length: int
    pattern: re.Pattern[bytes]
    follow: bytes = b""
    margin: int = 0
    name: str = "binary"
    check: Check = "none"

    @property
    def sensors(self) -> int:
        """S."""
        return self.roles.sensors

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the frames, the bytes between them as pieces of their own, and what is left."""
        pieces, place = list[bytes](), 0
        step = re.compile(self.pattern.pattern + b"(?=" + self.follow + b")", re.DOTALL)
        both = re.compile(b"(?=" + self.pattern.pattern * 2 + b")", re.DOTALL)
        while len(data) - place >= self.length + self.margin:
            if step.match(data, place):
                pieces.append(data[place : place + self.length])
                place += self.length
                continue
            following = both.search(data, place + 1)
            end = following.start() if following else len(data) - 2 * self.length + 1
            if end <= place:
                break
            pieces.append(data[place:end])
            place = end
        return pieces, data[place:]

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return a frame; else raise FrameError."""
        if not self.pattern.fullmatch(piece):
            raise FrameError("structure")
        read = self.parse(piece)
        return self.roles.frame(read.fields, read.finite)


@dataclass(frozen=True)
class BinaryFormat:
    """COBS frames of our protocol."""

    sensors: int
    name: ClassVar[str] = "binary"
    check: ClassVar[Check] = "crc16"

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return what stands between zeros, and what is left."""
        *pieces, left = data.split(b"\0")
        return pieces, left

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame between two zeros, or the text of a comment; else raise FrameError."""
        comment = decode_comment(piece) if piece else b""
        if comment is not None:
            return comment
        frame = decode_frame(piece)
        if len(frame.values) != self.sensors:
            raise FrameError("fields", len(frame.values))
        return frame


class DetectedFormat(NamedTuple):
    """What the first bytes of a connection show.

    Attributes:
        frame_format: None if it is not known yet.
        count_seen: number of values in readable frames that do not match the layout; or None.
        header: the last one received.
        unit: s per tick of the device's clock, if the bytes determine it; None: they do not.
        settled: whether ``unit`` was set by the user.
        summary: what was inferred, in words.
    """

    frame_format: FrameFormat | None = None
    count_seen: int | None = None
    header: Header | None = None
    unit: float | None = None
    settled: bool = False
    summary: str = ""


_LINES, _FRAMES = 3, 2
_LINES_UNKNOWN = 8  # three lines of noise may count upwards by accident, eight hardly
_STEP = 1000  # frames that may be missing between two consecutive lines


def protocol_roles(sensors: int, counted: bool) -> Roles:
    """Return the fields of a line of our protocol; ``counted``: seq and t_us stand before the values."""
    if not counted:
        return Roles(sensors, tuple(range(sensors)))
    return Roles(sensors + 2, tuple(range(2, sensors + 2)), 0, 1)


def detect_format(data: bytes, sensors: int | None, format: Format) -> DetectedFormat:
    """Return the format of the first bytes of a connection, in our protocol.

    Args:
        data: from the first byte on; an incomplete piece at the end is ignored.
        sensors: S, or None to detect it.
        format: only this format, or ``auto``.
    """
    count_seen = None
    if format != "text":
        counts = list[int]()
        for piece in data.split(b"\0")[:-1]:
            with suppress(FrameError):
                counts.append(len(decode_frame(piece).values))
        for count in counts:
            if counts.count(count) >= _FRAMES and sensors in (None, count):
                return DetectedFormat(BinaryFormat(count))
            count_seen = count
    if format == "binary":
        return DetectedFormat(count_seen=count_seen)
    return _detect_text(data, sensors, count_seen)


def detection_error(data: bytes, count_seen: int | None, sensors: int | None) -> InputError:
    """Return the error for data in which no format was detected."""
    if count_seen is not None and sensors is not None:
        return SensorCountError(count_seen, sensors)
    text = data[:64].decode("ascii", "replace")
    readable = sum(character.isprintable() or character in "\r\n\t" for character in text) > 0.9 * len(text)
    sample = repr(text) if readable else data[:64].hex(" ")
    return InputError(
        f"no frame in {len(data)} bytes, which begin with {sample}: is the baud rate right, as in "
        "device.baudrate=115200? For another format, skin listen adapter=auto proposes an adapter"
    )


class SensorCountError(InputError):
    """The device has another number of sensors than the layout.

    Attributes:
        sent: values per frame.
    """

    def __init__(self, sent: int, sensors: int) -> None:
        self.sent = sent
        super().__init__(
            f"the device sends {sent} values per frame, the layout has {sensors} sensors: give its own "
            "layout, as in layout=file layout.path=FILE.csv"
        )


def _parse_numbers(line: bytes) -> Line | None:
    """Return a line if more than half of its fields are numbers; only such lines show a format."""
    try:
        read = parse_line(line.removesuffix(b"\r"))
    except FrameError:
        return None
    return read if 2 * sum(map(isfinite, read.fields)) > len(read.fields) else None


def _detect_text(data: bytes, sensors: int | None, count_seen: int | None) -> DetectedFormat:
    header, run = None, list[Line]()
    for piece in data.split(b"\n")[:-1]:
        line = piece.removesuffix(b"\r")
        if line.startswith(b"#"):
            header = parse_header(line) or header
            continue
        if (read := _parse_numbers(line)) is None:
            run = []
            continue
        if run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check):
            run = []
        run = [*run[1 - _LINES_UNKNOWN :], read]
        expected = sensors or (header.n if header else None)
        if frame_format := _judge(run, expected, learn=sensors is None):
            return DetectedFormat(replace(frame_format, trailing=ends_with_separator(line)), None, header)
        if len(run) >= _LINES:
            count_seen = len(read.fields) - 2 * _all_count(run[-_LINES:])
    return DetectedFormat(None, count_seen, header)


def _judge(run: Sequence[Line], sensors: int | None, learn: bool) -> TextFormat | None:
    """Return the format of similar lines, or None if they do not determine it."""
    if len(run) < _LINES:
        return None
    count, check = len(run[-1].fields), run[-1].check
    counting = _all_count(run[-_LINES:])
    if count == sensors:
        return TextFormat(protocol_roles(count, False), check)
    if sensors is not None and count == sensors + 2 and counting:
        return TextFormat(protocol_roles(sensors, True), check)
    if not learn or len(run) < _LINES_UNKNOWN:
        return None
    counting = _all_count(run)
    return TextFormat(protocol_roles(count - 2 * counting, counting), check)


def _all_count(run: Sequence[Line]) -> bool:
    """Return whether the two columns before the values are a frame number and a time."""
    return len(run) > 1 and all(_counts(before.fields, line.fields) for before, line in pairwise(run))


def _counts(before: Sequence[float], line: Sequence[float]) -> bool:
    if len(line) < 3 or any(field < 0 or field % 1 for field in (before[0], line[0])):
        return False
    # A clock of whole seconds, or one that stands still, is one too: the decoder judges it.
    later = line[1] >= before[1] or line[1] < 2**31 < before[1]
    return later and 0 < frames_ahead(int(before[0]), int(line[0])) <= _STEP
