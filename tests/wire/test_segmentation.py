"""Which frames are a gesture."""

from collections import Counter
from time import sleep
from types import SimpleNamespace

import numpy as np
import pytest

from skin.device.resampling import Frame, Window
from skin.errors import InputError
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.wire.protocol import Announcement, encode_announcement
from skin.wire.segmentation import (
    AnnouncedSegmenter,
    AnnouncementListener,
    ContinuousSegmenter,
    PromptedSegmenter,
    label_plan,
)

LABELS = {"big": 1, "dynamic": 0, "press": 1, "dangerous": 0}


def frames(numbers, rate=100.0, segment=0):
    return [Frame(n, n / rate, n / rate, np.array([float(n)]), np.array([True]), segment) for n in numbers]


def window(seconds):
    return Window(round(10 * seconds), 10.0, 1)


def announcements(*said):
    """Return a tap that has heard announcements among other bytes, cut anywhere."""
    data = b"1,2*00\n" + b"".join(map(encode_announcement, said)) + b"half a li"
    pieces = [data[:20], data[20:]]
    listener = AnnouncementListener(lambda: SimpleNamespace(read=lambda: pieces.pop(0), close=lambda: None))()
    assert listener.read() + listener.read() == data
    return listener


def shown(segmenter, sequence):
    return [gesture for frame in sequence if (gesture := segmenter.add(frame))]


def announced(sequence, *said, seconds=0.3, task=TOUCH):
    """Return the gestures of a stream with announcements."""
    return shown(AnnouncedSegmenter(window(seconds), announcements(*said), task), sequence)


def test_an_announced_gesture_is_its_frames():
    (gesture,) = announced(frames(range(60)), Announcement(0, 10, 30, LABELS))
    assert [frame.seq for frame in gesture.frames] == list(range(10, 40))
    assert (gesture.labels, gesture.lost, gesture.broken) == (LABELS, 0, False)


def test_a_window_keeps_its_place_where_its_first_frames_are_lost():
    (gesture,) = announced(frames([*range(10), *range(14, 60)]), Announcement(0, 10, 30, LABELS))
    assert gesture.begin == pytest.approx(0.1)
    assert (gesture.frames[0].seq, gesture.frames[-1].seq, gesture.lost) == (14, 39, 4)


@pytest.mark.parametrize(
    ("sent", "length", "numbers"),
    [(range(15, 70), 30, [1]), (range(25), 10, [0, 1])],  # half over at the beginning; one after the other
)
def test_windows_that_touch_each_other_are_two(sent, length, numbers):
    said = Announcement(0, 0, length, LABELS), Announcement(1, length, length, LABELS)
    gestures = announced(frames(sent), *said, seconds=length / 100)
    assert [gesture.number for gesture in gestures] == numbers


def test_a_restart_breaks_a_gesture_off():
    sent = frames(range(10)) + frames(range(5), segment=1)
    (gesture,) = announced(sent, Announcement(0, 0, 30, LABELS))
    assert gesture.broken


def test_a_label_that_is_not_announced_is_missed_and_a_touch_is_always_one():
    with pytest.raises(InputError, match="no press"):
        announced(frames(range(3)), Announcement(0, 0, 30, {"big": 1, "dynamic": 1}))
    said = Announcement(0, 0, 10, LABELS)
    (gesture,) = announced(frames(range(20)), said, seconds=0.1, task=TOUCH_OR_NOT)
    assert gesture.labels["touch"] == 1


def test_every_combination_once_per_repetition_in_another_order():
    wanted = [tuple(labels.values()) for labels in label_plan(TOUCH.names, 3, seed=1)]
    assert set(Counter(wanted).values()) == {3}
    assert len(set(wanted[:16])) == 16
    assert wanted[:16] != wanted[16:32]
    assert wanted == [tuple(labels.values()) for labels in label_plan(TOUCH.names, 3, seed=1)]


def test_a_person_begins_skips_and_ends():
    said = []
    segmenter = PromptedSegmenter(
        window(0.1),
        enumerate(label_plan(TOUCH.names, 1, 0)),
        said.append,
        lambda seen: True,
        iter(["\n", "s\n", "\n"]),
    )
    gestures = []
    for frame in frames(range(2000)):
        if gesture := segmenter.add(frame):
            gestures.append(gesture)
        if segmenter.over:
            break
        # Frames come while the person types.
        sleep(0.001)
    assert [gesture.number for gesture in gestures] == [0, 2]
    assert [len(gesture.frames) for gesture in gestures] == [10, 10]
    assert sum(line.startswith("next: ") for line in said) == 4
    assert gestures[0].labels == next(label_plan(TOUCH.names, 1, 0))


def test_windows_one_after_the_other():
    gestures = shown(ContinuousSegmenter(window(0.1), first=5), frames(range(35)))
    assert [(gesture.number, gesture.frames[0].seq) for gesture in gestures] == [(5, 0), (6, 10), (7, 20)]


def test_windows_that_wait_for_a_touch():
    gestures = shown(
        ContinuousSegmenter(window(0.1), begins=lambda values: values[0] % 50 > 40), frames(range(120))
    )
    assert [gesture.frames[0].seq for gesture in gestures] == [41, 91]
