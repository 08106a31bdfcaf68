"""The largest recall that unknown gains allow."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from experiments.studies.alarm_floor import AlarmFloor, _log_density, log_likelihood_ratio
from skin.build import build_device
from skin.touch.gesture import GestureSettings


@pytest.mark.parametrize("seen", [9.0, 10.0, 11.0, 12.0, 13.0])
@pytest.mark.parametrize("spread", [0.05, 0.4])
def test_the_density_is_the_integral_over_pressures(seen, spread):
    low, high = 30e3, 90e3
    middle = float(np.clip(np.exp(seen), low, high))
    density, _ = quad(
        lambda pressure: norm.pdf(seen, np.log(pressure), spread) / (high - low), low, high,
        points=[middle], epsabs=0, limit=500,
    )  # fmt: skip
    arguments = (np.array([value]) for value in (seen, spread**2, low, high))
    found = float(_log_density(*arguments)[0])
    if density > 1e-200:
        assert found == pytest.approx(np.log(density), rel=1e-4)
    else:
        assert found < -400


def test_the_ratio_turns_at_the_threshold_and_a_touch_too_light_everywhere_is_safe():
    settings = GestureSettings()
    seen = np.log([60e3, 89e3, 92e3, 130e3, 40e3])
    share = np.array([1.0, 1.0, 1.0, 1.0, 0.4])
    found = log_likelihood_ratio(seen, np.full(5, 1e-4), share, settings)
    assert (found[:4] > 0).tolist() == [False, False, True, True]
    assert found[4] == -np.inf


def test_better_known_gains_and_more_sensors_find_more(configured):
    device = build_device(configured("simulator=naive", "data.gestures=20"))
    floor = AlarmFloor(gestures=4000)
    known, unknown = floor.recall(device, 0.02), floor.recall(device, 0.3)
    assert known[0][0] > 0.99
    for (best, _), (worst, _) in zip(known, unknown, strict=True):
        assert best > worst
    assert unknown[0][0] > unknown[1][0] + 0.05
