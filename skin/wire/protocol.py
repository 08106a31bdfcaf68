"""Our protocol: lines of text that a device sends, and announcements of an emulated skin.

One frame a line, ``seq,t_us,v0,...,vN-1*HHHH``. A line that starts with # is a comment. The header is
one, best with a checksum too: ``# skin proto=1 n=25 rate=100 unit=adc bits=10 id=arm-L``.

An emulated skin announces its next gesture in a comment that is JSON with a CRC-16,
``# {"number": 0, ...}*HHHH``.
"""

import binascii
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from math import inf, isclose, isfinite, nan
from operator import xor
from typing import Any, NamedTuple

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.touch.labels import CONTACT


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF; ``123456789`` gives 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def xor8(data: bytes) -> int:
    """Return all bytes combined by exclusive or, as NMEA 0183 does.

    Weak: 2.0 % of double bit flips, 5.8 % of double lost bytes and 4.8 % of glued lines pass.
    """
    return reduce(xor, data, 0)


SEPARATORS = (b",", b";", b"\t")
"""Between fields, instead of blanks."""

INVALID = frozenset(
    (b"", b"-", b"--", b"nan", b"inf", b"-inf", b"ovf", b"err", b"error", b"na", b"n/a", b"null", b"none")
)
"""Fields, in lower case, that firmware sends instead of a value that it could not read; also an empty one."""


OVER = frozenset(
    (b"ol", b"+ol", b"0l", b"o.l", b"o.l.", b"ovl", b"over", b"overrange", b"overload", b"sat", b"clip")
)
"""Fields, in lower case, for a value beyond the range of the converter, as meters show it."""

_MEASURED = 0.05  # part by which a rate that firmware measures may vary


class Line(NamedTuple):
    """The numbers of a line, and the kind of its checksum.

    Attributes:
        fields: NaN where a field is one of ``INVALID``, a number that is too large for a float, or strange;
            infinite where it is one of ``OVER``.
        check: kind of checksum.
        finite: whether every field is a number.
        strange: number of a field that is none of these -> the field.
    """

    fields: list[float]
    check: Check = "none"
    finite: bool = True
    strange: Mapping[int, bytes] = {}


EMULATED = "emulated"
"""How the id of an emulated device begins, and of no other: nobody is hurt by its scale."""


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
        speed: of the clock of a replay, relative to real time; None: 1.
    """

    proto: int = 1
    n: int | None = None
    rate: float | None = None
    unit: str | None = None
    bits: int | None = None
    id: str | None = None
    speed: float | None = None

    def changes(self, before: "Header") -> str:
        """Return what differs from an earlier header, as ``unit=adc -> N``; a rate may be a measured one."""
        words = []
        for name, value in vars(self).items():
            earlier = getattr(before, name)
            measured = name == "rate" and None not in (value, earlier)
            if not (isclose(value, earlier, rel_tol=_MEASURED) if measured else value == earlier):
                words.append(f"{name}={earlier} -> {value}")
        return ", ".join(words)

    def __str__(self) -> str:
        """Return what is known, as ``proto=1 n=25``."""
        settings = {name: value for name, value in vars(self).items() if value is not None}
        return " ".join(f"{name}={_number(value)}" for name, value in settings.items())


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
    return _checked(f"# skin {header}", check)


def parse_words(
    words: Sequence[bytes],
    check: Check = "none",
    invalid: Collection[bytes] = INVALID,
    over: Collection[bytes] = OVER,
) -> Line:
    """Return the numbers of fields.

    Args:
        words: the fields.
        check: kind of checksum of their line.
        invalid: fields, in lower case, that firmware sends instead of a value.
        over: those that it sends beyond the range of the converter.
    """
    try:
        fields = [nan] if b"_" in b"".join(words) else [float(word) for word in words]
    except ValueError:
        fields = [nan]
    finite, strange = all(map(isfinite, fields)), dict[int, bytes]()
    if not finite:
        fields = []
        for position, word in enumerate(words):
            text = word.strip().lower()
            try:
                value = float(text.replace(b"_", b"x"))  # valid in Python's grammar only
            except ValueError:
                value = inf if text in over else nan
                if text not in over and text not in invalid:
                    strange[position] = word.strip()
            else:
                value = value if isfinite(value) else nan
            fields.append(value)
    return Line(fields, check, finite, strange)


def split_words(body: bytes, marks: Sequence[bytes] = SEPARATORS, trailing: bool = True) -> list[bytes]:
    """Return the fields between the first of ``marks`` that a line has, or between blanks.

    Args:
        body: the line.
        marks: separators.
        trailing: a separator at the end is none; else it is followed by an empty field.
    """
    body = body.strip(b" \r")
    for mark in marks:
        if mark in body:
            return (body.removesuffix(mark) if trailing else body).split(mark)
    return body.split()


def parse_header(line: bytes) -> Header | None:
    """Return the header if this comment is one whose checksum, where it has one, is right; else None."""
    try:
        body, _ = verify_line(line)
    except FrameError:
        return None
    words = body.decode("ascii", "replace").lstrip("#").split()
    if words[:1] != ["skin"]:
        return None
    words_by_name = dict(word.split("=", 1) for word in words[1:] if "=" in word)
    return Header(
        _positive(words_by_name.get("proto"), int) or 1,
        _positive(words_by_name.get("n"), int),
        _positive(words_by_name.get("rate")),
        words_by_name.get("unit"),
        _positive(words_by_name.get("bits"), int),
        words_by_name.get("id"),
        _positive(words_by_name.get("speed")),
    )


def verify_line(line: bytes) -> tuple[bytes, Check]:
    """Return a line without its checksum, and the kind of it.

    Raises:
        FrameError: ``checksum`` is wrong or unknown.
    """
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


def _number(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _positive(word: str | None, kind: type[float] = float) -> Any:
    """Return a number above 0; None if the word is none."""
    try:
        value = kind(word or "")
    except ValueError:
        return None
    return value if 0 < value < 1e9 else None


class RawFrame(NamedTuple):
    """Content of one frame.

    Attributes:
        seq: number of the frame, or None.
        ticks: the device's clock, in its unit, or None.
        values: (S,); NaN or infinite where the device sent no number.
        finite: whether all values are numbers.
    """

    seq: int | None
    ticks: float | None
    values: np.ndarray
    finite: bool = True


MOST_CONTACTS = 100
"""Contacts at a time that an announcement or a session may have."""


@dataclass(frozen=True)
class Announcement:
    """The labels, the window and the contacts of the gesture that follows.

    Attributes:
        number: of the gesture, from 0.
        seq: number of the frame in which its window begins.
        frames: of the device in its window.
        labels: name -> 0 or 1.
        rate: of the model, Hz; 0: unknown.
        contacts: (T, K, 5) at that rate, as of :class:`skin.device.touches.Touches`; None if unknown.
    """

    number: int
    seq: int
    frames: int
    labels: Mapping[str, int] = field(default_factory=dict)
    rate: float = 0.0
    contacts: np.ndarray | None = None


def encode_announcement(announcement: Announcement) -> bytes:
    """Return ``# {"number": 0, "seq": 300, ..., "contacts": [[[x, y, radius, force, pressure]]]}*HHHH``.

    In SI units; null where there is no contact.
    """
    contacts = announcement.contacts
    known = None if contacts is None else np.where(np.isnan(contacts), np.array(None), contacts).tolist()
    return _checked(f"# {json.dumps(vars(announcement) | {'contacts': known})}", "crc16")


def parse_announcement(line: bytes) -> Announcement | None:
    """Return the announcement in a line without its end; None for other lines and wrong checksums."""
    body, _, tail = line.removesuffix(b"\r").rpartition(b"*")
    if not body.startswith(b"# {") or tail != b"%04X" % crc16(body):
        return None
    try:
        announcement = Announcement(**json.loads(body[2:]))
        described: Any = announcement.contacts
        if described is None:
            return announcement
        contacts = np.array(described, dtype=float).reshape(len(described), -1, len(CONTACT))
    except (TypeError, ValueError):
        return None
    fits = contacts.shape[1] <= MOST_CONTACTS and not np.isinf(contacts).any()
    return replace(announcement, contacts=contacts) if fits else None


_WRAPS = (2**16, 2**32)  # of seq: what firmware counts in
_ACROSS = 4096  # frames that may be missing where seq wraps


def frames_ahead(before: int, seq: int, modulus: int | None = None) -> int:
    """Return by how many frames ``seq`` is ahead, wrapped at u16, u32 or ``modulus``; 0 if it is not."""
    if seq > before:
        return seq - before
    if modulus is not None:
        ahead = seq - before + modulus
        return ahead if 0 < ahead <= max(1, modulus // 2) else 0
    near = (wrap for wrap in _WRAPS if wrap - _ACROSS <= before < wrap and seq - before + wrap <= _ACROSS)
    return next((seq - before + wrap for wrap in near), 0)
