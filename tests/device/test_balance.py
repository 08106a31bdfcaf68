"""Whether a shape tells a label."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.simulated import accuracy_from_shape, check_label_leakage
from skin.runs.build import build_device


def test_the_accuracy_is_the_overlap_of_two_distributions():
    """Shares 0.7 / 0.3 against 0.4 / 0.6: the best guess is right in (0.7 + 0.6) / 2."""
    shape = np.repeat([0, 1, 0, 1], [700, 300, 400, 600])
    assert accuracy_from_shape(shape, np.arange(2000) < 1000)[0] == pytest.approx(0.65)
    shape = np.arange(400) % 4
    assert accuracy_from_shape(shape, shape < 2) == (1.0, 0.0)
    accuracy, error = accuracy_from_shape(shape, np.random.default_rng(0).random(400) < 0.5)
    assert accuracy < 0.5 + 2 * error
    assert 0.02 < error < 0.03


def test_a_shape_that_tells_a_label_is_warned_of(configured):
    device = build_device(configured("simulator=naive", "data.gestures=160", "layout=grid"))
    check_label_leakage(device)
    recording = device.recording(None, complete=False)
    bars = recording.parameters | {"shape": recording.touches.labels[:, 0] * 3}
    with pytest.warns(RuntimeWarning, match=r"the shape alone predicts big \(100%\).*touch.leak=0.6"):
        check_label_leakage(device, replace(recording, parameters=bars))
