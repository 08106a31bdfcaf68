"""Lines of our protocol, against published checksums and bytes written by hand."""

import pytest

from skin.device.resampling import FrameError
from skin.wire.protocol import Header, crc16, encode_header, encode_line, parse_header, xor8
from tests.wire.memory import parse_line


def test_checksums_have_published_values():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE in the catalogue of parametrised CRCs
    assert xor8(b"GPGLL,5300.97914,N,00259.98174,E,125926,A") == 0x28  # NMEA 0183


def test_a_line_as_the_protocol_writes_it():
    body = b"7,70000,512,-3,1023"
    assert encode_line([512, -3, 1023], 7, 70000) == body + b"*%04X\n" % crc16(body)
    assert encode_line([1.5], 0, 0, "none") == b"0,0,1.5\n"


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
