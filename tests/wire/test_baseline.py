"""Is the skin touched while its baseline is taken?"""

import numpy as np
import pytest

from skin.errors import InputError
from skin.wire.tare import SkinTouched, take_baseline

RNG = np.random.default_rng(3)
VALID = np.ones((100, 6), dtype=bool)


def idle(sigma=0.6):
    return np.round(np.linspace(400, 600, 6) + sigma * RNG.standard_normal((100, 6)))


def test_the_median_of_an_untouched_skin():
    assert take_baseline(idle(), VALID) == pytest.approx(np.linspace(400, 600, 6), abs=0.5)


@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0, 5.0])
def test_noise_is_no_touch(sigma):
    for _ in range(200):
        found = take_baseline(idle(sigma), VALID, np.linspace(400, 600, 6))
        assert found == pytest.approx(np.linspace(400, 600, 6), abs=max(sigma, 1e-9))


@pytest.mark.parametrize("first", [10, 50, 90])
def test_a_touch_that_comes_is_refused_and_named(first):
    values = idle()
    values[first:, 4] += 60
    with pytest.raises(InputError, match="channel 4 moved"):
        take_baseline(values, VALID)


def test_a_slow_touch_is_refused():
    values = idle()
    values[:, 2] += np.linspace(0, 30, 100)
    with pytest.raises(InputError, match="channel 2 moved"):
        take_baseline(values, VALID)


def test_a_hand_that_rests_is_seen_against_the_old_baseline():
    values, before = idle(), np.linspace(400, 600, 6)
    values[:, 1] += 40
    take_baseline(values, VALID)
    with pytest.raises(InputError, match="channel 1 differs from"):
        take_baseline(values, VALID, before)
    take_baseline(values, VALID, before, touch=50)


def test_a_channel_that_means_nothing_is_not_asked():
    values, valid = idle(), VALID.copy()
    values[50:, 3] = 1023
    valid[:, 3] = False
    asked = np.arange(6) != 3
    assert take_baseline(values, valid)[asked] == pytest.approx(np.linspace(400, 600, 6)[asked], abs=0.5)


def test_a_hand_that_strokes_all_the_time_is_no_noise():
    time = np.arange(200) / 100
    values = (
        500 + 30 * np.sin(2 * np.pi * time / 1.2)[:, None] + np.random.default_rng(0).normal(size=(200, 3))
    )
    with pytest.raises(SkinTouched, match="moved"):
        take_baseline(values[::10], np.ones((20, 3), dtype=bool))


def test_noise_is_no_hand():
    refused = 0
    for seed in range(200):
        try:
            take_baseline(np.random.default_rng(seed).normal(size=(20, 25)), np.ones((20, 25), dtype=bool))
        except SkinTouched:
            refused += 1
    assert refused <= 4
