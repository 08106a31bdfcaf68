"""Whatever the wire says: no exception, and every good frame after the next delimiter is recovered."""

import os
from random import Random

import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.benchmarks import measure_decoder
from skin.wire.decoder import Decoder
from skin.wire.protocol import crc16, encode_line, xor8
from tests.damage import DAMAGED_FILES

quickly = settings(DAMAGED_FILES, max_examples=60)
CHUNKS = int(os.environ.get("FUZZ_CHUNKS", 5000))
_SOUP = b"0123456789,.;-+eE* #\t\r\nnaif_x"
_NO_NUMBERS = (b"nan", b"-inf", b"1e400", b"1_0", b"0x1F", b"--1", b"1.2.3", b"\xd9\xa3", b"1 2", b"")
_INSERTED = (b"\n", b"\0", b"\r\n", b"*", b"#", b",")


def sent_values(number, sensors):
    """Return the values of a frame by its number: unsigned or signed integers, or fractions."""
    kind = number % 3
    whole = [(number * (7 + channel) + 31 * channel) % 1024 - 100 * (kind == 1) for channel in range(sensors)]
    return [value / 8 for value in whole] if kind == 2 else whole


def encoded(number, spoken, sensors):
    """Return a frame: a line with one of three checksums."""
    return encode_line(sent_values(number, sensors), number, 2000 * number, spoken)


def invalid(number, spoken, sensors, rng):
    """Return a frame whose checksum is right and whose content is not: none of it may be read as a value."""
    trouble = rng.randrange(5)
    fields = encoded(number, "none", sensors).rstrip().split(b",")
    if trouble == 0:
        fields[rng.randrange(len(fields) - 1)] = rng.choice(_NO_NUMBERS)
    elif trouble == 1:
        fields.append(b"5")
    elif trouble == 2:
        fields.pop()
    elif trouble == 3:
        fields[0] = rng.choice((b"-1", b"0.5"))
    body = b",".join(fields)
    tails = {"crc16": b"*%04X" % crc16(body), "xor": b"*%02X" % xor8(body), "none": b""}
    others = [tail for check, tail in tails.items() if check != spoken]
    return body + (rng.choice(others) if trouble == 4 else tails[spoken]) + b"\n"


def noise(rng, sensors):
    """Return bytes at random, text at random, a header or, now and then, a line that never ends."""
    kind, length = rng.random(), rng.choice((1, 10, 100, 400))
    if kind < 0.001:
        data = b"7" * 70_000
    elif kind < 0.5:
        data = rng.randbytes(length)
    elif kind < 0.6:
        data = b"# skin proto=1 n=%d rate=50 unit=adc bits=99\n" % sensors
    else:
        data = bytes(rng.choices(_SOUP, k=length))
    return data + (b"\n" if rng.random() < 0.7 else b"")


def damage(piece, rng):
    """Return a frame with up to five random errors of up to eight bytes."""
    for _ in range(rng.choice((1, 1, 2, 5))):
        first = rng.randrange(len(piece))
        last = min(first + rng.randint(1, 8), len(piece))
        before, part, after = piece[:first], piece[first:last], piece[last:]
        flipped = bytes([part[0] ^ 1 << rng.randrange(8)]) + part[1:]
        changes = (flipped, flipped, b"", part + part, rng.randbytes(len(part)), rng.choice(_INSERTED) + part)
        change = rng.randrange(7)
        piece = (before if change == 6 else before + changes[change] + after) or b"*"
    return piece


def fuzz(count, spoken, sensors, seed):
    """Feed a decoder with ``count`` frames, damaged and invalid ones, and noise, in chunks of any size.

    Returns:
        ``good``: numbers of the frames sent intact behind a delimiter; ``missed``: those not recovered;
        ``wrong``: number of frames decoded with wrong values.
    """
    rng = Random(f"{spoken} {sensors} {seed}")
    data, good, kinds = bytearray(), set(), ("good", "damaged", "invalid", "noise")
    for number in range(count):
        # Ten good frames at the beginning, so that the format shows; of them the first may be half a line.
        kind = rng.choices(kinds, (60, 20, 10, 10))[0] if number >= 10 else "good"
        intact = encoded(number, spoken, sensors)
        if kind == "good" and data[-1:] in (b"", b"\n") and (number or spoken == "crc16"):
            good.add(number)
        if kind == "damaged":
            intact = damage(intact, rng)
        elif kind == "invalid":
            intact = invalid(number, spoken, sensors, rng)
        elif kind == "noise":
            intact = noise(rng, sensors)
        data += intact
    decoder, position, recovered, wrong = Decoder(sensors), 0, set(), 0
    while position < len(data):
        following = position + rng.randint(0, rng.choice((0, 1, 3, 20, 130, 500, 3000)))
        for found in decoder.feed(bytes(data[position:following]), 0.002 * count * position / len(data)):
            # A value that is sent as a word for none may only be invalid.
            bad = found.seq is None or (found.values != sent_values(found.seq, sensors))[found.valid].any()
            wrong += bad
            recovered |= set() if bad else {found.seq}
        position = following
    return {"good": good, "missed": good - recovered, "wrong": wrong}


@given(noise=st.binary(max_size=400))
@quickly
def test_noise_before_the_format_is_known_costs_no_frame(noise):
    lines = (encode_line([7, number, 1023], number, 1000 * number) for number in range(4))
    frames = Decoder(3).feed(noise + b"\n" + b"".join(lines))
    assert [frame.seq for frame in frames][-4:] == [0, 1, 2, 3]


@given(
    values=st.lists(st.floats(-(2**126), 2**126, width=32), min_size=1, max_size=40),
    seq=st.integers(3, 2**32),
)
@quickly
def test_lines_survive_the_way_there_and_back(values, seq):
    lines = (encode_line(values, number, 0) for number in range(seq - 3, seq))
    *_, frame = Decoder(len(values)).feed(b"".join(lines))
    assert frame.seq == seq - 1
    assert frame.values.astype("f4").tolist() == values


@pytest.mark.slow("streams for long")
def test_every_intact_frame_of_a_faulty_wire_arrives_and_no_wrong_value():
    """One line of a hundred is spoilt; SOAK_SECONDS=600 takes ten minutes of a stream at 500 Hz."""
    seconds, check = float(os.environ.get("SOAK_SECONDS", 5)), os.environ.get("SOAK_CHECK", "crc16")
    rng, decoder, wrong, sent, came, memory = Random(1), Decoder(25), 0, set(), set(), []
    for number in range(round(500 * seconds)):
        line, spoilt = encoded(number, check, 25), number > 10 and rng.random() < 0.01
        sent |= set() if spoilt or number == 0 else {number}
        line = damage(line[:-1], rng) + b"\n" if spoilt else line
        for frame in decoder.feed(line, number / 500):
            right = frame.values.tolist() == sent_values(frame.seq or 0, 25)
            wrong += not right
            came |= {frame.seq} if right else set()
        if number in (round(50 * seconds), round(500 * seconds) - 1):
            memory.append(psutil.Process().memory_info().rss)
    print(len(sent), "intact,", len(sent - came), "missed,", wrong, "wrong,", decoder.stats)
    assert decoder.stats.bad_frames > 5
    assert memory[1] - memory[0] < 5e6 + 200 * len(sent)  # the numbers kept here
    if check == "crc16":  # a weaker checksum passes wrong values, some of them as numbers of frames
        assert (sent - came, wrong, decoder.stats.resets) == (set(), 0, 0)


@pytest.mark.slow("measures the processor time of the decoder")
def test_decoding_takes_less_than_a_twentieth_of_a_core():
    assert measure_decoder(1)["decode_core_share"] < 0.05


@pytest.mark.parametrize("spoken", ["crc16", "xor", "none"])
def test_every_good_frame_of_a_long_bad_stream_is_recovered(spoken):
    found = fuzz(CHUNKS, spoken, 25, 0)
    assert not found["missed"]
    assert len(found["good"]) > 0.4 * CHUNKS
    if spoken == "crc16":
        assert found["wrong"] <= CHUNKS // 10_000  # 16 bits fit by chance once in 65,536


@pytest.mark.parametrize("spoken", ["crc16", "xor", "none"])
@given(seed=st.integers(0, 2**32), sensors=st.integers(1, 70))
@settings(quickly, max_examples=15)
def test_every_good_frame_of_any_bad_stream_is_recovered(spoken, seed, sensors):
    assert not fuzz(60, spoken, sensors, seed)["missed"]
