"""Channels that mean nothing, at 100 Hz by hand."""

import numpy as np
import pytest

from skin.wire.channels import ChannelHealth, Reason

OK, SATURATED, STUCK, DEAD = 0, Reason.SATURATED, Reason.STUCK, Reason.DEAD


def check(health, frames, start=0.0):
    frames = np.asarray(frames, dtype=float)
    return np.array([health.check(row, start + position * 0.01) for position, row in enumerate(frames)])


def noisy(count, sensors=5):
    return np.random.default_rng(0).integers(500, 510, (count, sensors))


def test_a_value_at_a_limit_is_saturated():
    frames = noisy(3)
    frames[1, 2] = 1023
    expected = [[OK] * 5, [OK, OK, SATURATED, OK, OK], [OK] * 5]
    assert check(ChannelHealth((None, 1023)), frames).tolist() == expected
    assert check(ChannelHealth((0, None)), [[0.0, 1.0]]).tolist() == [[SATURATED, OK]]


@pytest.mark.parametrize("limits", [(None, 900.0), (None, None)])
def test_a_held_press_that_saturates_is_never_stuck(limits):
    """The channel does not change for 12 s, with a limit that is known and one that is not."""
    frames = noisy(1500)
    frames[200:230, 1] += np.linspace(0, 390, 30).astype(int)
    frames[230:1430, 1] = 900
    health = ChannelHealth(limits)
    masks = check(health, frames[:700])
    health.restart()  # the device starts anew under the press
    masks = np.concatenate([masks, check(health, frames[700:], 7.0)])
    assert (masks <= SATURATED).all()
    # A limit that is not declared shows after five seconds.
    first = 230 if limits[1] else 1230
    assert (masks[first:1430] == [OK, SATURATED, OK, OK, OK]).all()
    assert health.states() == ("ok",) * 5


def test_a_held_press_of_a_falling_channel_at_its_end_is_never_stuck():
    """The decoder knows that 0 is the end of a channel whose values fall with force."""
    frames = noisy(1500)
    frames[200:1400, 1] = 0
    health = ChannelHealth((None, 1023))
    rows = zip(frames.astype(float), frames == 0, strict=True)
    masks = np.array([health.check(row, n * 0.01, end) for n, (row, end) in enumerate(rows)])
    assert (masks[200:1400] == [OK, SATURATED, OK, OK, OK]).all()


def test_limits_may_come_late():
    health = ChannelHealth()
    assert health.check(np.array([1023.0]), 0.0) == OK
    health.limits = (None, 1023)
    assert health.check(np.array([1023.0]), 0.01) == SATURATED


def test_a_silence_makes_no_channel_stuck():
    """An untouched channel often has the same value behind a silence as before it."""
    frames, health = noisy(500), ChannelHealth()
    check(health, frames)
    assert not health.check(frames[-1].astype(float), 20.0).any()
    masks = check(health, np.where(np.arange(5) == 1, frames[-1], noisy(600)), 20.01)
    assert masks[-1, 1] == STUCK, "what stays is found after it"
    assert not masks[:, [0, 2, 3, 4]].any()


@pytest.mark.parametrize("state", ["dead", "stuck"])
def test_a_channel_that_stays_while_others_change(state):
    frames = noisy(700)
    frames[0, 1], frames[0 if state == "dead" else 3 :, 1] = 1, 77
    health = ChannelHealth()
    masks = check(health, frames)
    assert not masks[:500].any()
    assert (masks[520:] == [OK, DEAD if state == "dead" else STUCK, OK, OK, OK]).all()
    assert health.states() == ("ok", state, "ok", "ok", "ok")
    assert not health.check(np.array([500.0, 78, 500, 500, 500]), 7.0).any()


@pytest.mark.parametrize("alive", [1, 2])
def test_most_channels_dead_from_the_start_are_found_by_the_noise_of_the_others(alive):
    frames = noisy(700)
    frames[:, alive:] = 0
    health = ChannelHealth()
    masks = check(health, frames)
    assert not masks[:500].any()
    assert (masks[620:] == [OK] * alive + [DEAD] * (5 - alive)).all()
    assert health.check(np.array([500.0, 505, 1, 0, 0]), 7.0).tolist() == [OK, OK, OK, DEAD, DEAD]


def constant():
    """Return an untouched skin without visible noise, with a touch of two of five channels."""
    frames = np.full((2000, 5), 12)
    frames[900:950, :2] = 200
    return frames


def near_an_edge():
    """Return noise of a fifth of a count: only the value that rests near an edge ever changes."""
    draw = np.random.default_rng(0)
    return np.round(np.array([500.5, 77.0, 12.0, 300.1, 8.9]) + draw.normal(scale=0.1, size=(2000, 5)))


def short_touch():
    frames = np.zeros((2000, 5))
    frames[300:700, 0] = np.random.default_rng(0).integers(200, 210, 400)
    return frames


@pytest.mark.parametrize("make", [constant, near_an_edge, short_touch, lambda: np.zeros((3, 5))])
def test_a_skin_without_visible_noise_is_no_defect(make):
    assert not check(ChannelHealth((None, 1023)), make()).any()


def test_a_value_that_the_converter_cannot_give_is_unusable_at_once():
    health = ChannelHealth((None, 1023.0))
    health.largest = 1023.0
    found = health.check(np.array([500.0, -300.0, 1023.0, 65535.0, -3.0]), 0.0)
    assert found.tolist() == [OK, Reason.IMPOSSIBLE, SATURATED, Reason.IMPOSSIBLE, OK]
    assert health.states()[1] == "impossible"
