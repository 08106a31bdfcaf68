"""Gestures in time: what is reduced again is what was drawn."""

import numpy as np
import pytest

from skin.device.resampling import resample
from skin.wire.emulator import Converter, upsample

RATE = 10.0


def drawn():
    """Return readings of 30 frames in which touches last 1, 2 and 5 frames, of either sign."""
    force = np.zeros((30, 3))
    force[4] = [3.0, 1.0, -0.2]
    force[10:12] = [[2.0, 0.5, -0.1], [1.0, 2.5, -0.4]]
    force[20:25] = np.arange(1.0, 6.0)[:, None] * [1.0, 0.3, -0.05]
    return force


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0, 1000.0])
def test_the_maximum_over_each_interval_is_the_frame(rate):
    force = drawn()
    felt = upsample(force, RATE, rate)
    time = np.arange(len(felt)) / rate
    known = np.ones_like(felt, dtype=bool)
    back = resample(time, felt, known, ~known, 3.0 - 0.5 / rate, 1 / RATE, 30)
    assert back.valid.all()
    assert back.values == pytest.approx(force, abs=1e-12)


def test_force_rises_and_falls_without_a_jump():
    felt = upsample(drawn(), RATE, 1000.0)
    # A quarter of a frame has 25 samples: no step is larger than a 25th of the largest change between frames.
    assert np.abs(np.diff(felt, axis=0)).max() <= 5.0 / 25 + 1e-9


def test_counts_are_those_of_a_converter():
    converter = Converter(10, clip=10.0)
    assert converter.scale == pytest.approx(20 / 512)
    said = converter(np.array([0.0, converter.scale, -100.0, 100.0]))
    assert said.tolist() == [512, 513, 0, 1023]
    assert Converter(None, 10.0)(np.array([0.25])).tolist() == [0.25]
