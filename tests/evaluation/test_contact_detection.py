"""Contact in time: no touch may become the baseline."""

import numpy as np
import pytest

from skin.evaluation.decisions import DRIFT, ContactDetector

RATE, WINDOW = 10.0, 30
THRESHOLD = 0.25  # N


def follow(contact, force, noise=0.0, valid=None):
    """Show a stream (F, S), N, window by window; return whether there was contact at each frame."""
    force = force + noise * np.random.default_rng(0).standard_normal(force.shape)
    known = np.ones(force.shape, dtype=bool) if valid is None else valid
    pad = np.zeros((WINDOW - 1, force.shape[1]))
    rows = np.concatenate([pad, force])
    marks = np.concatenate([pad == 0, known])
    return [contact.update(rows[n : n + WINDOW], marks[n : n + WINDOW], n / RATE) for n in range(len(force))]


def on(first, *levels, sensors=3):
    """Return a stream: ``first`` on sensor 1 as (N, frames) pairs."""
    column = np.concatenate([np.full(count, level) for level, count in (first, *levels)])
    force = np.zeros((len(column), sensors))
    force[:, 1] = column
    return force


@pytest.mark.parametrize("seconds", [1, 10, 600])
@pytest.mark.parametrize("load", [0.3, 5.0])
def test_a_held_press_is_a_contact_until_it_is_released(seconds, load):
    contact, frames = ContactDetector(3, RATE, THRESHOLD), int(seconds * RATE)
    said = follow(contact, on((0, 40), (load, frames), (0, 20)), noise=0.02)
    assert not any(said[:40])
    assert all(said[40 : 40 + frames])
    # It ends 0.3 s after the last frame of the press.
    assert not any(said[40 + frames + 3 :])
    assert np.abs(contact.baseline).max() < 0.02


def test_it_tells_since_when():
    contact = ContactDetector(3, RATE, THRESHOLD)
    follow(contact, on((0, 40), (1.0, 50)))
    assert contact.since == pytest.approx(4.0)
    # A view that looks late finds the beginning in its window.
    late = ContactDetector(3, RATE, THRESHOLD)
    rows = on((0, 10), (1.0, 20))
    late.update(rows, rows >= 0, 2.9)
    assert late.since == pytest.approx(1.0, abs=0.11)


def test_a_slow_ramp_does_not_become_the_baseline():
    contact = ContactDetector(3, RATE, THRESHOLD)
    ramp = np.zeros((140, 3))
    ramp[40:, 1] = np.linspace(0, 5, 100)
    said = follow(contact, ramp)
    first = said.index(True)
    assert ramp[first, 1] <= THRESHOLD + 0.06
    assert all(said[first:])


def test_the_baseline_follows_drift_up_to_the_bound_and_no_faster():
    slow, fast = (ContactDetector(1, RATE, 0.05) for _ in range(2))
    drift = DRIFT * np.arange(int(200 * RATE))[:, None] / RATE
    assert 0.95 * drift[-1] > 0.06  # N; without a baseline that follows, the slow one would be contact too
    assert not any(follow(slow, 0.95 * drift, noise=0.005))
    assert any(follow(fast, 2.5 * drift, noise=0.005))


def test_nothing_moves_while_something_touches():
    contact = ContactDetector(2, RATE, THRESHOLD)
    force = np.zeros((int(120 * RATE), 2))
    force[:, 0] = 1.0
    force[:, 1] = np.linspace(0, 0.2, len(force))  # drifts beside the touch
    follow(contact, force)
    assert not contact.baseline.any()


def test_a_tare_under_a_load_does_not_hide_the_next_touch():
    contact = ContactDetector(3, RATE, THRESHOLD)
    # A weight of 2 N lay there while the tare was taken; it is lifted, then something presses with 1.5 N.
    said = follow(contact, on((0, 40), (-2.0, 100), (-0.5, 20)), noise=0.02)
    assert not any(said[:140])
    assert all(said[141:])


def test_a_sensor_that_fails_in_a_contact_does_not_end_it():
    contact, force = ContactDetector(3, RATE, THRESHOLD), on((0, 40), (5.0, 20), (5.0, 100), (0, 20))
    valid = np.ones(force.shape, dtype=bool)
    valid[60:160, 1] = False
    said = follow(contact, force, valid=valid)
    assert all(said[40:160])
    # Valid again, it must be at rest for a second.
    assert all(said[160:168])
    assert not any(said[171:])


def test_a_touch_lowers_a_channel_along_the_surface_and_is_over_when_it_ends():
    values = np.zeros((60, 3))
    values[20:40] = -2.0, 0.0, 3.0
    for along in (False, np.array([True, True, False])):
        detector = ContactDetector(3, 20.0, 0.3, along=along)
        for end in range(10, 61):
            detector.update(values[end - 10 : end], np.ones((10, 3), bool), end / 20)
        fallen = detector.void.any() or detector.falls(values, np.ones((60, 3), bool)).any()
        assert bool(fallen) != np.any(along)
        assert detector.since is None


def test_a_new_tare_ends_a_contact():
    contact = ContactDetector(3, RATE, THRESHOLD)
    follow(contact, on((0, 40), (1.0, 50)))
    contact.reset(np.zeros(3, dtype=bool))
    assert contact.since is None
    assert not any(follow(contact, on((0, 40))))
