"""Announcements come back whole or not at all."""

import pytest

from skin.wire.decoder import Decoder
from skin.wire.protocol import Announcement, encode_announcement, encode_line, parse_announcement

SAID = Announcement(3, 650, 300, {"big": 1, "dynamic": 0})


def test_it_comes_back():
    assert parse_announcement(encode_announcement(SAID).rstrip(b"\n")) == SAID


@pytest.mark.parametrize("position", range(len(encode_announcement(SAID)) - 1))
def test_a_changed_byte_is_noticed(position):
    line = bytearray(encode_announcement(SAID).rstrip(b"\n"))
    line[position] ^= 1
    assert parse_announcement(bytes(line)) is None


@pytest.mark.parametrize("line", [b"", b"1,2,3", b"# skin proto=1 n=3", b"# gesture number=1*0000"])
def test_other_lines_are_none(line):
    assert parse_announcement(line) is None


def test_a_reader_takes_it_for_a_comment():
    decoder = Decoder(2)
    lines = [encode_line([1, number], number, 10_000 * number) for number in range(6)]
    frames = decoder.feed(b"".join([*lines[:3], encode_announcement(SAID), *lines[3:]]))
    assert len(frames) == 6
    assert not decoder.stats.bad
