"""Channels that mean nothing, at 100 Hz by hand."""

import numpy as np
import pytest

from skin.wire.channels import ChannelHealth


def check(health, frames):
    return np.array(
        [health.check(np.array(values, dtype=float), place * 0.01)[0] for place, values in enumerate(frames)]
    )


def noisy(count, sensors=5):
    return np.random.default_rng(0).integers(500, 510, (count, sensors))


def test_a_value_at_a_limit_is_saturated_and_valid():
    frames = noisy(3)
    frames[1, 2] = 1023
    health = ChannelHealth((None, 1023))
    found = [health.check(np.array(values, dtype=float), place * 0.01) for place, values in enumerate(frames)]
    assert np.array([valid for valid, _ in found]).all()
    assert [saturated.tolist() for _, saturated in found] == [
        [False] * 5,
        [False, False, True, False, False],
        [False] * 5,
    ]
    _, saturated = ChannelHealth((0, None)).check(np.array([0.0, 1.0]), 0.0)
    assert saturated.tolist() == [True, False]


@pytest.mark.parametrize("limits", [(None, 900.0), (None, None)])
def test_a_held_press_that_saturates_is_never_stuck(limits):
    """The channel does not change for 12 s, with a limit that is known and one that is not."""
    frames = noisy(1500).astype(float)
    frames[200:230, 1] += np.linspace(0, 390, 30)
    frames[230:1430, 1] = 900
    health = ChannelHealth(limits)
    for place, values in enumerate(frames):
        if place == 700:
            health.restart()  # the device starts anew under the press
        valid, saturated = health.check(values, place * 0.01)
        assert valid.all()
        # A limit that nobody told shows after five seconds.
        if (230 if limits[1] else 1230) <= place < 1430:
            assert saturated.tolist() == [False, True, False, False, False]
            assert health.states()[1] == "saturated"
    assert health.states() == ("ok",) * 5


def test_limits_may_come_late():
    health = ChannelHealth()
    assert not health.check(np.array([1023.0]), 0.0)[1].any()
    health.limits = (None, 1023)
    assert health.check(np.array([1023.0]), 0.01)[1].all()


def test_rest_at_zero_is_no_defect_unless_someone_says_so():
    valid, saturated = ChannelHealth((None, 1023)).check(np.zeros(3), 0.0)
    assert valid.all()
    assert not saturated.any()


@pytest.mark.parametrize(("first", "state"), [(0, "dead"), (3, "stuck")])
def test_a_channel_that_stays_while_others_change(first, state):
    frames = noisy(700)
    frames[first:, 1] = 77
    frames[0, 1] = 77 if state == "dead" else 1
    health = ChannelHealth()
    valid = check(health, frames)
    assert valid[:500].all()
    assert not valid[520:, 1].any()
    assert valid[:, [0, 2, 3, 4]].all()
    assert health.states() == ("ok", state, "ok", "ok", "ok")
    assert health.check(np.array([500, 78, 500, 500, 500]), 7.0)[0].all()


def test_a_silence_makes_no_channel_stuck():
    """An untouched channel often has the same value behind a silence as before it."""
    frames, health = noisy(500), ChannelHealth()
    check(health, frames)
    valid, _ = health.check(frames[-1].astype(float), 20.0)
    assert valid.all()
    frozen = np.where(np.arange(5) == 1, frames[-1], noisy(600))
    seen = [health.check(row.astype(float), 20.01 + n * 0.01)[0] for n, row in enumerate(frozen)]
    assert not seen[-1][1], "what stays is found after it"
    assert np.array(seen)[:, [0, 2, 3, 4]].all()


def test_an_untouched_skin_without_visible_noise_is_no_defect():
    frames = np.full((2000, 5), 12)
    frames[900:950, :2] = 200  # a touch of two of five
    assert check(ChannelHealth(), frames).all()


@pytest.mark.parametrize("alive", [1, 2])
def test_most_channels_dead_from_the_start_are_found_by_the_noise_of_the_others(alive):
    frames = noisy(700)
    frames[:, alive:] = 0
    health = ChannelHealth()
    valid = check(health, frames)
    assert valid[:500].all()
    assert not valid[620:, alive:].any()
    assert valid[:, :alive].all()
    assert health.states() == ("ok",) * alive + ("dead",) * (5 - alive)
    assert health.check(np.array([500, 505, 1, 0, 0]), 7.0)[0].tolist() == [True, True, True, False, False]


def test_a_channel_near_the_edge_of_a_step_makes_no_other_one_dead():
    """Noise of a fifth of a count: only the value that rests near an edge ever changes."""
    draw = np.random.default_rng(0)
    frames = np.round(np.array([500.5, 77.0, 12.0, 300.1, 8.9]) + draw.normal(scale=0.1, size=(2000, 5)))
    assert check(ChannelHealth(), frames).all()


def test_a_short_touch_of_a_skin_without_noise_makes_no_channel_dead():
    frames = np.zeros((2000, 5))
    frames[300:700, 0] = np.random.default_rng(0).integers(200, 210, 400)
    assert check(ChannelHealth(), frames).all()


def test_a_value_that_the_converter_cannot_give_is_invalid_at_once():
    health = ChannelHealth((None, 1023.0))
    health.largest = 1023.0
    valid, saturated = health.check(np.array([500.0, -300.0, 1023.0, 65535.0, -3.0]), 0.0)
    assert valid.tolist() == [True, False, True, False, True]
    assert saturated.tolist() == [False, False, True, False, False]
    assert health.states()[1] == "impossible"
