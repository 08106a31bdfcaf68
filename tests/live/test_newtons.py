"""What numbers mean, and when the skin was untouched."""

import numpy as np
import pytest

from skin.calibration.values import Calibration
from skin.errors import InputError
from skin.live.newtons import Newtons, Unit
from skin.port.frame import Frame
from skin.port.text import Header

REST = np.array([512.0, 300.0, 40.0])


def frames(values, start=0.0, rate=100.0):
    """Return frames of counts."""
    times = start + np.arange(len(values)) / rate
    return [Frame(None, t, t, row, np.ones(3, bool)) for t, row in zip(times, values, strict=True)]


def noisy(count, seed=0):
    """Return counts of an untouched skin."""
    return REST + np.random.default_rng(seed).integers(-1, 2, (count, 3))


def test_force_is_counted_from_the_first_quiet_second():
    newtons = Newtons(Unit(scale=0.01), lambda: None)
    touched = noisy(150)
    touched[:, 1] += np.linspace(0, 400, 150)
    assert all(newtons(one) is None for one in frames(touched))
    assert "touched: channel 1" in newtons.waiting
    quiet = [newtons(one) for one in frames(noisy(300), start=1.5)]
    first = next(number for number, one in enumerate(quiet) if one is not None)
    assert 90 <= first <= 180
    assert newtons.waiting == ""
    pressed = newtons(frames([REST + 200])[0])
    np.testing.assert_allclose(pressed.values, 2.0, atol=0.021)


def test_a_device_that_sends_newtons_says_so():
    newtons = Newtons(Unit(tare=0), lambda: Header(unit="N"))
    np.testing.assert_allclose(newtons(frames(np.array([[1.0, 2.0, 3.0]]))[0]).values, [1, 2, 3])


def test_counts_without_a_scale_are_refused():
    with pytest.raises(InputError, match=r"sends adc, not N: give live\.scale=N_PER_COUNT"):
        Newtons(Unit(), lambda: Header(unit="adc", bits=10))(frames(noisy(1))[0])
    newtons = Newtons(Unit(), lambda: None)
    with pytest.raises(InputError, match=r"does not tell what its numbers mean"):
        list(map(newtons, frames(noisy(400))))


def test_a_calibration_gives_scale_gains_and_broken_sensors():
    known = Calibration(
        {"gain": [0.5, 1.0, 1.0], "offset": [0.1, 0.2, 0.0]}, {"dead": [2]}, scale=0.02, zero=512
    )
    newtons = Newtons(Unit(tare=0), lambda: None, known)
    raw = np.array([612.0, 612.0, 0.0])
    one = newtons(frames([raw])[0])
    np.testing.assert_allclose(one.values[:2], known.corrected(raw)[:2])
    assert one.valid.tolist() == [True, True, False]


@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"tare": -1.0}])
def test_units_that_mean_nothing_are_refused(wrong):
    with pytest.raises(InputError, match=r"live\.scale must be above 0"):
        Unit(**wrong)
