"""Whatever the wire says: no exception, and every good frame after the next delimiter is recovered."""

import os
from random import Random

import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.benchmarks import measure_decoder
from skin.wire.decoder import Decoder
from skin.wire.protocol import encode_line
from tests.wire import bad_stream
from tests.wire.memory import parse_line

quickly = settings(
    max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
CHUNKS = int(os.environ.get("FUZZ_CHUNKS", 5000))


@given(noise=st.binary(max_size=400))
@quickly
def test_noise_before_the_format_is_known_costs_no_frame(noise):
    lines = (encode_line([7, number, 1023], number, 1000 * number) for number in range(4))
    frames = Decoder(3).feed(noise + b"\n" + b"".join(lines))
    assert [frame.seq for frame in frames][-4:] == [0, 1, 2, 3]


@given(values=st.lists(st.floats(allow_nan=False, width=32), max_size=40), seq=st.integers(0, 2**32 - 1))
@quickly
def test_lines_survive_the_way_there_and_back(values, seq):
    line = encode_line([value for value in values if abs(value) < 1e38], seq, 0)
    fields = parse_line(line[:-1]).fields
    assert fields[0] == seq
    assert np.array(fields[2:], "f4").tolist() == [value for value in values if abs(value) < 1e38]


@pytest.mark.slow("streams for long")
def test_every_intact_frame_of_a_faulty_wire_arrives_and_no_wrong_value():
    """One line of a hundred is spoilt; SOAK_SECONDS=600 takes ten minutes of a stream at 500 Hz."""
    seconds, check = float(os.environ.get("SOAK_SECONDS", 5)), os.environ.get("SOAK_CHECK", "crc16")
    rng, decoder, wrong, sent, came, memory = Random(1), Decoder(25), 0, set(), set(), []
    for number in range(round(500 * seconds)):
        line, spoilt = bad_stream.frame(number, check, 25), number > 10 and rng.random() < 0.01
        sent |= set() if spoilt or number == 0 else {number}
        line = bad_stream.damage(line[:-1], rng) + b"\n" if spoilt else line
        for frame in decoder.feed(line, number / 500):
            right = frame.values.tolist() == bad_stream.values(frame.seq or 0, 25)
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
    found = bad_stream.fuzz(CHUNKS, spoken, 25, 0)
    assert not found["missed"]
    assert len(found["good"]) > 0.4 * CHUNKS
    if spoken == "crc16":
        assert found["wrong"] <= CHUNKS // 10_000  # 16 bits fit by chance once in 65,536


@pytest.mark.parametrize("spoken", ["crc16", "xor", "none"])
@given(seed=st.integers(0, 2**32), sensors=st.integers(1, 70))
@settings(quickly, max_examples=15)
def test_every_good_frame_of_any_bad_stream_is_recovered(spoken, seed, sensors):
    assert not bad_stream.fuzz(60, spoken, sensors, seed)["missed"]
