"""What a data set says of its classes, and whether a shape tells a label."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.simulated import accuracy_from_shape, balance_text, check_label_leakage, class_balance
from skin.runs.build import build_device


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured("simulator=naive", "data.gestures=160", "layout=grid"))


def test_the_accuracy_is_the_overlap_of_two_distributions():
    """Shares 0.7 / 0.3 against 0.4 / 0.6: the best guess is right in (0.7 + 0.6) / 2."""
    shape = np.repeat([0, 1, 0, 1], [700, 300, 400, 600])
    assert accuracy_from_shape(shape, np.arange(2000) < 1000)[0] == pytest.approx(0.65)
    shape = np.arange(400) % 4
    assert accuracy_from_shape(shape, shape < 2) == (1.0, 0.0)
    accuracy, error = accuracy_from_shape(shape, np.random.default_rng(0).random(400) < 0.5)
    assert accuracy < 0.5 + 2 * error
    assert 0.02 < error < 0.03


def test_the_balance_is_what_the_parameters_say(device):
    recording = device.recording(None, complete=False)
    balance, known = class_balance(recording, device.sampler), recording.parameters
    big = recording.touches.labels[:, 0] > 0.5
    assert balance["area %"]["big"] == pytest.approx(100 * float(known["area"][big].mean()))
    assert balance["paths"]["big"] == pytest.approx(100 * (1 - float(big.sum() / known["draws"][big].sum())))
    fractions = [100 * float((known["shape"][big] == number).float().mean()) for number in range(7)]
    assert balance.loc["big"].iloc[2:9].tolist() == pytest.approx(fractions)
    lines = balance_text(balance).splitlines()
    names = ["big", "small", "dynamic", "static", "press", "tap", "dangerous", "safe"]
    assert [line.split()[0] for line in lines[2:]] == names
    check_label_leakage(balance, 0.6)


def test_a_shape_that_tells_a_label_is_warned_of(device):
    recording = device.recording(None, complete=False)
    bars = recording.parameters | {"shape": recording.touches.labels[:, 0] * 3}
    balance = class_balance(replace(recording, parameters=bars), device.sampler)
    with pytest.warns(RuntimeWarning, match=r"the shape alone predicts big \(100%\).*touch.leak=0.6"):
        check_label_leakage(balance, 0.6)
    check_label_leakage(balance, 1.0)
