"""Faults happen as often as they are asked for."""

import numpy as np
import pytest

from skin.core.settings import configured
from skin.errors import InputError
from skin.wire.emulator import Faults


def test_no_fault_changes_nothing():
    data = bytes(range(256))
    assert Faults().damaged(data, np.random.default_rng(0)) == data


def test_bits_and_bytes_at_their_rates():
    data, draw = bytes(100_000), np.random.default_rng(1)
    arrived = Faults(flipped_bits=0.01, lost_bytes=0.1).damaged(data, draw)
    # Five standard deviations of either count.
    assert len(arrived) == pytest.approx(90_000, abs=5 * np.sqrt(9000))
    flipped = np.unpackbits(np.frombuffer(arrived, np.uint8)).sum()
    assert flipped == pytest.approx(0.01 * 8 * len(arrived), abs=5 * np.sqrt(7200))


def test_a_rate_is_per_minute_and_a_list_is_moments():
    draw = np.random.default_rng(2)
    happened = Faults(reset=6.0).happen("reset", 0, 600_000, 100.0, draw).sum()
    assert happened == pytest.approx(600, abs=5 * np.sqrt(600))
    listed = Faults(reset=[1.5, 3]).happen("reset", 100, 300, 100.0, draw)
    assert np.flatnonzero(listed).tolist() == [50, 200]


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"flip": 1}, "faults has no setting flip"),
        ({"flipped_bits": 2}, "flipped_bits"),
        ({"reset": -1}, "reset"),
    ],
)
def test_what_cannot_be_is_refused(given, reason):
    with pytest.raises(InputError, match=reason):
        configured(Faults, given, "faults")


def test_a_channel_that_is_not_there():
    with pytest.raises(InputError, match="no channel 4"):
        Faults(dead=[4]).fits(4)
