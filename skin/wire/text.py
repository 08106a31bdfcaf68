"""The text protocol: one frame a line, ``seq,t_us,v0,...,vN-1*HHHH``.

A line that starts with # is a comment. The header is one, best with a checksum too:
``# skin proto=1 n=25 rate=100 unit=adc bits=10 id=arm-L``.
"""

import binascii
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from math import isfinite, nan
from operator import xor
from typing import NamedTuple

from skin.signal.frame import Check, FrameError


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
    known = {name: value for name, value in vars(header).items() if value is not None}
    words = " ".join(f"{name}={_number(value)}" for name, value in known.items())
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
