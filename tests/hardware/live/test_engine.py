"""The engine against a learner asked directly, and its patience."""

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.hardware.live.engine import Detection, Engine
from skin.hardware.live.engine_builder import window_classifier
from skin.hardware.live.verdict import Debounce, DebounceSettings
from skin.labels import TOUCH, Task
from skin.recording import Touches
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion

PLAIN = UnitConversion(np.ones(4), np.zeros(4), np.zeros(4, bool))


class Loud:
    """Takes the mean and the maxima of the readings for the labels; counts how often it is asked."""

    def __init__(self):
        self.asked = 0

    def probabilities(self, touches):
        self.asked += 1
        strongest = touches.readings.flatten(1).amax(1)
        mean = touches.readings.flatten(1).mean(1)
        return torch.stack([mean, mean, mean, (strongest > 4).float()], dim=1).clamp(0, 1)


def frame(t, values, segment=0, valid=None, **more):
    values = np.asarray(values, dtype=float)
    return Frame(None, t, t, values, np.ones(len(values), bool) if valid is None else valid, segment, **more)


def engine(window=5, rate=10.0, sensors=4, task=TOUCH, threshold=0.5, longest=2.0, **patience):
    detection = Detection(threshold, learned=task.gate is not None, longest=longest)
    loud = Loud()
    classify = window_classifier(loud, torch.zeros(sensors, 3), rate)
    subject = Engine(classify, task, sensors, window, rate, detection, DebounceSettings(**patience))
    subject.loud = loud
    return subject


def play(engine, values, rate=100.0, start=0.0, segment=0):
    """Push frames and return the verdicts."""
    return [
        engine.push(frame(start + number / rate, row, segment), PLAIN)
        for number, row in enumerate(np.asarray(values))
    ]


def test_each_frame_repeated_gives_what_the_window_itself_gives():
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(40, 4, generator=generator)
    subject = engine(threshold=99.0)
    said = play(subject, readings.repeat_interleave(10, dim=0))
    for number in range(4, 40):
        window = readings[number - 4 : number + 1][None]
        touches = Touches(window, torch.ones_like(window, dtype=torch.bool), torch.zeros(4, 3), None, 10.0)
        expected = Loud().probabilities(touches)[0].tolist()
        verdict = said[10 * number + 9]
        assert list(verdict.chances.values()) == pytest.approx(expected)


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0, 500.0])
def test_danger_is_said_within_50_ms_of_the_frame_that_shows_it(rate):
    subject = engine()
    idle, count = np.zeros((int(2 * rate), 4)), int(0.5 * rate)
    assert not any(verdict and verdict.dangerous for verdict in play(subject, idle, rate))
    pressed = play(subject, np.full((count, 4), 5.0), rate, start=2.0)
    first = next(number for number, verdict in enumerate(pressed) if verdict.dangerous)
    assert first / rate <= 0.05
    assert pressed[first].touched


def test_one_loud_frame_of_a_fast_stream_stays_in_the_window_and_alarms():
    subject = engine()
    play(subject, np.zeros((200, 4)))
    said = play(subject, [[5.0] * 4] + [[0.0] * 4] * 200, start=2.0)
    assert any(verdict.dangerous for verdict in said[:5])
    assert not said[-1].dangerous


def test_an_alarm_is_not_taken_back_by_one_frame():
    said = Debounce(0.02, 0.5)
    times = np.arange(0, 2, 0.01)
    wavering = [(0.5 <= t < 1.0) and round(100 * t) % 7 != 0 for t in times]
    states = [said(answer, t, 0.01) for answer, t in zip(wavering, times, strict=True)]
    changes = np.flatnonzero(np.diff(np.asarray(states, dtype=int)))
    assert len(changes) == 2
    assert times[changes[0] + 1] == pytest.approx(0.51)
    assert 1.4 < times[changes[1] + 1] < 1.5


def test_without_touch_nothing_is_said():
    verdict = play(engine(), np.full((100, 4), 0.2))[-1]
    assert (verdict.touched, verdict.labels, verdict.dangerous) == (False, {}, False)
    assert verdict.words() == []


def test_words_carry_the_probability_of_what_is_said():
    subject = engine()
    play(subject, np.zeros((60, 4)))
    verdict = play(subject, np.full((40, 4), 1.0), start=0.6)[-1]
    chance = verdict.chances["big"]
    assert 0.5 < chance < 1
    assert verdict.words() == [
        ("big", chance),
        ("dynamic", chance),
        ("press", chance),
        ("safe", 1.0),
    ]


def test_frames_that_waited_slide_through_unasked():
    subject = engine()
    play(subject, np.zeros((100, 4)))
    asked = subject.loud.asked
    for number in range(20):
        subject.add(frame(1 + number / 100, [5.0] * 4))
    assert subject.loud.asked == asked
    verdict = subject.push(frame(1.2, [0.0] * 4), PLAIN)
    assert verdict.chances["dangerous"] == 1


def test_masked_sensors_and_gaps_are_told():
    subject = engine()
    for number in range(60):
        valid = np.array([True, False, True, True])
        verdict = subject.push(frame(number / 100, np.full(4, 3.0), valid=valid), PLAIN)
    assert verdict.masked == (1,)
    assert not verdict.gap
    verdict = subject.push(frame(0.65, np.zeros(4), lost=5, after="gap"), PLAIN)
    assert verdict.gap


def test_an_alarm_outlives_a_restart_of_the_device_until_the_contact_ends():
    for force in (0.0, 5.0):
        subject = engine()
        play(subject, np.zeros((60, 4)))
        assert play(subject, np.full((60, 4), 5.0), start=0.6)[-1].dangerous
        said = play(subject, np.full((60, 4), force), start=1.2, segment=1)
        if force:
            assert all(verdict.dangerous for verdict in said)
        else:
            assert said[8:48] == [None] * 40
            assert not said[-1].dangerous


def test_an_answer_that_is_no_number_raises_the_alarm():
    subject = engine()
    play(subject, np.zeros((60, 4)))
    subject.loud.probabilities = lambda touches: torch.full((1, 4), torch.nan)
    assert not play(subject, np.zeros((10, 4)), start=0.6)[-1].dangerous
    assert play(subject, np.full((10, 4), 1.0), start=0.7)[-1].dangerous


def test_an_alarm_stays_while_the_model_changes_its_mind():
    subject = engine()
    play(subject, np.zeros((60, 4)))
    play(subject, np.full((10, 4), 5.0), start=0.6)
    subject.loud.probabilities = lambda touches: torch.zeros(1, 4)
    held = play(subject, np.full((500, 4), 1.0), start=0.7)
    assert all(verdict.dangerous for verdict in held)
    assert held[-1].contact == pytest.approx(5.1, abs=0.15)
    assert not any(verdict.dangerous for verdict in play(subject, np.zeros((200, 4)), start=5.7)[60:])


def test_a_new_tare_takes_the_alarm_back():
    subject = engine()
    play(subject, np.zeros((60, 4)))
    assert play(subject, np.full((100, 4), 5.0), start=0.6)[-1].dangerous
    subject.reset()
    tared = UnitConversion(np.ones(4), np.full(4, 5.0), np.zeros(4, bool))
    verdict = subject.push(frame(1.61, np.full(4, 5.0)), tared)
    assert (verdict.dangerous, verdict.contact) == (False, None)


def test_labels_that_exclude_each_other_have_one_winner():
    task = Task(("grab", "hit", "tap", "pat"), "exclusive")
    verdict = play(engine(task=task), np.full((60, 4), 5.0))[-1]
    assert sum(verdict.labels.values()) <= 1
    assert not verdict.dangerous


@pytest.mark.parametrize(
    "wrong",
    [
        {"alarm": 0.1},
        {"label": -1.0},
        {"above": 1.0},
        *({name: float("nan")} for name in ("label", "alarm", "calm", "above")),
        *({name: float("inf")} for name in ("label", "calm")),
    ],
)
def test_patience_that_would_be_too_late_is_refused(wrong):
    with pytest.raises(InputError, match="patience"):
        DebounceSettings(**wrong)
