"""Lines and frames: formats found, counts kept, wires that are set wrongly, fields without a number."""

from dataclasses import replace

import numpy as np
import pytest

from skin.wire.decoder import Decoder
from skin.wire.protocol import Header, crc16, encode_header, encode_line, parse_header, xor8
from skin.wire.skin import PortMonitor
from tests.wire.memory import opened

NOISE = np.random.default_rng(1).integers(0, 1024, (12, 4)).tolist()
HEADER = Header(n=4, rate=100.0, unit="adc", bits=10, id="arm-L")
STRANGE = b"1.2.3", b"1_0", b"0x10", b"---", b"ov f", b"A0: 1", b"\xff\xfe1", b"2\x00"
CRC = b"%04X" % crc16(b"3,3000,1,2,3,4")
SPOILT = CRC[:3], b" " + CRC, b"+" + CRC
WORDS = (b"OL", b"-nan", b"-INF", b"1e400", b"-1e999", b"OVF", b"err", b"N/A", b"--", b"null", b"", b" ")


def lines(count, sensors=4, first=0, check="crc16"):
    values = range(0, 100 * sensors, 100)
    numbers = range(first, first + count)
    return [encode_line([value + n for value in values], n, 1000 * n, check) for n in numbers]


def bare(rows, separator=","):
    return "".join(separator.join(map(str, row)) + "\n" for row in rows).encode()


def numbers(frames):
    return [frame.seq for frame in frames]


def test_checksums_have_published_values():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/CCITT-FALSE in the catalogue of parametrised CRCs
    assert xor8(b"GPGLL,5300.97914,N,00259.98174,E,125926,A") == 0x28  # NMEA 0183


def test_a_line_as_the_protocol_writes_it():
    body = b"7,70000,512,-3,1023"
    assert encode_line([512, -3, 1023], 7, 70000) == body + b"*%04X\n" % crc16(body)
    assert encode_line([1.5], 0, 0, "none") == b"0,0,1.5\n"


def test_a_header_is_read_with_and_without_a_checksum():
    told = b"# skin proto=1 n=25 rate=100 unit=adc bits=10 id=arm-L"
    expected = Header(1, 25, 100.0, "adc", 10, "arm-L")
    assert parse_header(told) == expected
    assert parse_header(encode_header(expected)[:-1]) == expected
    assert parse_header(encode_header(expected)[:-1].replace(b"25", b"24")) is None
    assert parse_header(b"# booted in 3 ms") is None
    assert parse_header(b"# skin n=many rate=nan bits=-1") == Header()


@pytest.mark.parametrize("check", ["crc16", "xor", "none"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("sensors", [4, None])
def test_lines_are_recognised(check, end, sensors):
    decoder = Decoder(sensors)
    frames = decoder.feed(b"".join(lines(12, check=check)).replace(b"\n", end))
    # Without a CRC the first line may be half a line.
    assert numbers(frames) == list(range(check != "crc16", 12))
    assert frames[-1].values.tolist() == [11, 111, 211, 311]
    assert (frames[-1].t, frames[-1].valid.all()) == (0.011, True)
    assert decoder.frame_format.check == check


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", "])
@pytest.mark.parametrize("sensors", [4, None])
def test_bare_values_are_recognised(separator, sensors):
    frames = Decoder(sensors).feed(bare(NOISE, separator), now=5.0)
    assert [frame.values.tolist() for frame in frames] == NOISE[1:]
    assert (frames[0].seq, frames[0].t, frames[0].t_host) == (None, 5.0, 5.0)


def test_a_clock_with_a_sign_goes_on_below_0():
    signed = (2**31 - 28_500 + 1000 * np.arange(40)).astype(np.uint32).astype(np.int32)
    frames = Decoder(4).feed(b"".join(b"%d,%d,1,2,3,4\n" % row for row in enumerate(signed)))
    assert np.diff([frame.t for frame in frames]) == pytest.approx([0.001] * 38)


def test_a_header_tells_the_number_of_sensors_at_the_third_line():
    header = Header(n=4, bits=10)
    decoder = Decoder()
    assert numbers(decoder.feed(encode_header(header) + b"".join(lines(3)))) == [0, 1, 2]
    assert (decoder.sensors, decoder.header) == (4, header)


def test_a_layout_of_n_plus_two_sensors_takes_lines_that_count_for_values():
    frames = Decoder(6).feed(b"".join(lines(4)))
    assert [len(frame.values) for frame in frames] == [6] * 4
    assert frames[0].seq is None


def test_another_number_of_sensors_is_refused_with_both_counts():
    decoder = Decoder(25)
    for number in range(100):
        assert decoder.feed(encode_line([number % 7] * 16, number, number * 10)) == []
    assert "16 values per frame, the layout has 25 sensors" in str(decoder.error())
    assert "layout.path" in str(decoder.error())


def test_a_wrong_baud_rate_is_refused_with_64_bytes_in_hex():
    decoder, noise = Decoder(25), np.random.default_rng(0).bytes(5000)
    for start in range(0, 4000, 100):
        decoder.feed(noise[start : start + 100])
        assert decoder.error() is None
    decoder.feed(noise[4000:])
    assert noise[:64].hex(" ") in str(decoder.error())
    assert "device.baudrate" in str(decoder.error())


def test_two_seconds_of_receiving_are_enough_but_a_slow_start_is_none(decoder):
    decoder.feed(b"ets Jun  8 2016 00:22:57\nrst:0x1\n", now=0.0)
    decoder.feed(b"wifi\n", now=6.0)  # seconds of silence while the board starts
    assert decoder.error() is None
    for step in range(12):
        decoder.feed(b"hello\n", now=6.2 + 0.2 * step)
    assert "no frame in" in str(decoder.error())
    assert numbers(decoder.feed(b"".join(lines(3)), now=9)) == [0, 1, 2]
    assert decoder.error() is None


@pytest.mark.parametrize(
    ("spoilt", "reason"),
    [
        *((b"3,3000,%s\n" % values, "fields") for values in (b"1,2,3", b"1,2,3,4,5")),
        *((b"%s,3000,1,2,3,4\n" % number, "number") for number in (b"", b"nan", b"-3", b"3.5", b"3_0")),
        *((b"3,%s,1,2,3,4\n" % clock, "number") for clock in (b"x", b"nan", b"1e400", b"ovf")),
        *((b"3,3000,1,%s,3,4\n" % value, "number") for value in STRANGE),
        (b"3,3000,x,y,z,4\n", "number"),
        *((b"3,3000,1,2,3,4*%s\n" % check, "checksum") for check in (b"0000", b"", *SPOILT)),
        (b"3" * 70000 + b"\n", "long"),
    ],
)
def test_a_bad_line_is_dropped_and_the_next_one_taken(decoder, spoilt, reason):
    data = [*lines(3, check="none"), spoilt, *lines(3, first=4, check="none")]
    frames = [frame for piece in data for frame in decoder.feed(piece)]
    assert numbers(frames) == [1, 2, 4, 5, 6]
    assert (frames[2].after, frames[2].lost) == ("gap", 1)
    counters = decoder.stats
    assert (counters.bad, counters.lost) == ({reason: 1}, 1)


def test_a_weaker_checksum_than_the_first_lines_had_is_refused(decoder):
    weaker = lines(1, first=3, check="none") + lines(1, first=4, check="xor")
    frames = decoder.feed(b"".join(lines(3) + weaker))
    assert (numbers(frames), decoder.stats.bad) == ([0, 1, 2], {"checksum": 2})


def test_memory_stays_small_without_any_delimiter(decoder):
    decoder.feed(b"".join(lines(3)))
    for _ in range(100):
        decoder.feed(b"5" * 10_000)
        assert len(decoder._buffer) <= 65536 + 10_000
    assert numbers(decoder.feed(b"\n" + lines(1, first=3)[0])) == [3]
    assert decoder.stats.bad == {"long": 1}


def test_more_than_half_bad_over_two_seconds_is_trouble_until_it_is_not():
    decoder, good = Decoder(4), lines(400)
    decoder.feed(b"".join(good[:3]), now=0.0)
    for step in range(21):
        decoder.feed(b"\xf3\x81\n\x99\n" + good[3 + step], now=0.1 * (1 + step))
    assert "wrong baud rate or format?" in decoder.stats.trouble
    for step in range(21):
        decoder.feed(good[24 + step], now=2.2 + 0.1 * step)
    assert decoder.stats.trouble == ""


def test_a_device_that_sends_another_number_of_values_later_is_told_with_it(decoder):
    decoder.feed(b"".join(lines(3)), now=0.0)
    for step in range(25):
        assert decoder.feed(lines(1, sensors=3, first=3 + step)[0], now=0.1 * step) == []
    assert "sends 3 values per frame now" in decoder.stats.trouble


def test_after_a_restart_the_number_of_sensors_is_demanded_again():
    decoder = Decoder()
    decoder.feed(b"".join(lines(8)))
    decoder.restart()
    frames = decoder.feed(b"23,4\n" + b"".join(lines(4)))
    assert [(frame.after, frame.segment) for frame in frames] == [("reconnect", 1)] + [("", 1)] * 3
    decoder.restart()
    for number in range(0, 400, 40):
        decoder.feed(b"".join(lines(40, sensors=3, first=number)))
    assert "3 values per frame, the layout has 4" in str(decoder.error())


def test_frames_after_a_reconnection_count_only_once_the_same_header_came():
    def send(first):
        return decoder.feed(b"".join(lines(20, first=first)))

    decoder = Decoder(4)
    decoder.feed(encode_header(HEADER))
    assert len(send(0)) == 20
    decoder.restart()
    assert send(0) == send(20) == []
    assert decoder.stats.trouble == "the device has not sent its header since it was connected again"
    decoder.feed(encode_header(replace(HEADER, id="arm-R")))
    assert send(40) == []
    assert decoder.stats.trouble.endswith("another device is connected: id=arm-L -> arm-R")
    assert decoder.header == HEADER
    decoder.feed(encode_header(replace(HEADER, rate=99.7)))
    frames = send(60)
    first, second = ((frame.seq, frame.segment, frame.after, frame.lost) for frame in frames[:2])
    assert (first, second) == ((60, 1, "reconnect", 0), (61, 1, "", 0))
    assert (decoder.stats.trouble, decoder.stats.frames, decoder.stats.bad_frames) == ("", 40, 0)


def test_a_damaged_header_without_a_checksum_does_not_lock_the_device_out(decoder):
    for header in (HEADER, replace(HEADER, id="arm-M")):
        decoder.feed(encode_header(header, "none") + b"".join(lines(10)))
    decoder.restart()
    assert len(decoder.feed(encode_header(HEADER, "none") + b"".join(lines(10)))) == 10


def line(fields):
    return b",".join(field if isinstance(field, bytes) else str(field).encode() for field in fields) + b"\n"


def decoded(*lines, sensors=4):
    decoder = Decoder(sensors)
    frames = decoder.feed(b"".join([*map(line, NOISE), *lines]))
    return decoder, frames[len(NOISE) - 1 :]


@pytest.mark.parametrize("word", WORDS)
def test_a_channel_without_a_number_keeps_its_last_value_and_is_invalid(word):
    decoder, frames = decoded(line([1, 2, word, 4]), line([5, 6, 7, 8]), line([word] * 4))
    before = NOISE[-1][2]
    assert [frame.values.tolist() for frame in frames] == [[1, 2, before, 4], [5, 6, 7, 8], [5, 6, 7, 8]]
    assert [frame.valid.tolist() for frame in frames] == [[True, True, False, True], [True] * 4, [False] * 4]
    assert (decoder.stats.invalid, decoder.stats.bad.total()) == (5, 0)


def test_a_separator_at_the_end_is_an_empty_field_unless_every_line_has_one():
    decoder, frames = decoded(b"1,2,3,\n", b"1,2,3\n")
    assert [frame.valid.tolist() for frame in frames] == [[True, True, True, False]]
    assert decoder.stats.bad == {"fields": 1}
    decoder = Decoder(4)
    decoder.feed(b"".join(line([*row, b""]) for row in NOISE) + b"1,2,3,\n")
    assert decoder.stats.bad == {"fields": 1}


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
    frames = decoder.feed(b"".join(line([b"nan", *row[1:]]) for row in NOISE))
    assert decoder.sensors == 4
    assert all(frame.valid.tolist() == [False, True, True, True] for frame in frames)
    assert all(frame.values[0] == 0 for frame in frames)


def summary(data, sensors):
    with opened(data, layout=sensors) as skin:
        frames = skin.read(len(Decoder(sensors).feed(data)), timeout=20)
        monitor = PortMonitor(skin)
        monitor._frames.extend(frames)
        return frames, monitor.summary().splitlines()


def test_frames_of_an_open_skin_have_the_channel_marked():
    words = (b"ovf" if n % 10 == 0 else 7 + (n % 4 == 1) for n in range(100))
    rows = ([n, 1000 * n, 500 + n % 3, word, b"nan"] for n, word in enumerate(words))
    frames, said = summary(b"".join(map(line, rows)), 3)
    assert sum(not frame.valid[1] for frame in frames) == 9
    assert all(np.isfinite(frame.values).all() and frame.valid[0] for frame in frames)
    first, second, third = (row.split() for row in said[-3:])
    assert (first[1:4], first[5:]) == (["500", "501", "502"], ["ok"])
    assert (second[1:4], " ".join(second[5:])) == (["7", "7", "8"], "ok, invalid in 9%")
    assert third[-2:] == ["no", "value"]


def test_a_clock_that_nothing_describes_is_not_ok():
    noise = np.random.default_rng(0).integers(0, 9, (100, 2))
    _, said = summary(b"".join(line([9 * n + 5000, *noise[n], 700 + n // 40]) for n in range(100)), 4)
    assert "  a clock or counter, no sensor: skin listen adapter=auto" in said[-4]
    assert all(row.endswith("  ok") for row in said[-3:])
