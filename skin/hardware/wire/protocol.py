"""What a device sends: lines of text, or binary frames; and announcements of an emulated skin.

Text: one frame a line, ``seq,t_us,v0,...,vN-1*HHHH``. A line that starts with # is a comment. The header is
one, best with a checksum too: ``# skin proto=1 n=25 rate=100 unit=adc bits=10 id=arm-L``.

Binary: COBS with 0x00 between frames, little-endian. A frame: u8 0xA5, u8 type (1 u16, 2 i16, 3 f32),
u16 seq, u32 t_us, u16 n, n values, u16 CRC-16/CCITT-FALSE of all before it. A comment, such as the header:
u8 0xA5, u8 type 35 (``#``), a comment line of the text protocol without its checksum, u16 CRC. COBS: Cheshire
and Baker, "Consistent overhead byte stuffing", IEEE/ACM ToN 7 (1999).

Announcements: comments of the text protocol in which an emulated skin describes its next gesture; for its
contacts see :mod:`skin.hardware.wire.contact_lines`.
"""

import binascii
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import pairwise
from math import isfinite, nan
from operator import xor
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.errors import InputError


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF; ``123456789`` gives 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def xor8(data: bytes) -> int:
    """Return all bytes combined by exclusive or, as NMEA 0183 does.

    Weak: 2.0 % of double bit flips, 5.8 % of double lost bytes and 4.8 % of glued lines pass.
    """
    return reduce(xor, data, 0)


_SEPARATORS = (b",", b";", b"\t")

INVALID = frozenset(
    (b"", b"-", b"--", b"nan", b"inf", b"-inf", b"ovf", b"err", b"error", b"na", b"n/a", b"null", b"none")
)
"""Fields, in lower case, that firmware sends instead of a value that it could not read; also an empty one."""


class Line(NamedTuple):
    """The numbers of a line, and the kind of its checksum.

    Attributes:
        fields: NaN where a field is one of ``INVALID``, or a number that is too large for a float.
        check: kind of checksum.
        finite: whether every field is a number.
    """

    fields: list[float]
    check: Check
    finite: bool = True


@dataclass(frozen=True)
class Header:
    """Description of a device, sent in a comment line.

    Attributes:
        proto: version of the protocol.
        n: number of sensors.
        rate: frames per second, Hz.
        unit: of the values: ``adc``, ``N``.
        bits: of the converter: the largest count is ``2**bits - 1``.
        id: name of the device.
    """

    proto: int = 1
    n: int | None = None
    rate: float | None = None
    unit: str | None = None
    bits: int | None = None
    id: str | None = None


def encode_line(values: Sequence[float], seq: int, t_us: int, check: Check = "crc16") -> bytes:
    """Return a line, LF at its end.

    Args:
        values: (S,), whole numbers or floats.
        seq: number of the frame.
        t_us: the device's clock, microseconds, modulo 2**32.
        check: kind of checksum.
    """
    return _checked(",".join(map(_number, (seq, t_us, *values))), check)


def encode_header(header: Header, check: Check = "crc16") -> bytes:
    """Return the header's line, LF at its end."""
    settings = {name: value for name, value in vars(header).items() if value is not None}
    words = " ".join(f"{name}={_number(value)}" for name, value in settings.items())
    return _checked(f"# skin {words}", check)


def parse_line(line: bytes) -> Line:
    """Parse a line without its end; fields are separated by comma, semicolon, tab or blanks.

    Raises:
        FrameError: ``checksum`` is wrong or unknown, or a field is no ``number`` and not one of ``INVALID``.
    """
    body, check = _verified(line)
    if b"_" in body:  # valid in Python's grammar only
        raise FrameError("number")
    words = _split(body.lstrip().rstrip(b" \r"))
    try:
        fields = [float(word) for word in words]
    except ValueError:
        fields = [nan]
    if all(map(isfinite, fields)):
        return Line(fields, check)
    return Line([_field(word) for word in words], check, False)


def ends_with_separator(line: bytes) -> bool:
    """Return whether a separator ends the line: its last field is empty, or firmware always writes one."""
    return line.rpartition(b"*")[0 if b"*" in line else 2].rstrip(b" \r")[-1:] in _SEPARATORS


def _field(word: bytes) -> float:
    """Return the number of a field; NaN where it says that there is none."""
    word = word.strip()
    if word.lower() in INVALID:
        return nan
    try:
        value = float(word)
    except ValueError:
        raise FrameError("number") from None
    return value if isfinite(value) else nan


def parse_header(line: bytes) -> Header | None:
    """Return the header if this comment is one whose checksum, where it has one, is right; else None."""
    try:
        body, _ = _verified(line)
    except FrameError:
        return None
    words = body.decode("ascii", "replace").lstrip("#").split()
    if words[:1] != ["skin"]:
        return None
    words_by_name = dict(word.split("=", 1) for word in words[1:] if "=" in word)
    return Header(
        _whole(words_by_name.get("proto")) or 1,
        _whole(words_by_name.get("n")),
        _positive(words_by_name.get("rate")),
        words_by_name.get("unit"),
        _whole(words_by_name.get("bits")),
        words_by_name.get("id"),
    )


def _verified(line: bytes) -> tuple[bytes, Check]:
    body, star, tail = line.rpartition(b"*")
    if not star:
        return line, "none"
    # Compared as text, because int() accepts blanks, signs and underscores.
    if len(tail) == 4 and tail.upper() == b"%04X" % crc16(body):
        return body, "crc16"
    if len(tail) == 2 and tail.upper() == b"%02X" % xor8(body):
        return body, "xor"
    raise FrameError("checksum")


def _checked(text: str, check: Check) -> bytes:
    body = text.encode("ascii")
    tails = {"crc16": b"*%04X" % crc16(body), "xor": b"*%02X" % xor8(body), "none": b""}
    return body + tails[check] + b"\n"


def _split(body: bytes) -> list[bytes]:
    for separator in _SEPARATORS:
        if separator in body:
            return body.removesuffix(separator).split(separator)
    return body.split()


def _number(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _whole(word: str | None) -> int | None:
    return int(word) if word and word.isascii() and word.isdigit() and len(word) < 10 else None


def _positive(word: str | None) -> float | None:
    try:
        value = float(word or "")
    except ValueError:
        return None
    return value if isfinite(value) and value > 0 else None


Kind = Literal["u16", "i16", "f32"]

_MAGIC = 0xA5
_COMMENT = ord("#")
_HEAD = struct.Struct("<BBHIH")
_TAIL = struct.Struct("<H")
_NUMBER: dict[Kind, int] = {"u16": 1, "i16": 2, "f32": 3}
_TYPE: dict[int, np.dtype] = {1: np.dtype("<u2"), 2: np.dtype("<i2"), 3: np.dtype("<f4")}


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


def encode_frame(values: Sequence[float] | np.ndarray, seq: int, t_us: int, kind: Kind = "u16") -> bytes:
    """Return an encoded frame that ends with 0x00; seq is taken modulo 2**16, t_us modulo 2**32.

    Raises:
        ValueError: a value is out of range for the type.
    """
    number, numbers = _NUMBER[kind], np.asarray(values, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        packed = numbers.astype(_TYPE[number])
    if kind != "f32" and (packed != numbers).any():
        raise ValueError(f"{kind} cannot hold {numbers[packed != numbers][0]:g}")
    body = _HEAD.pack(_MAGIC, number, seq % 2**16, t_us % 2**32, len(numbers)) + packed.tobytes()
    return stuff(body + _TAIL.pack(crc16(body))) + b"\0"


def decode_frame(data: bytes) -> RawFrame:
    """Decode the bytes between two zeros.

    Raises:
        FrameError: ``structure`` (no COBS, too short, unknown type), ``checksum`` or ``fields``.
    """
    body = unstuff(data)
    if len(body) < _HEAD.size + _TAIL.size or body[0] != _MAGIC or body[1] not in _TYPE:
        raise FrameError("structure")
    if crc16(body[:-2]) != _TAIL.unpack(body[-2:])[0]:
        raise FrameError("checksum")
    _, number, seq, t_us, count = _HEAD.unpack_from(body)
    kind = _TYPE[number]
    if len(body) != _HEAD.size + count * kind.itemsize + _TAIL.size:
        raise FrameError("fields", (len(body) - _HEAD.size - _TAIL.size) // kind.itemsize)
    values = np.frombuffer(body, kind, count, _HEAD.size).astype(np.float64)
    return RawFrame(seq, t_us, values, bool(np.isfinite(values).all()))


def encode_comment(text: bytes) -> bytes:
    """Return a comment, such as ``# skin proto=1 n=25 bits=10``, encoded, with 0x00 at its end."""
    body = bytes((_MAGIC, _COMMENT)) + text
    return stuff(body + _TAIL.pack(crc16(body))) + b"\0"


def decode_comment(data: bytes) -> bytes | None:
    """Return the comment between two zeros; None if it is no comment, or a damaged one."""
    try:
        body = unstuff(data)
    except FrameError:
        return None
    sound = body[:2] == bytes((_MAGIC, _COMMENT)) and _TAIL.pack(crc16(body[:-2])) == body[-2:]
    return body[2:-2] if sound else None


def stuff(data: bytes) -> bytes:
    """Return ``data`` encoded with COBS: without zeros, each replaced by the distance to the next."""
    out = bytearray()
    blocks = data.split(b"\0")
    for place, block in enumerate(blocks):
        while len(block) >= 254:
            out += b"\xff" + block[:254]
            block = block[254:]
            if not block and place == len(blocks) - 1:
                return bytes(out)
        out.append(len(block) + 1)
        out += block
    return bytes(out)


def unstuff(data: bytes) -> bytes:
    """Return the data that :func:`stuff` encoded.

    Raises:
        FrameError: ``structure``: an invalid distance.
    """
    out, place, end = bytearray(), 0, len(data)
    while place < end:
        distance = data[place]
        following = place + distance
        if distance == 0 or following > end:
            raise FrameError("structure")
        out += data[place + 1 : following]
        if distance < 255 and following < end:
            out.append(0)
        place = following
    return bytes(out)


_KNOWN = ("number", "seq", "frames")


@dataclass(frozen=True)
class Announcement:
    """The labels and the window of the gesture that follows.

    Attributes:
        number: of the gesture, from 0.
        seq: number of the frame in which its window begins.
        frames: of the device in its window.
        labels: name -> 0 or 1.
    """

    number: int
    seq: int
    frames: int
    labels: Mapping[str, int] = field(default_factory=dict)


def encode_announcement(announcement: Announcement) -> bytes:
    """Return ``# gesture number=0 seq=300 frames=300 big=1 ...*HHHH``, LF at its end."""
    pairs = {name: getattr(announcement, name) for name in _KNOWN} | dict(announcement.labels)
    return _checked("# gesture " + " ".join(f"{name}={value}" for name, value in pairs.items()), "crc16")


def parse_announcement(line: bytes) -> Announcement | None:
    """Return the announcement in a line without its end; None for other lines and wrong checksums."""
    body, _, tail = line.removesuffix(b"\r").rpartition(b"*")
    if not body.startswith(b"# gesture ") or tail != b"%04X" % crc16(body):
        return None
    try:
        pairs = dict(word.split("=", 1) for word in body.decode("ascii").split()[2:])
        numbers = {name: int(value) for name, value in pairs.items()}
        number, seq, frames = (numbers.pop(name) for name in _KNOWN)
        return Announcement(number, seq, frames, numbers)
    except (KeyError, ValueError):
        return None


Format = Literal["auto", "text", "binary"]

_LINES, _FRAMES = 3, 2
_LINES_UNKNOWN = 8  # three lines of noise may count upwards by chance, eight hardly
_STEP = 1000  # frames that may be missing between two consecutive lines


_WRAPS = (2**16, 2**32)  # of seq: what firmware counts in
_ACROSS = 4096  # frames that may be missing where seq wraps


def frames_ahead(before: int, seq: int) -> int:
    """Return by how many frames ``seq`` is ahead of ``before``, u16 or u32 wrapped; 0 if it is not."""
    if seq > before:
        return seq - before
    for wrap in _WRAPS:
        if wrap - _ACROSS <= before < wrap and seq - before + wrap <= _ACROSS:
            return seq - before + wrap
    return 0


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

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame in a line, or the line where it is empty or a comment; else raise FrameError."""
        line = piece.removesuffix(b"\r")
        if not line or line.startswith(b"#"):
            return line
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


@dataclass(frozen=True)
class BinaryFormat:
    """COBS frames."""

    sensors: int
    name: ClassVar[str] = "binary"
    delimiter: ClassVar[bytes] = b"\0"
    check: ClassVar[Check] = "crc16"

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame between two zeros, or the text of a comment; else raise FrameError."""
        comment = decode_comment(piece) if piece else b""
        if comment is not None:
            return comment
        frame = decode_frame(piece)
        if len(frame.values) != self.sensors:
            raise FrameError("fields", len(frame.values))
        return frame


FrameFormat = TextFormat | BinaryFormat
"""A detected format: S ``sensors``, the ``delimiter`` at the end of a frame and the kind of its ``check``."""


def detect_format(
    data: bytes, sensors: int | None, format: Format
) -> tuple[FrameFormat | None, int | None, Header | None]:
    """Return the format of the first bytes of a connection; None if it is not known yet.

    Second, the number of values in readable frames that do not match the layout; or None. Third, the last
    header received.

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
                return BinaryFormat(count), None, None
            count_seen = count
    if format == "binary":
        return None, count_seen, None
    return _detect_text(data, sensors, count_seen)


def detection_error(data: bytes, count_seen: int | None, sensors: int | None) -> InputError:
    """Return the error for data in which no format was detected."""
    # The first piece may be half a line.
    run = [line for piece in data.split(b"\n")[1:-1] if (line := _parse_numbers(piece))]
    if _has_constant_time(run := [line for line in run if len(line.fields) > 2]):
        return stopped_clock_error(len(run), run[0].fields[1])
    if count_seen is not None and sensors is not None:
        return InputError(
            f"the device sends {count_seen} values per frame, the layout has {sensors} sensors: give its "
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


def _parse_numbers(line: bytes) -> Line | None:
    """Return a line if more than half of its fields are numbers; only such lines show a format."""
    try:
        read = parse_line(line.removesuffix(b"\r"))
    except FrameError:
        return None
    return read if 2 * sum(map(isfinite, read.fields)) > len(read.fields) else None


def _has_constant_time(run: Sequence[Line]) -> bool:
    """Return whether the first column counts while the next one, the time, is constant."""
    run = [line for line in run if len(line.fields) > 2]
    times = {line.fields[1] for line in run}
    if len(run) < _LINES_UNKNOWN or len(times) > 1 or not all(map(isfinite, times)):
        return False
    return _all_count([Line([line.fields[0], place, 0], line.check) for place, line in enumerate(run)])


def _detect_text(
    data: bytes, sensors: int | None, count_seen: int | None
) -> tuple[FrameFormat | None, int | None, Header | None]:
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
            return replace(frame_format, trailing=ends_with_separator(line)), None, header
        if len(run) >= _LINES:
            count_seen = len(read.fields) - 2 * _all_count(run[-_LINES:])
    return None, count_seen, header


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
