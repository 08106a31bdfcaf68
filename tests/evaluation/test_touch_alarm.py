"""The simulated decisions of a touch against those of the live engine."""

import numpy as np
import pytest
import torch

from skin.build import build_device
from skin.evaluation import touch_alarm
from skin.evaluation.touch_alarm import Watching, choose_for_touches, touch_scores
from skin.hardware.live.engine import Detection, Engine
from skin.labels import TOUCH
from skin.rng import Stream, generator
from skin.signal.frame import Frame
from skin.touch.sampler import balanced
from skin.wire.channels import UnitConversion

SMALL = ["simulator=naive", "layout=grid", "layout.rows=3", "layout.columns=3", "device.tare=true"]
CONTACT = 0.5  # N


class Peak:
    """The probability of every label grows with the largest reading of the window."""

    def probabilities(self, touches):
        peak = touches.readings.flatten(1).amax(1)
        return torch.sigmoid(peak - 5)[:, None].expand(-1, 4)


@pytest.fixture(scope="module")
def device(configured):
    return build_device(configured(*SMALL, "device.randomise=true", "device.noise=0.1"))


def watching(rate, **changes):
    return Watching(rate, CONTACT, 2.0, **{"patience": 0.1, "column": 3, **changes})


def engine_windows(device, readings, valid, ends, rate):
    """Return the windows and contacts of the engine at the decisions of one touch (F, S)."""
    windows, sensors = [], readings.shape[1]

    def classify(values, known):
        windows.extend(values)
        return np.zeros((len(values), 4))

    engine = Engine(classify, TOUCH, sensors, 30, 10.0, Detection(CONTACT, drift=0.0))
    conversion = UnitConversion(np.ones(sensors), np.zeros(sensors), np.zeros(sensors, bool))
    # The first decision comes at a tick of the engine.
    times = 100.0 + (np.arange(len(readings)) - ends[0]) / rate
    frames = [Frame(n, t, t, row, valid) for n, (t, row) in enumerate(zip(times, readings, strict=True))]
    verdicts = engine.push(frames, conversion)
    place = {round(verdict.t * rate): number for number, verdict in enumerate(verdicts)}
    chosen = [place[round(times[end] * rate)] for end in ends]
    return np.stack([windows[n] for n in chosen]), [verdicts[n].contact is not None for n in chosen]


@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
def test_the_windows_are_those_that_the_engine_decides_on(device, rate):
    """Independent code: frame by frame there, all touches at once here."""
    device = device.replace(padded=False)
    labels = balanced(16, generator(Stream.TEST, 3))
    movie = device.sampler.sample(16, generator(Stream.TEST, 4), labels)
    same = [generator(Stream.ALARM, 5) for _ in range(2)]
    windows, valid, contact = touch_alarm._decision_windows(device, movie, watching(rate), same[0])
    readings, _ = touch_alarm._measured(device, movie, watching(rate), same[1])
    step = max(1.0, rate / 20)
    ends = touch_alarm._decided(readings.shape, round(30 * rate / 10), step, same[1])
    longest = 0
    for touch in range(16):
        found, felt = engine_windows(
            device, readings[touch].double().numpy(), valid[touch].numpy(), ends[touch].numpy(), rate
        )
        assert felt == contact[touch].tolist()
        shown = contact[touch].numpy()
        np.testing.assert_allclose(found[shown], windows[touch][shown].numpy(), atol=1e-5)
        longest = max(longest, int(shown.sum()))
    assert longest > 35  # presses of two seconds are among them


@pytest.mark.parametrize("rate", [10.0, 20.0, 100.0])
def test_the_share_of_new_safe_touches_is_the_one_that_was_asked_for(device, rate):
    point = choose_for_touches(Peak(), device, watching(rate), 0.1, 400)
    assert (point.safe, point.rate) == (400, None)
    assert point.raised <= 40
    labels = balanced(1600, generator(Stream.TEST, 8))
    safe = labels[~labels[:, 3]]
    share = float(point.alarm(touch_scores(Peak(), device, watching(rate), safe, 99)).float().mean())
    # Both are counted: three standard deviations of 400 and 800 touches.
    assert share == pytest.approx(0.1, abs=3 * (0.09 / 400 + 0.09 / 800) ** 0.5)


class Onset(Peak):
    """Looks at the change from one interval to the next."""

    def probabilities(self, touches):
        change = touches.readings[:, -1].amax(1) - touches.readings[:, -2].amax(1)
        return torch.sigmoid(change)[:, None].expand(-1, 4)


def test_one_decision_raises_more_alarms_than_two(device):
    labels = balanced(64, generator(Stream.TEST, 8))
    two, one = (
        touch_scores(Onset(), device, watching(100.0, patience=patience), labels, 9) for patience in (0.1, 0)
    )
    assert (one >= two).all()
    assert (one > two).any()


def test_a_slow_device_needs_one_decision():
    assert [watching(1).decisions(rate) for rate in (5.0, 10.0, 20.0, 100.0, 500.0)] == [1, 1, 2, 2, 2]


def test_a_device_of_the_model_gives_its_frames(device):
    """The simulator sends the frames of the model; a real one of that rate reads at any phase."""
    labels = balanced(64, generator(Stream.TEST, 8))
    aligned, real = (
        touch_scores(Peak(), device, watching(10.0, aligned=aligned), labels, 9) for aligned in (True, False)
    )
    assert aligned.mean() > real.mean()
