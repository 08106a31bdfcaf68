"""Formats of frames: how bytes are cut into pieces, and what the fields of a piece are."""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isfinite, nan
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.errors import InputError
from skin.wire.lines import NumberWords, Reader, SeparatedReader
from skin.wire.protocol import (
    INVALID,
    OVER,
    SEPARATORS,
    Format,
    Header,
    Line,
    RawFrame,
    decode_comment,
    decode_frame,
    ends_with_separator,
    frames_ahead,
    parse_header,
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

    def frame(self, line: Line) -> RawFrame:
        """Return the frame of a line with ``count`` fields.

        A word, or digits of another base, in place of a value costs only it; anything else may be a line that
        is damaged.

        Raises:
            FrameError: counter or time are no ``number``, or a value is none.
        """
        fields, finite = line.fields, line.finite
        seq = None if self.counter is None else fields[self.counter]
        ticks = None if self.time is None else float(fields[self.time])
        if (seq is not None and (not 0 <= seq < inf or seq % 1)) or (
            ticks is not None and not 0 <= ticks < inf
        ):
            raise FrameError("number")
        values = np.array(fields, dtype=np.float64)[self._take]  # type: ignore[attr-defined]
        if not finite:
            strange = [word for place, word in line.strange.items() if place in self.values]
            words_alone = all(word.isalpha() or not word.strip(b"0123456789abcdefABCDEF") for word in strange)
            if strange and not (words_alone and 2 * np.isfinite(values).sum() > len(values)):
                raise FrameError("number", word=strange[0].decode("ascii", "replace"))
            finite = bool(np.isfinite(values).all())
        if self.invalid and not self.invalid.isdisjoint(values.tolist()):
            values[np.isin(values, list(self.invalid))] = nan
            finite = False
        if self.magnitude:
            values = np.linalg.norm(values.reshape(-1, 3), axis=1)
        return RawFrame(None if seq is None else int(seq), ticks, values, finite)


class Delimited:
    """Cuts where a text stands: LF also stands for CRLF and LF CR.

    Args:
        delimiter: the text.
    """

    def __init__(self, delimiter: bytes) -> None:
        self._delimiter = delimiter

    def __call__(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the complete pieces, and what is left."""
        *pieces, left = data.split(self._delimiter)
        return pieces, left


class FixedLength:
    """Cuts frames of a fixed length, which only their own bytes delimit.

    What must follow a frame is checked, too, because a lost byte would shift its values.

    Args:
        length: bytes of a frame.
        pattern: regular expression of a frame.
        follow: that of what must follow it; empty: nothing.
        margin: bytes that ``follow`` takes.
    """

    def __init__(self, length: int, pattern: bytes, follow: bytes = b"", margin: int = 0) -> None:
        self.length, self._margin = length, margin
        self.frame = re.compile(pattern, re.DOTALL)
        self._step = re.compile(pattern + b"(?=" + follow + b")", re.DOTALL)
        self._both = re.compile(b"(?=" + pattern * 2 + b")", re.DOTALL)

    def __call__(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the frames, the bytes between them as pieces of their own, and what is left."""
        pieces, place = list[bytes](), 0
        while len(data) - place >= self.length + self._margin:
            if self._step.match(data, place):
                end = place + self.length
            else:
                following = self._both.search(data, place + 1)
                end = following.start() if following else len(data) - 2 * self.length + 1
            if end <= place:
                break
            pieces.append(data[place:end])
            place = end
        return pieces, data[place:]


_ANSI = re.compile(rb"\x1b\[[0-9;]*[A-Za-z]|\0")  # colours of a terminal, and the end of a string in C


@dataclass(frozen=True)
class Layout:
    """A splitter and a reader: pieces and their fields.

    Attributes:
        split: cuts bytes into pieces.
        reader: of the fields of a piece.
        name: word for the user.
        ignore: regular expression of the lines that are no frames.
        plain: the lines are those of our protocol, in which no byte is left out.
    """

    split: Delimited | FixedLength
    reader: Reader
    name: str = "text"
    ignore: re.Pattern[bytes] | None = None
    plain: bool = False

    def fields(self, piece: bytes) -> Line | bytes:
        """Return the fields of a piece; the line where it is empty, ignored or a comment; else FrameError."""
        if isinstance(self.split, FixedLength):
            if not self.split.frame.fullmatch(piece):
                raise FrameError("structure")
            return self.reader(piece)
        line = (piece if self.plain else _ANSI.sub(b"", piece)).strip(b"\r\n")
        if not line or line.startswith(b"#") or (self.ignore is not None and self.ignore.fullmatch(line)):
            return line
        return self.reader(line)


@dataclass(frozen=True)
class FieldFormat:
    """Frames of one piece each.

    Attributes:
        layout: of the pieces.
        roles: of their fields.
        check: kind of checksum.
    """

    layout: Layout
    roles: Roles
    check: Check = "none"

    @property
    def name(self) -> str:
        """Word for the user."""
        return self.layout.name

    @property
    def sensors(self) -> int:
        """S."""
        return self.roles.sensors

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return the complete pieces, and what is left."""
        return self.layout.split(data)

    def fields(self, piece: bytes) -> Line | bytes:
        """Return the fields of a piece, or the line where it is none; else raise FrameError."""
        read = self.layout.fields(piece)
        if isinstance(read, bytes):
            return read
        if read.check != self.check:
            raise FrameError("checksum")
        if len(read.fields) != self.roles.count:
            raise FrameError("fields", len(read.fields) - self.roles.count + len(self.roles.values))
        return read

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame in a piece, or the line where it is none; else raise FrameError."""
        read = self.fields(piece)
        return read if isinstance(read, bytes) else self.roles.frame(read)


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

    def __init__(self, line: FieldFormat, rows: int, index: int | None, first: int) -> None:
        self.line, self.rows, self.index, self._first = line, rows, index, first
        self._partial: list[Line] = []
        self._open, self._partial_reported = False, True
        self.sensors, self.check = rows * line.sensors, line.check
        self.split = line.split

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame whose last row this line is; bytes within a frame; else raise FrameError."""
        try:
            row = self.line.fields(piece)
        except FrameError:
            if self.index is not None:
                return self._break()
            row = b""
        if isinstance(row, bytes):
            broken = self.index is None and not row.startswith(b"# skin") and self._begin()
            return self._break() if broken else row
        broken = False
        if self.index is not None:
            number = row.fields[self.index]
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
        frames, self._partial = [self.line.roles.frame(row) for row in self._partial], []
        self._open = self._partial_reported = False
        values = np.concatenate([frame.values for frame in frames])
        return RawFrame(frames[0].seq, frames[0].ticks, values, all(frame.finite for frame in frames))

    def _begin(self) -> bool:
        """Begin a frame; return whether the one before it is incomplete."""
        broken = self._open and bool(self._partial)
        self._partial, self._open, self._partial_reported = [], True, False
        return broken

    def _break(self) -> bytes:
        """Skip the rows up to the next frame; the first of them counts as a bad frame."""
        reported, self._partial_reported = self._partial_reported, True
        self._partial = []
        self._open = self._open and self.index is None and not reported
        if reported:
            return b""
        raise FrameError("rows")


@dataclass(frozen=True)
class BinaryFormat:
    """COBS frames of our protocol."""

    sensors: int
    name: ClassVar[str] = "binary"
    check: ClassVar[Check] = "crc16"
    split: ClassVar[Delimited] = Delimited(b"\0")

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
        unit: s per tick of the device's clock, as far as the bytes tell; None: they do not.
        settled: whether ``unit`` was set by the user.
        summary: what was inferred, in words.
    """

    frame_format: FrameFormat | None = None
    count_seen: int | None = None
    header: Header | None = None
    unit: float | None = None
    settled: bool = False
    summary: str = ""


_WORDS = SeparatedReader(NumberWords(".", "", 10, INVALID, OVER), SEPARATORS)
LINES = Layout(Delimited(b"\n"), _WORDS, plain=True)
"""Lines of our protocol."""


def protocol_roles(sensors: int, counted: bool) -> Roles:
    """Return the fields of a line of our protocol; ``counted``: seq and t_us stand before the values."""
    if not counted:
        return Roles(sensors, tuple(range(sensors)))
    return Roles(sensors + 2, tuple(range(2, sensors + 2)), 0, 1)


def detect_format(data: bytes, sensors: int | None, format: Format, frames: int = 2) -> DetectedFormat:
    """Return the format of the first bytes of a connection, in our protocol.

    Args:
        data: from the first byte on; an incomplete piece at the end is ignored.
        sensors: S, or None to detect it.
        format: only this format, or ``auto``.
        frames: of one size with a correct CRC that show the binary format.
    """
    count_seen = None
    if format != "text":
        counts = list[int]()
        for piece in data.split(b"\0")[:-1]:
            with suppress(FrameError):
                counts.append(len(decode_frame(piece).values))
        for count in counts:
            if counts.count(count) >= frames and sensors in (None, count):
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


def _detect_text(
    data: bytes, sensors: int | None, count_seen: int | None, few: int = 3, many: int = 8
) -> DetectedFormat:
    """Return the format of lines: ``few`` alike show one of S sensors; noise may count by chance, so ``many``
    are needed where S is unknown."""
    header, run = None, list[Line]()
    for piece in LINES.split(data)[0]:
        try:
            read = LINES.fields(piece)
        except FrameError:
            read = Line([])
        if isinstance(read, bytes) and read:
            header = parse_header(read) or header
            continue
        # Only lines of which more than half of the fields are numbers show a format.
        if not read or read.strange or 2 * sum(map(isfinite, read.fields)) <= len(read.fields):
            run = []
            continue
        if run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check):
            run = []
        run = [*run[1 - many :], read]
        if len(run) < few:
            continue
        count, expected, counted = (
            len(read.fields),
            sensors or (header.n if header else None),
            _all_count(run[-few:]),
        )
        fits = count == expected or (counted and count - 2 == expected)
        if not fits and sensors is None and len(run) == many:
            expected, fits = count - 2 * _all_count(run), True
        if fits and expected:
            reader = replace(_WORDS, trailing=ends_with_separator(piece.strip(b"\r\n")))
            roles = protocol_roles(expected, count != expected)
            return DetectedFormat(FieldFormat(replace(LINES, reader=reader), roles, read.check), None, header)
        count_seen = count - 2 * counted
    return DetectedFormat(None, count_seen, header)


def _all_count(run: Sequence[Line]) -> bool:
    """Return whether the two columns before the values are a frame number and a time."""
    return len(run) > 1 and all(_counts(before.fields, line.fields) for before, line in pairwise(run))


def _counts(before: Sequence[float], line: Sequence[float], step: int = 1000) -> bool:
    """Return whether a line follows another one, with fewer than ``step`` between them."""
    if len(line) < 3 or any(field < 0 or field % 1 for field in (before[0], line[0])):
        return False
    # A clock of whole seconds, or one that stands still, is one too: the decoder judges it.
    later = line[1] >= before[1] or line[1] < 2**31 < before[1]
    return later and 0 < frames_ahead(int(before[0]), int(line[0])) <= step
