"""Channels that mean nothing, at 100 Hz by hand."""

import numpy as np
import pytest

from skin.port.health import Health


def judge(health, frames):
    return np.array(
        [health.valid(np.array(values, dtype=float), place * 0.01) for place, values in enumerate(frames)]
    )


def noisy(count, sensors=5):
    return np.random.default_rng(0).integers(500, 510, (count, sensors))


def test_a_value_at_a_limit_counts_again_once_it_leaves_it():
    frames = noisy(3)
    frames[1, 2] = 1023
    health = Health((None, 1023))
    assert judge(health, frames).tolist() == [[True] * 5, [True, True, False, True, True], [True] * 5]
    assert Health((0, None)).valid(np.array([0.0, 1.0]), 0.0).tolist() == [False, True]


def test_rest_at_zero_is_no_defect_unless_someone_says_so():
    assert Health((None, 1023)).valid(np.zeros(3), 0.0).all()


@pytest.mark.parametrize(("first", "state"), [(0, "dead"), (3, "stuck")])
def test_a_channel_that_stays_while_others_change(first, state):
    frames = noisy(700)
    frames[first:, 1] = 77
    frames[0, 1] = 77 if state == "dead" else 1
    health = Health()
    valid = judge(health, frames)
    assert valid[:500].all()
    assert not valid[520:, 1].any()
    assert valid[:, [0, 2, 3, 4]].all()
    assert health.states() == ("ok", state, "ok", "ok", "ok")
    assert health.valid(np.array([500, 78, 500, 500, 500]), 7.0).all()


def test_an_untouched_skin_without_visible_noise_is_no_defect():
    frames = np.full((2000, 5), 12)
    frames[900:950, :2] = 200  # a touch of two of five
    assert judge(Health(), frames).all()
