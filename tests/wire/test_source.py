"""A stream whose values are N already."""

import numpy as np

from skin.device.resampling import Frame
from skin.wire.skin import Source


def test_values_in_newtons_stay_what_they_are():
    values, valid = np.array([0.5, -1.0, 7.0]), np.array([True, True, False])
    source = Source.in_newtons("recording", None, 3)
    source.tare.add(Frame(0, 0.0, 0.0, values, valid))
    said, known = source.tare.conversion(values, valid)
    assert said.tolist() == [0.5, -1.0, 0.0]
    assert known.tolist() == valid.tolist()
