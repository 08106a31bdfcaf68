"""Lines and binary frames, against published checksums and vectors, and bytes written by hand."""

import struct

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.protocol import (
    Header,
    crc16,
    decode_frame,
    encode_frame,
    encode_header,
    encode_line,
    parse_header,
    stuff,
    unstuff,
    xor8,
)
from tests.wire.memory import parse_line


def test_checksums_have_published_values():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE in the catalogue of parametrised CRCs
    assert xor8(b"GPGLL,5300.97914,N,00259.98174,E,125926,A") == 0x28  # NMEA 0183


def test_a_line_as_the_protocol_writes_it():
    body = b"7,70000,512,-3,1023"
    assert encode_line([512, -3, 1023], 7, 70000) == body + b"*%04X\n" % crc16(body)
    assert encode_line([1.5], 0, 0, "none") == b"0,0,1.5\n"


@pytest.mark.parametrize(
    "line",
    [
        b"1,2,3",
        b"1;2;3",
        b"1\t2\t3",
        b"1 2 3",
        b"1,2,3,",
        b" 1 , 2,3 ",
        b"1, 2, 3",
        b"1   2 3",
        b"1.0,2e0,+3",
    ],
)
def test_separators_and_numbers_that_people_use(line):
    assert parse_line(line).fields == [1, 2, 3]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        *((b"1,%s,3" % word, "number") for word in (b"x", b"nano", b"---", b"1.2.3", b"ov f", b"A0: 1")),
        (b"1,1_0,3", "number"),
        (b"1,0x10,3", "number"),
        (b"\xff\xfe1,2", "number"),
        (b"1,2\x00,3", "number"),
        (b"123456789*29B2", "checksum"),
        (b"123456789*29B", "checksum"),
        (b"123456789*", "checksum"),
        (b"123456789*+9B1", "checksum"),
        (b"123456789* 29B1", "checksum"),
        (b"12345678*29B1", "checksum"),
    ],
)
def test_what_is_no_line_says_why(line, reason):
    with pytest.raises(FrameError) as caught:
        parse_line(line)
    assert caught.value.reason == reason


def test_a_header_is_read_with_and_without_a_checksum():
    told = b"# skin proto=1 n=25 rate=100 unit=adc bits=10 id=arm-L"
    expected = Header(1, 25, 100.0, "adc", 10, "arm-L")
    assert parse_header(told) == expected
    assert parse_header(encode_header(expected)[:-1]) == expected
    assert parse_header(encode_header(expected)[:-1].replace(b"25", b"24")) is None
    assert parse_header(b"# booted in 3 ms") is None
    assert parse_header(b"# skin n=many rate=nan bits=-1") == Header()


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
