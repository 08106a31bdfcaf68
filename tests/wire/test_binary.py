"""Binary frames, against published vectors and bytes written by hand."""

import struct

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.protocol import crc16, decode_frame, encode_frame, stuff, unstuff

RAMP = bytes(range(256))

# Wikipedia, "Consistent Overhead Byte Stuffing", encoding examples, without the closing zero.
VECTORS = [
    (b"\x00", b"\x01\x01"),
    (b"\x00\x00", b"\x01\x01\x01"),
    (b"\x00\x11\x00", b"\x01\x02\x11\x01"),
    (b"\x11\x22\x00\x33", b"\x03\x11\x22\x02\x33"),
    (b"\x11\x22\x33\x44", b"\x05\x11\x22\x33\x44"),
    (b"\x11\x00\x00\x00", b"\x02\x11\x01\x01\x01"),
    (RAMP[1:255], b"\xff" + RAMP[1:255]),
    (RAMP[:255], b"\x01\xff" + RAMP[1:255]),
    (RAMP[1:], b"\xff" + RAMP[1:255] + b"\x02\xff"),
    (RAMP[2:] + b"\x00", b"\xff" + RAMP[2:] + b"\x01\x01"),
    (RAMP[3:] + b"\x00\x01", b"\xfe" + RAMP[3:] + b"\x02\x01"),
]


@pytest.mark.parametrize(("plain", "stuffed"), VECTORS)
def test_stuffing_as_published(plain, stuffed):
    assert (stuff(plain), unstuff(stuffed)) == (stuffed, plain)


def test_a_frame_written_by_hand_is_read():
    body = struct.pack("<BBHIH3h", 0xA5, 2, 65535, 123456, 3, -1, 0, 300)
    assert decode_frame(stuff(body + struct.pack("<H", crc16(body)))).fields == [65535, 123456, -1, 0, 300]


@pytest.mark.parametrize(
    ("kind", "values"), [("u16", [0, 65535, 256]), ("i16", [-32768, 0, 32767]), ("f32", [0.5, -1e30, 0.0])]
)
def test_what_was_written_is_read(kind, values):
    frame = encode_frame(values, 65537, 2**32 + 5, kind)
    assert frame.count(0) == 1
    assert decode_frame(frame[:-1]).fields == [1, 5, *np.array(values, dtype="f4").tolist()]


@pytest.mark.parametrize(("kind", "value"), [("u16", -1), ("u16", 65536), ("i16", 40000), ("u16", 0.5)])
def test_a_value_that_does_not_fit_is_refused(kind, value):
    with pytest.raises(ValueError, match=f"{kind} cannot hold"):
        encode_frame([value], 0, 0, kind)


def packed(*head: int, tail: bytes = b"") -> bytes:
    body = struct.pack("<BBHIH", *head) + tail
    return stuff(body + struct.pack("<H", crc16(body)))


@pytest.mark.parametrize(
    ("piece", "reason"),
    [
        (b"\x05\x01", "structure"),
        (b"\x01", "structure"),
        (packed(0xA4, 1, 0, 0, 0), "structure"),
        (packed(0xA5, 4, 0, 0, 0), "structure"),
        (packed(0xA5, 1, 0, 0, 2, tail=b"\x01\x02"), "fields"),
        (packed(0xA5, 1, 0, 0, 1, tail=b"\x01\x02")[:-1] + b"\x77", "checksum"),
    ],
)
def test_what_is_no_frame_says_why(piece, reason):
    with pytest.raises(FrameError) as caught:
        decode_frame(piece)
    assert caught.value.reason == reason
