"""What numbers mean, and when the skin was untouched."""

import numpy as np
import pytest

from skin.calibration.values import Calibration
from skin.errors import InputError
from skin.live.newtons import Newtons
from skin.port.frame import Frame
from skin.port.text import Header
from skin.session.newtons import newtons

REST = np.array([512.0, 300.0, 40.0])
RATE = 10.0  # Hz, of the model


def frames(values, start=0.0, rate=100.0):
    """Return frames of counts."""
    times = start + np.arange(len(values)) / rate
    return [Frame(None, t, t, row, np.ones(3, bool)) for t, row in zip(times, values, strict=True)]


def noisy(count, seed=0):
    """Return counts of an untouched skin."""
    return REST + np.random.default_rng(seed).integers(-1, 2, (count, 3))


def watched(scale=None, tare=1.0, known=None, header=None):
    """Return what turns the frames of three sensors into N."""
    meaning = lambda baseline, told: newtons(3, baseline, scale, known, told)  # noqa: E731
    return Newtons(meaning, tare, RATE, lambda: header)


def test_force_is_counted_from_the_first_quiet_second():
    watch = watched(scale=0.01)
    touched = noisy(150)
    touched[:, 1] += np.linspace(0, 400, 150)
    assert all(watch(one) is None for one in frames(touched))
    assert "touched: channel 1" in watch.waiting
    quiet = [watch(one) for one in frames(noisy(300), start=1.5)]
    first = next(number for number, one in enumerate(quiet) if one is not None)
    assert 90 <= first <= 180
    assert watch.waiting == ""
    pressed = watch(frames([REST + 200])[0])
    np.testing.assert_allclose(pressed.values, 2.0, atol=0.021)


def test_the_baseline_is_that_of_maxima_over_the_intervals_of_the_model():
    """The window shows maxima, of which an untouched skin's must be 0."""
    watch, rows = watched(scale=1.0), noisy(400)
    shown = [one.values for row in frames(rows) if (one := watch(row)) is not None]
    highest = np.stack(shown)[: len(shown) // 10 * 10].reshape(-1, 10, 3).max(axis=1)
    assert np.median(highest, axis=0).tolist() == [0, 0, 0]


def test_a_device_that_sends_newtons_says_so():
    watch = watched(tare=0, header=Header(unit="N"))
    np.testing.assert_allclose(watch(frames(np.array([[1.0, 2.0, 3.0]]))[0]).values, [1, 2, 3])


def test_a_device_may_tell_its_unit_a_little_late():
    told = []
    watch = Newtons(
        lambda baseline, header: newtons(3, baseline, None, None, header),
        0.0,
        RATE,
        lambda: told[0] if told else None,
    )
    assert watch(frames(noisy(1))[0]) is None
    assert watch.waiting == "waiting for the device to tell its unit"
    told.append(Header(unit="N"))
    assert watch(frames(noisy(1), start=0.5)[0]) is not None


def test_counts_without_a_scale_are_refused():
    with pytest.raises(InputError, match=r"sends adc, .* device\.scale="):
        watched(header=Header(unit="adc", bits=10))(frames(noisy(1))[0])
    watch = watched()
    with pytest.raises(InputError, match=r"values of no unit, .* device\.scale="):
        list(map(watch, frames(noisy(400))))


def test_a_tare_too_short_for_a_baseline_is_refused():
    watch = watched(scale=1.0, tare=0.5)
    with pytest.raises(InputError, match="10 frames, got 5: give more seconds"):
        list(map(watch, frames(noisy(200))))


def test_a_calibration_gives_scale_gains_and_broken_sensors():
    known = Calibration(
        {"gain": [0.5, 1.0, 1.0], "offset": [0.1, 0.2, 0.0]}, {"dead": [2]}, scale=0.02, zero=512
    )
    raw = np.array([612.0, 612.0, 0.0])
    one = watched(tare=0, known=known)(frames([raw])[0])
    np.testing.assert_allclose(one.values[:2], known.corrected(raw)[:2])
    assert one.valid.tolist() == [True, True, False]
