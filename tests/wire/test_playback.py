"""Recordings and the simulator behind the same interface."""

from itertools import count

import numpy as np
import pytest

from skin.device.resampling import Frame
from skin.runs.build import build_device
from skin.wire.reader import PlaybackFeed, SkinDisconnected
from skin.wire.skin import Source, play


@pytest.fixture(scope="module")
def touches(configured):
    device = build_device(configured("simulator=naive", "device.dead=1"))
    return device.replace(gestures=12).recording().touches


def test_touches_are_played_in_their_time_to_their_end(touches):
    feed, times = PlaybackFeed([touches[:4]]), count(100.0, 0.5)
    frames = [frame for _ in range(120) for frame in feed.poll(lambda: next(times))]
    with pytest.raises(EOFError):
        feed.poll(lambda: next(times))
    assert frames[5].t_host - frames[0].t_host == pytest.approx(0.5)
    played = np.stack([frame.values for frame in frames]).reshape(4, 30, 25)
    assert played == pytest.approx(touches[:4].readings.numpy())
    assert np.stack([frame.valid for frame in frames]).sum() == 120 * 24
    assert [frame.after for frame in frames[28:32]] == ["", "", "cut", ""]
    assert frames[-1].segment == 3


def test_a_skin_that_is_played_ends(touches):
    with play([touches[:1]]) as skin:
        assert len(list(skin)) == skin.stats.frames == 30
        with pytest.raises(SkinDisconnected, match="recording has ended"):
            skin.read(1)


def test_values_in_newtons_stay_what_they_are():
    values, valid = np.array([0.5, -1.0, 7.0]), np.array([True, True, False])
    source = Source.in_newtons("recording", None, 3)
    source.tare.add(Frame(0, 0.0, 0.0, values, valid))
    said, known = source.tare.conversion(values, valid)
    assert said.tolist() == [0.5, -1.0, 0.0]
    assert known.tolist() == valid.tolist()
