"""The binary protocol: COBS with 0x00 between frames, little-endian.

A frame: u8 0xA5, u8 type (1 u16, 2 i16, 3 f32), u16 seq, u32 t_us, u16 n, n values, u16 CRC-16/CCITT-FALSE of
all before it. A comment, such as the header: u8 0xA5, u8 type 35 (``#``), a comment line of the text protocol
without its checksum, u16 CRC. COBS: Cheshire and Baker, "Consistent overhead byte stuffing", IEEE/ACM ToN 7
(1999).
"""

import struct
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from skin.signal.frame import FrameError
from skin.wire.text import crc16

Kind = Literal["u16", "i16", "f32"]

_MAGIC = 0xA5
_COMMENT = ord("#")
_HEAD = struct.Struct("<BBHIH")
_TAIL = struct.Struct("<H")
_NUMBER: dict[Kind, int] = {"u16": 1, "i16": 2, "f32": 3}
_TYPE: dict[int, np.dtype] = {1: np.dtype("<u2"), 2: np.dtype("<i2"), 3: np.dtype("<f4")}


class Payload(NamedTuple):
    """Content of a binary frame: its number, the device's clock (microseconds) and the values, (S,).

    Values of type f32 may be NaN or infinite.
    """

    seq: int
    t_us: int
    values: np.ndarray


def encode_frame(values: Sequence[float] | np.ndarray, seq: int, t_us: int, kind: Kind = "u16") -> bytes:
    """Return an encoded frame that ends with 0x00; seq is taken modulo 2**16, t_us modulo 2**32.

    Raises:
        ValueError: a value is out of range for the type.
    """
    number, given = _NUMBER[kind], np.asarray(values, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        packed = given.astype(_TYPE[number])
    if kind != "f32" and (packed != given).any():
        raise ValueError(f"{kind} cannot hold {given[packed != given][0]:g}")
    body = _HEAD.pack(_MAGIC, number, seq % 2**16, t_us % 2**32, len(given)) + packed.tobytes()
    return stuff(body + _TAIL.pack(crc16(body))) + b"\0"


def decode_frame(data: bytes) -> Payload:
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
    return Payload(seq, t_us, np.frombuffer(body, kind, count, _HEAD.size).astype(np.float64))


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
