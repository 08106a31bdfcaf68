"""The engine against a learner asked directly, and its patience."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.device.resampling import Frame
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.guarantee import Guarantee
from skin.live.engine import Debounce, DebounceSettings, Detection, Engine
from skin.touch.labels import TOUCH, Task
from skin.wire.channels import UnitConversion
from skin.wire.tare import Tare

PLAIN_PARTS = np.ones(4), np.zeros(4), np.zeros(4, bool)
PLAIN = UnitConversion(*PLAIN_PARTS)


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


def engine(window=5, rate=10.0, task=TOUCH, threshold=0.5, presses=None, conversion=PLAIN, **patience):
    """Return an engine of four sensors, with a model and with what converts its frames."""
    detection = Detection(threshold, learned=task.gate is not None)
    loud = Loud()

    def classify(readings, valid):
        touches = Touches(*map(torch.from_numpy, (readings, valid)), torch.zeros(4, 3), None, rate)
        return loud.probabilities(touches).numpy()

    subject = Engine(classify, task, 4, window, rate, detection, DebounceSettings(**patience), presses)
    subject.loud, subject.tare = loud, Tare(lambda baseline, header: conversion, 0.0, rate)
    subject.reset(noise=conversion.noise)
    return subject


def rested(**settings):
    """Return an engine that has seen rest for 0.6 s."""
    subject = engine(**settings)
    play(subject, np.zeros((60, 4)))
    return subject


def push(subject, frames):
    """Push frames as the device sends them, and return the verdicts."""
    return subject.push([subject.tare.add(one) for one in frames])


def play(engine, values, rate=100.0, start=0.0, segment=0, burst=1):
    """Push frames, some at a time, and return the verdicts."""
    frames = [frame(start + number / rate, row, segment) for number, row in enumerate(values)]
    bursts = (frames[first : first + burst] for first in range(0, len(frames), burst))
    return [verdict for some in bursts for verdict in push(engine, some)]


def test_each_frame_repeated_gives_what_the_window_itself_gives():
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(40, 4, generator=generator)
    subject = engine(threshold=99.0)
    # The tenth frame of each interval comes at a tick.
    said = play(subject, readings.repeat_interleave(10, dim=0), start=0.01)
    # Before the first frame the skin was at rest.
    padded = torch.cat([torch.zeros(4, 4), readings])
    decisions = {round(100 * verdict.t): verdict for verdict in said}
    for number in range(40):
        window = padded[number : number + 5][None]
        touches = Touches(window, torch.ones_like(window, dtype=torch.bool), torch.zeros(4, 3), None, 10.0)
        expected = Loud().probabilities(touches)[0].tolist()
        verdict = decisions[10 * number + 10]
        # The baseline drifts by some 1e-5 N.
        found = list(verdict.probabilities.values())
        assert found == pytest.approx(expected, abs=1e-4 if number < 4 else 1e-7)


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0, 500.0])
def test_danger_is_said_within_a_tenth_of_a_second_of_the_frame_that_shows_it(rate):
    subject = engine()
    idle, count = np.zeros((int(2 * rate), 4)), int(0.5 * rate)
    assert not any(verdict and verdict.dangerous for verdict in play(subject, idle, rate))
    pressed = play(subject, np.full((count, 4), 5.0), rate, start=2.0)
    first = next(verdict for verdict in pressed if verdict.dangerous)
    assert first.t <= 2.0 + 0.1
    assert first.touched


def test_one_loud_frame_of_a_fast_stream_stays_in_the_window_and_alarms():
    subject = engine()
    play(subject, np.zeros((200, 4)))
    said = play(subject, [[0.0] * 4] + [[5.0] * 4] + [[0.0] * 4] * 300, start=2.0)
    assert next(verdict.t for verdict in said if verdict.dangerous) <= 2.11
    # Nobody must miss it: it stays for two seconds after the contact.
    last = max(verdict.t for verdict in said if verdict.dangerous)
    assert 4.0 < last < 4.6


def test_an_alarm_is_not_taken_back_by_one_frame():
    said = Debounce(0.02, 0.5)
    times = np.arange(0, 2, 0.01)
    wavering = [(0.5 <= t < 1.0) and round(100 * t) % 7 != 0 for t in times]
    states = [said(answer, t, 0.01) for answer, t in zip(wavering, times, strict=True)]
    changes = np.flatnonzero(np.diff(np.asarray(states, dtype=int)))
    assert len(changes) == 2
    assert times[changes[0] + 1] == pytest.approx(0.51)
    assert 1.4 < times[changes[1] + 1] < 1.5


def test_words_carry_the_probability_of_what_is_said_and_without_touch_nothing_is_said():
    verdict = play(engine(), np.full((100, 4), 0.2))[-1]
    assert (verdict.touched, verdict.labels, verdict.dangerous) == (False, {}, False)
    assert verdict.words() == []
    subject = rested()
    verdict = play(subject, np.full((40, 4), 1.0), start=0.6)[-1]
    probability = verdict.probabilities["big"]
    assert 0.5 < probability < 1
    assert verdict.words() == [*((word, probability) for word in ("big", "dynamic", "press")), ("safe", 1.0)]


@pytest.mark.parametrize("burst", [1, 25, 50, 100, 1000])
def test_what_is_decided_does_not_depend_on_how_the_frames_arrive(burst):
    """A burst is classified at once, and decides what its frames would have decided one by one."""
    values = np.random.default_rng(1).normal(scale=0.1, size=(1000, 4))
    values[300:420] += 5.0
    values[700:703] += 5.0
    expected, subject = play(engine(), values), engine()
    said = play(subject, values, burst=burst)
    assert len(said) == 198  # the rate shows in eight frames
    shown = lambda verdict: (verdict.t, verdict.dangerous, verdict.labels, verdict.touched)  # noqa: E731
    for one, other in zip(said, expected, strict=True):
        assert shown(one) == shown(other)
        assert one.probabilities == pytest.approx(other.probabilities)
    assert subject.loud.asked == pytest.approx(1000 / burst, abs=1) or burst == 1
    assert next(verdict.t for verdict in said if verdict.dangerous) <= 3.05


def test_masked_sensors_and_gaps_are_told():
    subject = engine()
    valid = np.array([True, False, True, True])
    frames = [frame(number / 100, np.full(4, 3.0), valid=valid) for number in range(60)]
    verdict = push(subject, frames)[-1]
    assert verdict.masked == verdict.unknown == (1,)
    assert not verdict.gap
    (verdict,) = push(subject, [frame(0.65, np.zeros(4), lost=5, after="gap")])
    assert verdict.gap


def test_a_place_without_a_valid_sensor_is_unknown_whatever_others_feel():
    subject = engine(presses=5.0 * (0.8 * np.eye(4) + 0.2))
    frames = [frame(n / 100, np.zeros(4), valid=np.array([True, False, True, False])) for n in range(60)]
    verdict = push(subject, frames)[-1]
    assert (verdict.masked, verdict.unknown, verdict.state) == ((1, 3), (1, 3), "unknown")
    assert [(note.code, note.sensors) for note in verdict.notes] == [("masked", (1, 3))]


@pytest.mark.parametrize("rate", [2, 3])
def test_a_stream_that_becomes_slow_is_unknown_as_taps_fall_between_its_frames(rate):
    subject = engine()
    said = push(subject, [frame(n / 100, np.zeros(4)) for n in range(500)])
    assert {verdict.state for verdict in said} == {"no touch"}
    slow = push(subject, [frame(5 + n / rate, np.zeros(4), lost=40, after="gap") for n in range(9)])
    assert {verdict.state for verdict in slow[1:]} == {"unknown"}
    assert f"no frame for {1 / rate:.2f} s" in slow[-1].notes[0].text
    end = 5 + 8 / rate
    fast = push(subject, [frame(end + n / 4.1, np.zeros(4)) for n in range(1, 9)])
    assert {verdict.state for verdict in fast} == {"no touch"}


def test_a_fast_model_is_not_blind_after_each_lost_frame():
    subject = engine(rate=100.0)
    said = push(subject, [frame(n / 100, np.zeros(4)) for n in range(500) if n % 20 > 4])
    assert len(said) > 50
    assert {verdict.state for verdict in said} == {"no touch"}


def test_a_tap_after_a_restart_or_a_gap_is_found():
    for start, segment in ((0.5, 1), (40.0, 0)):
        subject = engine(window=30)
        play(subject, np.full((100, 4), 0.2))
        play(subject, np.zeros((30, 4)), start=start, segment=segment)
        said = play(subject, np.full((10, 4), 5.0), start=start + 0.3, segment=segment)
        assert next(verdict.t for verdict in said if verdict.dangerous) <= start + 0.4


def test_the_frames_before_a_restart_are_decided():
    subject = engine()
    play(subject, np.zeros((101, 4)))
    assert play(subject, np.full((3, 4), 5.0), start=1.01) == []
    assert play(subject, np.zeros((1, 4)), start=0.01, segment=1)[0].dangerous


def test_a_value_that_is_the_same_behind_a_silence_is_not_stuck():
    noise = np.random.default_rng(0).normal(scale=0.05, size=(300, 4))
    conversion = UnitConversion(*PLAIN_PARTS, noise=np.full(4, 0.05), changing=np.full(4, 0.9))
    subject = engine(conversion=conversion)
    push(subject, [frame(n / 100, row) for n, row in enumerate(noise)])
    behind = np.array([noise[-1, 0], noise[-1, 1], 0.01, 0.01])
    said = push(subject, [frame(12 + n / 100, behind, after="gap" * (n == 0)) for n in range(30)])
    # The last decision before the silence, and the first behind it.
    paused = [any(note.code == "pause" and note.seconds > 8 for note in verdict.notes) for verdict in said]
    assert paused[:3] == [False, True, False]
    assert all(verdict.unknown == () for verdict, after in zip(said, paused, strict=True) if not after)


def test_a_safe_touch_beside_a_dead_sensor_may_hide_a_dangerous_one():
    """What presses on the dead sensor cannot be felt: its neighbours read a part of the force."""
    stream = [frame(n / 100, np.full(4, 0.4), valid=np.arange(4) != 2) for n in range(100)]
    last = push(engine(threshold=0.3), stream)[-1]
    assert (last.state, last.dangerous, last.unknown) == ("touch", False, (2,))
    assert last.known["dangerous"] is None
    assert {word for word, _ in last.words()} >= {"dangerous?"}
    assert "safe" not in {word for word, _ in last.words()}
    assert replace(last, unknown=()).known["dangerous"] is False
    assert replace(last, dangerous=True, labels={"dangerous": True}).known["dangerous"] is True


def test_values_that_fall_with_force_are_told():
    values = np.zeros((300, 4))
    values[200:, :2] = -4.0
    verdict = push(engine(), [frame(n / 100, row) for n, row in enumerate(values)])[-1]
    assert verdict.state == "unknown"
    assert [(note.code, note.sensors) for note in verdict.notes] == [("below", (0, 1)), ("void", (0, 1))]
    assert "device.scale" in verdict.notes[0].text


def test_a_word_does_not_stand_beside_the_probability_of_its_opposite():
    subject = rested(label=0.5)
    play(subject, np.full((100, 4), 1.0), start=0.6)
    said = play(subject, np.full((30, 4), 0.6), start=1.6)
    for verdict in said:
        assert all(probability > 0.5 for _, probability in verdict.words())


def test_an_answer_that_is_no_number_raises_the_alarm():
    subject = rested()
    subject.loud.probabilities = lambda touches: torch.full((1, 4), torch.nan)
    assert not play(subject, np.zeros((10, 4)), start=0.6)[-1].dangerous
    assert play(subject, np.full((10, 4), 1.0), start=0.7)[-1].dangerous


def test_an_alarm_stays_while_the_model_changes_its_mind():
    subject = rested()
    play(subject, np.full((10, 4), 5.0), start=0.6)
    subject.loud.probabilities = lambda touches: torch.zeros(1, 4)
    held = play(subject, np.full((500, 4), 1.0), start=0.7)
    assert all(verdict.dangerous for verdict in held)
    assert held[-1].contact == pytest.approx(5.1, abs=0.15)
    assert not any(verdict.dangerous for verdict in play(subject, np.zeros((200, 4)), start=5.7)[60:])


def test_a_new_tare_takes_the_alarm_back():
    subject = rested()
    assert play(subject, np.full((100, 4), 5.0), start=0.6)[-1].dangerous
    subject.reset()
    tared = UnitConversion(np.ones(4), np.full(4, 5.0), np.zeros(4, bool))
    (verdict,) = subject.push([tared.convert(frame(1.66, np.full(4, 5.0)))])
    assert (verdict.dangerous, verdict.contact) == (False, None)


def test_labels_that_exclude_each_other_have_one_winner():
    task = Task(("grab", "hit", "tap", "pat"), "exclusive")
    verdict = play(engine(task=task), np.full((60, 4), 5.0))[-1]
    assert sum(verdict.labels.values()) <= 1
    assert not verdict.dangerous


@pytest.mark.parametrize(
    ("name", "value"),
    [("alarm", 0.101), ("label", -1.0), ("above", 1.0), ("label", np.inf), ("calm", np.inf)]
    + [(name, np.nan) for name in ("label", "alarm", "calm", "above")],
)
def test_patience_that_would_be_too_late_is_refused(name, value):
    with pytest.raises(InputError, match="patience"):
        DebounceSettings(**{name: value})


@pytest.mark.parametrize(("rate", "state"), [(0.0, "valid"), (95.0, "valid"), (20.0, "lapsed")])
def test_a_guarantee_holds_at_its_own_rate(rate, state):
    subject = rested()
    subject.guarantee, subject.device_rate = Guarantee(0.01, 300, 0, "mild", device_rate=100.0), rate
    (note,) = play(subject, np.zeros((10, 4)), start=0.6)[-1].notes
    assert note.code == f"guarantee_{state}"


@pytest.mark.parametrize(("short", "danger"), [(False, False), (True, None)])
def test_a_touch_beyond_a_short_range_is_not_safe_until_it_ends(short, danger):
    subject = rested()
    subject.short = np.full(4, short)
    limits = [np.full(4, n == 20) for n in range(60)]
    sent = [frame(0.6 + n / 100, np.ones(4), saturated=limit) for n, limit in enumerate(limits)]
    assert push(subject, sent)[-1].danger is danger
    assert play(subject, np.zeros((100, 4)), start=1.2)[-1].danger is False


def test_where_a_sensor_has_changed_no_touch_is_safe():
    subject = rested()
    subject.changed = (2,)
    verdict = play(subject, np.ones((30, 4)), start=0.6)[-1]
    assert (verdict.unknown, verdict.danger) == ((2,), None)
    assert [note.message["sensors"] for note in verdict.notes if note.code == "changed"] == [[2]]


def test_a_finished_touch_keeps_its_last_labels_while_it_leaves_the_window():
    subject = rested(window=30)
    play(subject, np.full((100, 4), 3.0), start=0.6)
    said = [verdict for verdict in play(subject, np.zeros((400, 4)), start=1.6) if verdict.touched]
    assert said[-1].t > 3.5
    assert all(verdict.labels["press"] for verdict in said)
