"""Detect the format of a device from two binary frames or three lines with equal numbers of fields."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isfinite, nan
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from skin.errors import InputError
from skin.signal.frame import Check, FrameError
from skin.wire.binary import decode_comment, decode_frame
from skin.wire.sequence import frames_ahead
from skin.wire.text import Header, Line, ends_with_separator, parse_header, parse_line

Format = Literal["auto", "text", "binary"]

_LINES, _FRAMES = 3, 2
_LINES_UNKNOWN = 8  # three lines of noise may count upwards by chance, eight hardly
_STEP = 1000  # frames that may be missing between two consecutive lines


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


def detect_format(data: bytes, sensors: int | None, wanted: Format) -> DetectionResult:
    """Detect the format from the first bytes of a connection.

    Args:
        data: from the first byte on; an incomplete piece at the end is ignored.
        sensors: S, or None to detect it.
        wanted: only this format, or ``auto``.
    """
    other = None
    if wanted != "text":
        counts = _binary_counts(data)
        for count in counts:
            if counts.count(count) >= _FRAMES and sensors in (None, count):
                return DetectionResult(BinaryFormat(count), None, None)
            other = count
    if wanted == "binary":
        return DetectionResult(None, other, None)
    return _detect_text(data, sensors, other)


def detection_error(data: bytes, found: DetectionResult, sensors: int | None) -> InputError:
    """Return the error for data in which no format was detected."""
    if _still(run := _lines(data)):
        return stopped_clock_error(len(run), run[0].fields[1])
    if found.sensors is not None and sensors is not None:
        return InputError(
            f"the device sends {found.sensors} values per frame, the layout has {sensors} sensors: give its "
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


def _numeric(line: Line) -> bool:
    """Return whether more than half of the fields are numbers; only such lines show a format."""
    return line.finite or 2 * sum(map(isfinite, line.fields)) > len(line.fields)


def _still(run: Sequence[Line]) -> bool:
    """Return whether the first column counts while the next one, the time, is constant."""
    run = [line for line in run if len(line.fields) > 2]
    times = {line.fields[1] for line in run}
    if len(run) < _LINES_UNKNOWN or len(times) > 1 or not all(map(isfinite, times)):
        return False
    return _all_count([Line([line.fields[0], place, 0], line.check) for place, line in enumerate(run)])


def _lines(data: bytes) -> list[Line]:
    """Return the lines of numbers; the first piece may be half a line."""
    found = []
    for piece in data.split(b"\n")[1:-1]:
        with suppress(FrameError):
            found.append(parse_line(piece.removesuffix(b"\r")))
    return [line for line in found if _numeric(line)]


def _binary_counts(data: bytes) -> list[int]:
    counts = []
    for piece in data.split(b"\0")[:-1]:
        with suppress(FrameError):
            counts.append(len(decode_frame(piece).values))
    return counts


def _detect_text(data: bytes, sensors: int | None, other: int | None) -> DetectionResult:
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
        if not _numeric(read):
            run = []
            continue
        if run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check):
            run = []
        run = [*run[1 - _LINES_UNKNOWN :], read] if read.fields else []
        expected = sensors or (header.n if header else None)
        if frame_format := _judge(run, expected, learn=sensors is None):
            found = replace(frame_format, trailing=ends_with_separator(line))
            return DetectionResult(found, None, header)
        if len(run) >= _LINES:
            other = len(read.fields) - 2 * _all_count(run[-_LINES:])
    return DetectionResult(None, other, header)


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
    if not learn or len(run) < _LINES_UNKNOWN or _still(run):
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
