"""Five seconds of a faulty wire; `skin bench benchmark=wire` takes any duration."""

import pytest

from experiments.benchmarks import wire

pytestmark = pytest.mark.slow


def test_every_intact_frame_arrives_and_no_wrong_value():
    found = wire.soak(5.0)
    assert found["bad_frames"] > 5
    assert (found["missed"], found["wrong"], found["dropped"], found["resets"]) == (0, 0, 0, 0)
    assert found["memory_end_bytes"] - found["memory_early_bytes"] < 5e6
    assert found["intact"] < found["sent"] == 2500


def test_every_kind_of_fault_is_one():
    line, kinds = wire._line(7, 0.002, "crc16"), set()
    for number in range(200):
        kinds.add(wire._kind(number)[0])
        assert wire._spoil(number, line) != line
    assert len(kinds) == 6
    assert abs(wire._spoilt(100_000).mean() - 0.01) < 0.001


def test_decoding_takes_less_than_a_twentieth_of_a_core():
    assert wire.decode_core_share() < 0.05
