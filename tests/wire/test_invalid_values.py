"""Fields that say that a channel could not be read invalidate that channel alone."""

import math
import re

import numpy as np
import pytest

from skin.device.resampling import FrameError
from skin.wire.decoder import Decoder
from skin.wire.protocol import crc16, encode_frame
from skin.wire.skin import PortMonitor
from tests.wire.memory import opened, parse_line

WORDS = [
    *(b"nan", b"NaN", b"-nan", b"inf", b"-INF", b"1e400", b"-1e999", b"ovf", b"OVF", b"err", b"ERROR"),
    *(b"na", b"N/A", b"-", b"--", b"null", b"None", b"", b" "),
]
NUMBERS = np.random.default_rng(1).integers(0, 1024, (12, 4)).tolist()


def line(fields, check=False):
    body = b",".join(field if isinstance(field, bytes) else str(field).encode() for field in fields)
    return body + (b"*%04X" % crc16(body) if check else b"") + b"\n"


def decoded(*lines, sensors=4):
    decoder = Decoder(sensors)
    frames = decoder.feed(b"".join([*map(line, NUMBERS), *lines]))
    return decoder, frames[len(NUMBERS) - 1 :]


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("separator", [b",", b";"])
def test_a_word_for_no_value_is_no_number(word, separator):
    fields = parse_line(separator.join([b"1", word, b"3"])).fields
    assert math.isnan(fields[1])
    assert fields[::2] == [1, 3]


@pytest.mark.parametrize(
    "word", [b"x", b"hello", b"nano", b"0x10", b"1_0", b"---", b"1.2.3", b"ov f", b"A0: 1"]
)
def test_other_words_make_no_frame(word):
    with pytest.raises(FrameError, match="number"):
        parse_line(b"1," + word + b",3")


@pytest.mark.parametrize("word", WORDS)
def test_a_channel_without_a_number_keeps_its_last_value_and_is_invalid(word):
    decoder, frames = decoded(line([1, 2, word, 4]), line([5, 6, 7, 8]))
    assert [frame.values.tolist() for frame in frames] == [[1, 2, NUMBERS[-1][2], 4], [5, 6, 7, 8]]
    assert [frame.valid.tolist() for frame in frames] == [[True, True, False, True], [True] * 4]
    assert (decoder.stats.invalid, decoder.stats.bad.total()) == (1, 0)


def test_the_last_field_may_be_empty():
    decoder, frames = decoded(b"1,2,3,\n", b"1,2,3\n")
    assert [frame.valid.tolist() for frame in frames] == [[True, True, True, False]]
    assert decoder.stats.bad == {"fields": 1}


def test_a_separator_at_the_end_of_every_line_is_no_field():
    decoder = Decoder(4)
    decoder.feed(b"".join(line([*row, b""]) for row in NUMBERS) + b"1,2,3,\n")
    assert decoder.stats.bad == {"fields": 1}
    other = Decoder(5)
    other.feed(b"".join(line([*row, b""]) for row in NUMBERS * 30))
    assert "4 values per frame, the layout has 5 sensors" in str(other.error())


def test_a_line_of_words_alone_is_a_frame_without_a_valid_channel():
    _, frames = decoded(line([b"ovf", b"nan", b"", b"err"]))
    assert not frames[0].valid.any()
    assert frames[0].values.tolist() == NUMBERS[-1]


@pytest.mark.parametrize(
    "fields", [[b"nan", 20000], [20, b"nan"], [b"", 20000], [20, b"1e400"], [20, b"ovf"]]
)
def test_number_and_time_must_be_numbers(fields):
    decoder = Decoder(4)
    frames = decoder.feed(b"".join(line([n, 1000 * n, *NUMBERS[n]], check=True) for n in range(12)))
    assert len(frames) == 12
    assert decoder.feed(line([*fields, 1, 2, 3, 4], check=True)) == []
    assert decoder.stats.bad == {"number": 1}


def test_wordy_lines_show_no_format():
    decoder = Decoder()
    decoder.feed(b"error,none,nan,null\nna,-,err,--\n" * 40)
    assert decoder.frame_format is None
    decoder = Decoder(3)
    decoder.feed(b"no card: error\nsensor err none\n-,-,3\n" * 40)
    assert decoder.frame_format is None


@pytest.mark.parametrize("sensors", [4, None])
def test_a_channel_that_never_answers_does_not_hide_the_others(sensors):
    decoder = Decoder(sensors)
    frames = decoder.feed(b"".join(line([b"nan", *row[1:]]) for row in NUMBERS))
    assert decoder.sensors == 4
    assert all(frame.valid.tolist() == [False, True, True, True] for frame in frames)
    assert all(frame.values[0] == 0 for frame in frames)


def test_a_binary_value_that_is_no_number_invalidates_its_channel():
    decoder = Decoder()
    rows = [[1, 2, 3], [math.nan, 2, math.inf], [4, 5, 6]]
    frames = decoder.feed(b"".join(encode_frame(row, n, 100 * n, "f32") for n, row in enumerate(rows)))
    assert [frame.values.tolist() for frame in frames] == [[1, 2, 3], [1, 2, 3], [4, 5, 6]]
    assert frames[1].valid.tolist() == [False, True, False]


def test_frames_of_an_open_skin_have_the_channel_marked():
    data = b"".join(
        line([n, 1000 * n, 500 + n % 3, b"ovf" if n % 10 == 0 else 7 + (n % 4 == 1)]) for n in range(100)
    )
    with opened(data, layout=2) as skin:
        frames = skin.read(99, timeout=20)
        monitor = PortMonitor(skin)
        monitor._frames.extend(frames)
        rows = [row.split() for row in monitor.summary().splitlines()[-2:]]
    assert sum(not frame.valid[1] for frame in frames) == 9
    assert all(np.isfinite(frame.values).all() and frame.valid[0] for frame in frames)
    assert rows[0][1:4] == ["500", "501", "502"]
    assert rows[1][1:4] == ["7", "7", "8"]
    assert " ".join(rows[1][5:]) == "ok, invalid in 9%"


def test_a_channel_that_never_sends_a_number_is_not_ok():
    data = b"".join(line([n, 1000 * n, 500 + n % 3, b"nan"]) for n in range(100))
    with opened(data, layout=2) as skin:
        monitor = PortMonitor(skin)
        monitor._frames.extend(skin.read(99, timeout=20))
        rows = monitor.summary().splitlines()[-2:]
    assert rows[0].endswith("  ok")
    assert rows[1].endswith("  no value")


def test_a_clock_that_nothing_describes_is_not_ok():
    noise = np.random.default_rng(0).integers(0, 9, (100, 2))
    data = b"".join(line([9 * n + 5000, *noise[n], 700 + n // 40]) for n in range(100))
    with opened(data, layout=4) as skin:
        monitor = PortMonitor(skin)
        monitor._frames.extend(skin.read(99, timeout=20))
        rows = monitor.summary().splitlines()[-4:]
    assert "  a clock or counter, no sensor: skin listen adapter=auto" in rows[0]
    assert all(row.endswith("  ok") for row in rows[1:])


def test_channels_and_frames_that_fail_under_a_press_are_named():
    """A word in place of a value costs that value; letters in a line that has no other field, the line."""
    data = b""
    for number in range(1200):
        force = max(0, min(40, number % 500 - 440)) * 10
        first, second = 100 + number % 3 + force, 200 + number % 2 + force // 4
        word = b"OL" if first > 300 else b"%d" % first
        fields = [number, 5000 * number, word, second, 300 + number % 2]
        data += b"?\n" if first > 400 and number % 2 else line(fields)
    with opened(data, layout=3) as skin:
        frames = skin.read(data.count(b",300\n") + data.count(b",301\n") - 1, timeout=20)
        monitor = PortMonitor(skin)
        monitor._frames.extend(frames)
        summary = monitor.summary()
    assert re.search(
        r"\n +0 .*invalid in \d+%, more often in contact than at rest: beyond its range", summary
    )
    assert "frames are unreadable or lost in contact" in summary
    assert summary.count("in contact than at rest") == 2
