"""Valid and invalid frames of the wire protocol, encoded independently of the package."""

import struct
from random import Random
from typing import Literal

WireFormat = Literal["crc16", "xor", "none", "binary"]
FORMATS: tuple[WireFormat, ...] = ("crc16", "xor", "none", "binary")
"""Lines with one of three checksums, or binary frames."""

_INSERTED = (b"\n", b"\0", b"\r\n", b"*", b"#", b",")


def text_line(fields: list[bytes], separator: bytes, check: WireFormat) -> bytes:
    """Return a line of text without its line ending."""
    body = separator.join(fields)
    if check == "crc16":
        return body + b"*%04X" % _crc(body)
    if check == "none":
        return body
    combined = 0
    for byte in body:
        combined ^= byte
    return body + b"*%02X" % combined


def binary_frame(number: int, clock: int, values: list[float], kind: int) -> bytes:
    """Return a binary frame of kind 1 (u16), 2 (i16) or 3 (f32), byte-stuffed, with its delimiter."""
    return _stuffed(_sealed(_body(number, clock, values, kind)))


def invalid_frame(number: int, clock: int, values: list[float], kind: int, rng: Random) -> bytes:
    """Return an invalid frame with a correct CRC: of unknown kind, of another length, or with a value NaN."""
    body, trouble = bytearray(_body(number, clock, values, kind)), rng.randrange(5)
    if trouble == 0:
        body[0] = rng.choice((0, 0x5A, 0xFF))
    elif trouble == 1:
        body[1] = rng.choice((0, 4, 255))
    elif trouble == 2:
        body[8] ^= rng.choice((1, 2, 255))
    elif trouble == 3:
        body = bytearray(_body(number, clock, values[:-1], kind))
    else:
        body = bytearray(_body(number, clock, [float("nan"), *values[1:]], 3))
    return _stuffed(_sealed(bytes(body)))


def damage(piece: bytes, rng: Random) -> bytes:
    """Return a frame with up to five random errors of up to eight bytes."""
    data = bytearray(piece)
    for _ in range(rng.choice((1, 1, 2, 5))):
        first, run = rng.randrange(len(data)), rng.randint(1, 8)
        kind, last = rng.randrange(7), min(first + run, len(data))
        if kind <= 1:
            data[first] ^= 1 << rng.randrange(8)
        elif kind == 2:
            del data[first:last]
        elif kind == 3:
            data[first:first] = data[first:last]
        elif kind == 4:
            data[first:last] = rng.randbytes(last - first)
        elif kind == 5:
            data[first:first] = rng.choice(_INSERTED)
        else:
            del data[first:]
        data = data or bytearray(b"*")
    return bytes(data)


def _body(number: int, clock: int, values: list[float], kind: int) -> bytes:
    packed = f"{len(values)}{'Hhf'[kind - 1]}"
    given = values if kind == 3 else [int(value) for value in values]
    return struct.pack(f"<BBHIH{packed}", 0xA5, kind, number, clock, len(values), *given)


def _sealed(body: bytes) -> bytes:
    return body + _crc(body).to_bytes(2, "little")


def _stuffed(data: bytes) -> bytes:
    out, block = bytearray(), bytearray()
    for byte in data:
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block + b"\0")


def _remainder(register: int) -> int:
    for _ in range(8):
        register = register << 1 ^ (0x1021 if register & 0x8000 else 0)
    return register & 0xFFFF


_TABLE = [_remainder(byte << 8) for byte in range(256)]


def _crc(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE."""
    register = 0xFFFF
    for byte in data:
        register = (register << 8 & 0xFFFF) ^ _TABLE[register >> 8 ^ byte]
    return register
