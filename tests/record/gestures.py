"""Gestures of a session, for tests and for processes that begin soon."""

import numpy as np

from skin.device.resampling import Frame, Window
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import ContinuousSegmenter

METADATA = {"positions": [[0.0, 0.0, 0.0]] * 2, "unit": "adc", "bits": 10, "id": "arm-L"}
METADATA |= {"window": 5, "rate": 50.0, "started_unix": 1.0}
CONVERSION = UnitConversion(np.array([0.1, 0.2]), np.array([512.0, 500.0]), np.array([False, False]))


def frame(number, segment=0, valid=(True, True), limited=(False, False), after=""):
    """Return a frame at 100 Hz whose first value is its number."""
    values, t = np.array([number + 0.125, 512.0]), number / 100
    return Frame(number, t, t, values, np.array(valid), segment, 0, after, np.array(limited))


def segmented(log, frames, conversion, pause=0):
    """Record frames as consecutive gestures of ten, with labels; return them as they were recorded."""
    segmenter, gestures = ContinuousSegmenter(Window(5, 50.0, 2), max(log.done, default=-1) + 1), {}
    for one in frames:
        done = segmenter.add(one)
        if done is not None:
            done.labels = {"big": done.number % 2, "dangerous": 1}
            gestures[done.number] = done, conversion
            log.write((done, conversion))
        log.add(one, one.t)
    return gestures
