"""Five seconds of a faulty wire; SOAK_SECONDS=600 takes ten minutes, and SOAK_CHECK=xor another checksum."""

import os

import pytest

from experiments.benchmarks import measure_decoder
from tests.wire import faulty_wire

pytestmark = pytest.mark.slow("streams for long")

SECONDS, CHECK = float(os.environ.get("SOAK_SECONDS", 5)), os.environ.get("SOAK_CHECK", "crc16")


def test_every_intact_frame_arrives_and_no_wrong_value():
    found = faulty_wire.soak(SECONDS, CHECK)
    assert found["bad_frames"] > 5
    if CHECK == "crc16":  # a weaker checksum passes wrong values, some of them as numbers of frames
        assert (found["missed"], found["wrong"], found["dropped"], found["resets"]) == (0, 0, 0, 0)
    print(found)
    assert found["memory_end_bytes"] - found["memory_early_bytes"] < 5e6
    assert found["intact"] < found["sent"] == round(500 * SECONDS)


def test_every_kind_of_fault_is_one():
    line, kinds = faulty_wire._line(7, 0.002, "crc16"), set()
    for number in range(200):
        kinds.add(faulty_wire._kind(number)[0])
        assert faulty_wire._spoil(number, line) != line
    assert len(kinds) == 6
    assert abs(faulty_wire._spoilt(100_000).mean() - 0.01) < 0.001


def test_decoding_takes_less_than_a_twentieth_of_a_core():
    assert measure_decoder()["decode_core_share"] < 0.05
