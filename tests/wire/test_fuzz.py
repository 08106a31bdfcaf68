"""Whatever the wire says: no exception, and every good frame after the next delimiter is recovered."""

import os
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_frame, encode_line
from tests.wire import bad_stream, independent_frames
from tests.wire.memory import parse_line

quickly = settings(
    max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
CHUNKS = int(os.environ.get("FUZZ_CHUNKS", 5000))  # 0.2 s; a million takes 40
ENCODERS = {"text": (encode_line, b"\n"), "binary": (encode_frame, b"\0")}


def good(spoken, first, count):
    encode, _ = ENCODERS[spoken]
    return [encode([7, number % 1000, 1023], number, 1000 * number) for number in range(first, first + count)]


def cut(data, cuts):
    positions = sorted({0, len(data), *(position % (len(data) + 1) for position in cuts)})
    return [data[first:last] for first, last in pairwise(positions)]


@given(pieces=st.lists(st.binary(max_size=300), max_size=12), sensors=st.sampled_from([None, 1, 3]))
@quickly
def test_nothing_raises(pieces, sensors):
    decoder = Decoder(sensors)
    for now, piece in enumerate(pieces):
        for frame in decoder.feed(piece, float(now)):
            assert np.isfinite(frame.values).all()
    decoder.error()


@pytest.mark.parametrize("spoken", ["text", "binary"])
@given(noise=st.binary(max_size=400), cuts=st.lists(st.integers(0, 10**6), max_size=8))
@quickly
def test_frames_after_noise_are_recovered(spoken, noise, cuts):
    decoder = Decoder(3)
    decoder.feed(b"".join(good(spoken, 0, 3)))
    data = noise + ENCODERS[spoken][1] + b"".join(good(spoken, 3, 5))
    frames = [frame for piece in cut(data, cuts) for frame in decoder.feed(piece)]
    assert [frame.seq for frame in frames][-5:] == [3, 4, 5, 6, 7]


@pytest.mark.parametrize("spoken", ["text", "binary"])
@given(noise=st.binary(max_size=400))
@quickly
def test_noise_before_the_format_is_known_costs_no_frame(spoken, noise):
    frames = Decoder(3).feed(noise + ENCODERS[spoken][1] + b"".join(good(spoken, 0, 4)))
    assert [frame.seq for frame in frames][-4:] == [0, 1, 2, 3]


@given(values=st.lists(st.floats(allow_nan=False, width=32), max_size=40), seq=st.integers(0, 2**32 - 1))
@quickly
def test_lines_survive_the_way_there_and_back(values, seq):
    line = encode_line([value for value in values if abs(value) < 1e38], seq, 0)
    fields = parse_line(line[:-1]).fields
    assert fields[0] == seq
    assert np.array(fields[2:], "f4").tolist() == [value for value in values if abs(value) < 1e38]


def corrupted(line, rng):
    """Flip two bits, or lose two bytes."""
    data = bytearray(line[:-1])
    for _ in range(2):
        position = int(rng.integers(len(data)))
        if rng.random() < 0.5:
            data[position] ^= 1 << int(rng.integers(8))
        else:
            del data[position]
    return bytes(data) + b"\n"


@pytest.mark.parametrize(("check", "maximum"), [("crc16", 0.001), ("xor", 0.1), ("none", 0.9)])
def test_how_many_wrong_values_pass_each_checksum(check, maximum):
    rng, wrong, count = np.random.default_rng(5), 0, 3000
    decoder = Decoder(16)
    decoder.feed(b"".join(encode_line([500] * 16, number, number, check) for number in range(3)))
    for number in range(3, count):
        values = rng.integers(0, 1024, 16).tolist()
        for frame in decoder.feed(corrupted(encode_line(values, number, number * 1000, check), rng)):
            wrong += frame.values.tolist() != values
    assert wrong / count <= maximum
    assert wrong > 0 or check == "crc16"  # the test can see them


def test_another_hand_writes_the_same_frames():
    values = [0.0, 512.0, 1023.0, 7.0]
    for check in ("crc16", "xor", "none"):
        fields = [b"12", b"34000", *(b"%d" % value for value in values)]
        written = independent_frames.text_line(fields, b",", check) + b"\n"
        assert written == encode_line([int(value) for value in values], 12, 34000, check)
    for kind, name in ((1, "u16"), (2, "i16"), (3, "f32")):
        assert independent_frames.binary_frame(12, 34000, values * 40, kind) == encode_frame(
            values * 40, 12, 34000, name
        )


@pytest.mark.parametrize("spoken", ["crc16", "xor", "none", "binary"])
def test_every_good_frame_of_a_long_bad_stream_is_recovered(spoken):
    found = bad_stream.fuzz(CHUNKS, spoken, 25, 7)
    assert found["missed"] == 0
    assert found["good"] == found["recovered"] > 0.6 * CHUNKS
    assert found["pieces"] > 1.5 * found["good"]
    if spoken in ("crc16", "binary"):
        assert found["wrong"] <= CHUNKS // 100_000  # 16 bits fit by chance once in 65,536


@pytest.mark.parametrize("spoken", ["crc16", "xor", "none", "binary"])
@given(seed=st.integers(0, 2**32), sensors=st.integers(1, 70))
@settings(quickly, max_examples=15)
def test_every_good_frame_of_any_bad_stream_is_recovered(spoken, seed, sensors):
    assert bad_stream.fuzz(60, spoken, sensors, seed)["missed"] == 0


@pytest.mark.parametrize("fault", ["drops", "alters"])
def test_the_oracle_sees_a_decoder_that_fails(fault, monkeypatch):
    class Failing:
        def __init__(self, *given):
            self._decoder, self._count = Decoder(*given), 0

        def feed(self, data, now):
            for frame in self._decoder.feed(data, now):
                self._count += 1
                if self._count % 50:
                    yield frame
                elif fault == "alters":
                    yield frame._replace(values=frame.values + 1)

    monkeypatch.setattr(bad_stream, "Decoder", Failing)
    found = bad_stream.fuzz(1000, "crc16", 5, 0)
    assert found["missed"] > 20
    assert (found["wrong"] > 20) == (fault == "alters")
