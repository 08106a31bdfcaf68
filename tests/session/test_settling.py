"""The baseline waits for hands that are still on the skin, and for nothing else."""

import numpy as np
import pytest

from skin.errors import InputError
from skin.port.errors import SkinTouched
from skin.port.frame import Frame
from skin.session.settling import settle

RATE = 100.0  # Hz, of the device


class Played:
    """Hands out frames made before, as a skin does: ``force`` (F,) on the first of two channels."""

    def __init__(self, force, rate=RATE, segments=None):
        noise = np.random.default_rng(0).normal(scale=0.1, size=(len(force), 2))
        values = 500 + noise + np.column_stack([force, np.zeros(len(force))])
        segments = np.zeros(len(force), dtype=int) if segments is None else segments
        self.frames = [
            Frame(n, n / rate, n / rate, row, np.ones(2, dtype=bool), segment=int(segment))
            for n, (row, segment) in enumerate(zip(values, segments, strict=True))
        ]
        self.taken = 0

    def read(self, count):
        self.taken += count
        return self.frames[self.taken - count : self.taken]


def test_an_untouched_skin_gives_its_baseline_at_once():
    said = []
    frames, baseline = settle(Played(np.zeros(1000)), 10.0, 2.0, said.append)
    assert baseline == pytest.approx([500.0, 500.0], abs=0.3)
    assert 2.0 <= frames[-1].t <= 2.1
    assert len(said) == 1


def test_it_waits_until_the_skin_is_let_go():
    force = np.zeros(3000)
    force[50:420] = 80 * np.sin(np.linspace(0, 3 * np.pi, 370)) ** 2
    said = []
    frames, baseline = settle(Played(force), 10.0, 2.0, said.append)
    assert baseline == pytest.approx([500.0, 500.0], abs=0.3)
    # All frames are there, for a recording keeps them; the last two seconds of them are after the touch.
    assert [frame.seq for frame in frames] == list(range(len(frames)))
    assert 6.1 <= frames[-1].t <= 6.4
    assert said[1:] == ["the skin is touched: let go"]


def test_it_does_not_wait_for_ever():
    force = 80 * np.sin(np.arange(9000) / 40)
    with pytest.raises(SkinTouched, match="let go"):
        settle(Played(force), 10.0, 2.0, lambda _: None)


def test_a_short_tare_is_refused_at_once():
    played = Played(np.zeros(1000))
    with pytest.raises(InputError, match="10 frames, got 5"):
        settle(played, 10.0, 0.5, lambda _: None)
    assert played.taken < 150


def test_a_device_that_starts_anew_is_listened_to_anew():
    frames, _ = settle(Played(np.zeros(1000), segments=np.arange(1000) // 120), 10.0, 1.0, lambda _: None)
    assert frames[0].segment == 0
    frames, _ = settle(Played(np.zeros(1000), segments=np.arange(1000) > 70), 10.0, 1.0, lambda _: None)
    assert {frame.segment for frame in frames} == {1}


def test_without_tare_only_the_rate_is_read():
    frames, baseline = settle(Played(np.full(1000, 50.0)), 10.0, 0.0, lambda _: None)
    assert baseline is None
    assert frames[-1].t <= 1.1


def test_a_slow_device_is_refused():
    with pytest.raises(InputError, match="rate"):
        settle(Played(np.zeros(100), rate=4.0), 10.0, 2.0, lambda _: None)
