"""What a data set says of its classes, and whether a shape tells a label."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.balance import accuracy_from_shape, balance_table, check_label_leakage, class_balance
from skin.runs.build import build_device
from skin.touch.gestures import GestureSettings


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "data.gestures=160", "layout=grid"))


def test_a_shape_that_is_the_label_tells_it():
    shape = np.arange(400) % 4
    assert accuracy_from_shape(shape, shape < 2) == (1.0, 0.0)
    accuracy, error = accuracy_from_shape(shape, np.random.default_rng(0).random(400) < 0.5)
    assert accuracy < 0.5 + 2 * error
    assert 0.02 < error < 0.03


def test_the_accuracy_is_the_overlap_of_two_distributions():
    """Shares 0.7 / 0.3 against 0.4 / 0.6: the best guess is right in (0.7 + 0.6) / 2."""
    shape = np.repeat([0, 1, 0, 1], [700, 300, 400, 600])
    holds = np.repeat([True, True, False, False], [700, 300, 400, 600])
    assert accuracy_from_shape(shape, holds)[0] == pytest.approx(0.65)


def test_the_balance_is_what_the_parameters_say(device):
    recording = device.recording(None, complete=False)
    report = class_balance(recording, device.sampler)
    big = recording.touches.labels[:, 0] > 0.5
    yes, known = report["labels"]["big"]["yes"], recording.parameters
    assert yes["touches"] == int(big.sum())
    assert yes["area"] == pytest.approx(float(known["area"][big].mean()))
    assert yes["rejected"] == pytest.approx(1 - float(big.sum() / known["draws"][big].sum()))
    fractions = [float((known["shape"][big] == number).float().mean()) for number in range(7)]
    assert yes["shapes"] == pytest.approx(fractions)
    table = balance_table(report)
    assert [line.split()[0] for line in table[2:]] == [
        "big", "small", "dynamic", "static", "press", "tap", "dangerous", "safe"
    ]  # fmt: skip
    assert len({len(line) for line in table[1:]}) == 1


def telling(device):
    """Return a balance in which all big touches are bars."""
    recording = device.recording(None, complete=False)
    big = recording.touches.labels[:, 0]
    known = recording.parameters | {"shape": big * 3}
    return class_balance(replace(recording, parameters=known), device.sampler)


def test_a_shape_that_tells_a_label_is_warned_of(device):
    report = telling(device)
    with pytest.warns(RuntimeWarning, match=r"the shape alone predicts big \(100%\).*touch.leak=0.6"):
        check_label_leakage(report, GestureSettings())
    check_label_leakage(report, GestureSettings(leak=1.0))


def test_the_default_gestures_pass(device):
    report = class_balance(device.recording(None, complete=False), device.sampler)
    check_label_leakage(report, GestureSettings())
