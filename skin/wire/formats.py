"""Formats of frames: how bytes are cut into pieces, and what the fields of a piece are."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from math import inf, nan
from typing import ClassVar, NamedTuple

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.errors import InputError
from skin.wire.lines import Reader
from skin.wire.protocol import Header, Line, RawFrame, decode_frame, frames_ahead


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
            strange = [word for position, word in line.strange.items() if position in self.values]
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


Split = Callable[[bytes], tuple[list[bytes], bytes]]
"""Returns the complete pieces of bytes, and what is left."""


def split_at(delimiter: bytes, data: bytes) -> tuple[list[bytes], bytes]:
    """Return the pieces between delimiters, and what is left. LF also stands for CRLF and LF CR."""
    *pieces, left = data.split(delimiter)
    return pieces, left


def fixed_length(length: int, pattern: bytes, follow: bytes = b"", margin: int = 0) -> Split:
    """Return a function that cuts frames of a fixed length, which only their own bytes delimit.

    Bytes between them are pieces of their own. What must follow a frame is checked, too, because a lost byte
    would shift its values.

    Args:
        length: bytes of a frame.
        pattern: regular expression of a frame.
        follow: that of what must follow it; empty: nothing.
        margin: bytes that ``follow`` takes.
    """
    step = re.compile(pattern + b"(?=" + follow + b")", re.DOTALL)
    both = re.compile(b"(?=" + pattern * 2 + b")", re.DOTALL)

    def split(data: bytes) -> tuple[list[bytes], bytes]:
        pieces, position = list[bytes](), 0
        while len(data) - position >= length + margin:
            following = None if (fits := step.match(data, position)) else both.search(data, position + 1)
            end = following.start() if following else len(data) - 2 * length + 1
            end = position + length if fits else end
            if end <= position:
                break
            pieces.append(data[position:end])
            position = end
        return pieces, data[position:]

    return split


_ANSI = re.compile(rb"\x1b\[[0-9;]*[A-Za-z]|\0")  # colours of a terminal, and the end of a string in C


@dataclass(frozen=True)
class FieldFormat:
    """Frames of one piece each: a splitter, and a reader of the fields.

    Attributes:
        split: cuts bytes into pieces.
        reader: of the fields of a piece.
        name: word for the user.
        ignore: regular expression of the lines that are no frames.
        frame: regular expression of a frame of a fixed length; None: pieces are lines.
        plain: the lines are those of our protocol, in which no byte is left out.
        roles: of the fields; None: not known yet.
        check: kind of checksum.
    """

    split: Split
    reader: Reader
    name: str = "text"
    ignore: re.Pattern[bytes] | None = None
    frame: re.Pattern[bytes] | None = None
    plain: bool = False
    roles: Roles | None = None
    check: Check = "none"

    @property
    def sensors(self) -> int:
        """S."""
        return self.roles.sensors if self.roles else 0

    def fields(self, piece: bytes) -> Line | bytes:
        """Return the fields of a piece; the line where it is empty, ignored or a comment; else FrameError."""
        if self.frame is None:
            piece = (piece if self.plain else _ANSI.sub(b"", piece)).strip(b"\r\n")
            if not piece or piece.startswith(b"#") or (self.ignore and self.ignore.fullmatch(piece)):
                return piece
        elif not self.frame.fullmatch(piece):
            raise FrameError("structure")
        read = self.reader(piece)
        if self.roles is None:
            return read
        if read.check != self.check:
            raise FrameError("checksum")
        if len(read.fields) != self.roles.count:
            raise FrameError("fields", len(read.fields) - self.roles.count + len(self.roles.values))
        return read

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame in a piece, or the line where it is none; else raise FrameError."""
        read = self.fields(piece)
        return read if isinstance(read, bytes) else self.roles.frame(read)  # type: ignore[union-attr]


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

    def __init__(self, line: FieldFormat, rows: int, index: int | None, first: float) -> None:
        self.line, self.rows, self.index, self._first = line, rows, index, first
        self._partial: list[Line] = []
        self._open, self._reported = False, True
        self.sensors, self.check, self.split = rows * line.sensors, line.check, line.split

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame whose last row this line is; bytes within a frame; else raise FrameError."""
        row: Line | bytes | None = None
        with suppress(FrameError):
            row = self.line.fields(piece)
        if isinstance(row, bytes) and (self.index is not None or row.startswith(b"# skin")):
            return row
        if self.index is not None:
            number = row.fields[self.index] - self._first if isinstance(row, Line) else -1
        else:
            number = (len(self._partial) if self._open else -1) if isinstance(row, Line) else 0
        expected, fits = len(self._partial), number in (0, len(self._partial))
        incomplete = number != expected and bool(expected or not self._reported)
        kept = self._partial if number and fits else []
        self._partial = [*kept, row] if fits and isinstance(row, Line) else []
        self._open, self._reported = fits, not fits
        if incomplete:
            raise FrameError("rows")
        if len(self._partial) < self.rows:
            return row if isinstance(row, bytes) else b""
        frames, self._partial, self._open = [self.line.roles.frame(row) for row in self._partial], [], False  # type: ignore[union-attr]
        values = np.concatenate([frame.values for frame in frames])
        return RawFrame(frames[0].seq, frames[0].ticks, values, all(frame.finite for frame in frames))


@dataclass(frozen=True)
class BinaryFormat:
    """COBS frames of our protocol."""

    sensors: int
    name: ClassVar[str] = "binary"
    check: ClassVar[Check] = "crc16"

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Return what stands between zeros, and what is left."""
        return split_at(b"\0", data)

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame between two zeros, or the text of a comment; else raise FrameError."""
        frame = decode_frame(piece) if piece else b""
        if isinstance(frame, bytes):
            return frame
        if len(frame.values) != self.sensors:
            raise FrameError("fields", len(frame.values))
        return frame


FrameFormat = FieldFormat | RowsFormat | BinaryFormat
"""Cuts bytes into pieces, and reads the frames that end with them."""


class DetectedFormat(NamedTuple):
    """What the first bytes of a connection show.

    Attributes:
        frame_format: None if it is not known yet.
        count_seen: number of values in readable frames that do not match the layout; or None.
        header: the last one received.
        unit: s per tick of the device's clock, as far as the bytes tell; None: they do not.
        summary: what was inferred, in words.
    """

    frame_format: FrameFormat | None = None
    count_seen: int | None = None
    header: Header | None = None
    unit: float | None = None
    summary: str = ""


def detect_binary(data: bytes, sensors: int | None, frames: int = 2) -> DetectedFormat:
    """Return the binary format of our protocol, if ``frames`` of one size with a correct CRC show it.

    Args:
        data: from the first byte on; an incomplete piece at the end is ignored.
        sensors: S, or None to detect it.
        frames: to be seen.
    """
    counts = list[int]()
    for piece in data.split(b"\0")[:-1]:
        with suppress(FrameError):
            if isinstance(frame := decode_frame(piece), RawFrame):
                counts.append(len(frame.values))
    often = [count for count in counts if counts.count(count) >= frames and sensors in (None, count)]
    return DetectedFormat(BinaryFormat(often[0]) if often else None, counts[-1] if counts else None)


def protocol_roles(run: Sequence[Line], sensors: int | None, n: int | None) -> Roles | int | None:
    """Return the fields of lines of our protocol: seq and t_us before the values, or the values alone.

    Three lines show one of S sensors; noise may count by chance, so eight are needed where S is unknown.

    Args:
        run: lines alike; the last eight.
        sensors: S, or None to detect it.
        n: number of sensors of the header, or None.

    Returns:
        the roles; None: more lines are needed; a number: that of the values of lines of another number.
    """
    if len(run) < 3:
        return None
    count, expected, counted = len(run[-1].fields), sensors or n, _count(run[-3:])
    if not (count == expected or (counted and count - 2 == expected)):
        if sensors is not None or len(run) < 8:
            return count - 2 * counted
        expected = count - 2 * _count(run)
    shift = count - (expected or 0)
    return Roles(count, tuple(range(shift, count)), *((0, 1) if shift else ()))


def _count(run: Sequence[Line], step: int = 1000) -> bool:
    """Return whether the first two fields are a frame number, of which ``step`` may be missing, and a time.

    A clock of whole seconds, or one that stands still, is one too: the decoder judges it.
    """
    table = np.array([line.fields for line in run])[:, :2]
    if len(run[0].fields) < 3 or not np.isfinite(table).all() or (table < 0).any() or (table[:, 0] % 1).any():
        return False
    seqs, times = table.T.tolist()
    ahead = (frames_ahead(int(before), int(seq)) for before, seq in pairwise(seqs))
    later = (time >= before or time < 2**31 < before for before, time in pairwise(times))
    return all(0 < frames <= step for frames in ahead) and all(later)


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
