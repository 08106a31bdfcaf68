"""Which frames are a gesture."""

import json
from collections import Counter, deque
from time import sleep

import numpy as np
import pytest

from skin.device.resampling import Frame, Window
from skin.errors import InputError
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.wire.decoder import Decoder
from skin.wire.protocol import Announcement, crc16, encode_announcement, encode_line, parse_announcement
from skin.wire.segmentation import AnnouncedSegmenter, ContinuousSegmenter, PromptedSegmenter, label_plan

LABELS = {"big": 1, "dynamic": 0, "press": 1, "dangerous": 0}
MANY = np.zeros((3, 101, 5)).tolist()


def frames(numbers, rate=100.0, segment=0):
    return [Frame(n, n / rate, n / rate, np.array([float(n)]), np.array([True]), segment) for n in numbers]


def window(seconds):
    return Window(round(10 * seconds), 10.0, 1)


def shown(segmenter, sequence):
    return [gesture for frame in sequence if (gesture := segmenter.add(frame))]


def announced(sequence, *said, seconds=0.3, task=TOUCH):
    return shown(AnnouncedSegmenter(window(seconds), deque(said), task), sequence)


def test_an_announced_gesture_is_its_frames_and_keeps_its_place_where_the_first_are_lost():
    (gesture,) = announced(frames(range(60)), Announcement(0, 10, 30, LABELS))
    assert [frame.seq for frame in gesture.frames] == list(range(10, 40))
    assert (gesture.labels, gesture.lost) == (LABELS, 0)
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
    assert not announced(sent, Announcement(0, 0, 30, LABELS))


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
    plan, typed = enumerate(label_plan(TOUCH.names, 1, 0)), iter(["\n", "s\n", "\n"])
    segmenter = PromptedSegmenter(window(0.1), plan, said.append, lambda seen: True, typed)
    gestures, arriving = [], iter(frames(range(2000)))
    while not segmenter.over:
        gestures += shown(segmenter, [next(arriving)])
        sleep(0.001)  # frames come while the person types
    assert [gesture.number for gesture in gestures] == [0, 2]
    assert [len(gesture.frames) for gesture in gestures] == [10, 10]
    assert sum(line.startswith("next: ") for line in said) == 4
    assert gestures[0].labels == next(label_plan(TOUCH.names, 1, 0))


def test_windows_one_after_the_other_or_that_wait_for_a_touch():
    gestures = shown(ContinuousSegmenter(window(0.1), first=5), frames(range(35)))
    assert [(gesture.number, gesture.frames[0].seq) for gesture in gestures] == [(5, 0), (6, 10), (7, 20)]
    segmenter = ContinuousSegmenter(window(0.1), begins=lambda frame: frame.values[0] % 50 > 40)
    gestures = shown(segmenter, frames(range(120)))
    assert [gesture.frames[0].seq for gesture in gestures] == [41, 91]


def test_an_announcement_comes_back_among_frames_and_not_damaged():
    contacts = np.full((3, 2, 5), np.nan)
    contacts[1:, 1] = np.arange(10).reshape(2, 5) / 7
    said = Announcement(3, 650, 300, LABELS, 10.0, contacts)
    decoder = Decoder(2)
    lines = [encode_line([1, number], number, 10_000 * number) for number in range(6)]
    assert len(decoder.feed(b"".join([*lines[:3], encode_announcement(said), *lines[3:]]))) == 6
    assert not decoder.stats.bad
    (heard,) = decoder.announcements
    np.testing.assert_array_equal(heard.contacts, contacts)
    assert (heard.number, heard.seq, heard.frames, heard.labels, heard.rate) == (3, 650, 300, LABELS, 10.0)
    text = encode_announcement(said).rstrip(b"\n")
    for position in range(len(text)):
        line = bytearray(text)
        line[position] ^= 1
        assert parse_announcement(bytes(line)) is None


@pytest.mark.parametrize(
    "contacts", [MANY, [[[0, 0, 0]]], [[[0, 0, 0, 0, 1e999]]], [[["a", 0, 0, 0, 0]]], [1, 2], 7]
)
def test_contacts_that_cannot_be_are_no_announcement(contacts):
    body = b"# " + json.dumps({"number": 0, "seq": 0, "frames": 3, "contacts": contacts}).encode()
    assert parse_announcement(b"%s*%04X" % (body, crc16(body))) is None


@pytest.mark.parametrize(("count", "rate"), [(20, 10.0), (10, 20.0)])
def test_contacts_of_another_window_or_rate_are_left_out(count, rate):
    said = Announcement(0, 10, 100, LABELS, rate, np.zeros((count, 1, 5)))
    (gesture,) = announced(frames(range(120)), said, seconds=1.0)
    assert gesture.contacts is None
