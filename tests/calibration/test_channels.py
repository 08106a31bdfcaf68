"""Statistics of one channel, on samples whose parameters are known."""

import numpy as np
import pytest

from skin.calibration.fit import fit_clip_and_gain, fit_decay
from skin.calibration.wiring import find_quantum, measure_idle

TIME = np.arange(6000) / 100


def noise(seed: int, spread: float) -> np.ndarray:
    return spread * np.random.default_rng(seed).standard_normal(len(TIME))


@pytest.mark.parametrize("step", [0.0, 0.01, 0.05, 0.08, 0.1])
def test_noise_is_found_under_steps_of_its_own_size(step):
    values = 3.21 + noise(0, 0.05)
    values = np.round(values / step) * step if step else values
    found = measure_idle(TIME, values, step)
    assert found.noise == pytest.approx(0.05, rel=0.06)
    assert found.offset == pytest.approx(3.21, abs=0.004)
    assert found.drift == 0


def test_one_outlier_in_ten_changes_little():
    values = noise(1, 0.05)
    values[::10] += 5
    found = measure_idle(TIME, values, 0.0)
    assert found.noise == pytest.approx(0.05, rel=0.2)
    assert abs(found.offset) < 0.01


def test_a_drift_is_told_from_none():
    found = measure_idle(TIME, 1.0 - 0.004 * TIME + noise(2, 0.05), 0.0)
    assert found.drift == pytest.approx(-0.004, rel=0.05)
    assert found.offset == pytest.approx(1.0, abs=0.01)
    assert found.noise == pytest.approx(0.05, rel=0.05)
    wrong = sum(measure_idle(TIME, noise(seed, 0.05), 0.0).drift != 0 for seed in range(40))
    assert wrong <= 6


def test_the_smallest_step_is_found_in_single_precision():
    values = np.round(noise(3, 1.0) / 0.07) * 0.07
    assert find_quantum(values.astype(np.float32)) == pytest.approx(0.07, rel=1e-3)
    assert find_quantum(noise(3, 1.0)) == 0


def test_a_decay_gives_its_time_constant():
    values = 8 * np.exp(-TIME / 0.12) + noise(4, 0.05)
    assert fit_decay(TIME, values, 0.4)[0] == pytest.approx(0.12, rel=0.03)
    assert fit_decay(TIME, noise(4, 0.05), 0.4) == (0.0, 0.0)


@pytest.mark.parametrize("limit", [None, 6.0])
def test_gain_and_plateau(limit):
    true = np.repeat([0.5, 1.0, 3.0, 5.0, 8.0, 10.0], 1000)
    said = np.minimum(1.3 * true, limit or np.inf) + noise(5, 0.05)
    said[::20] = 0.0
    gain, error, found = fit_clip_and_gain(true, said, 0.05)
    assert gain == pytest.approx(1.3, rel=0.01)
    assert error < 0.02
    assert found == (None if limit is None else pytest.approx(limit, abs=0.01))


def test_the_gain_is_found_from_two_presses_with_one_force_each_below_the_limit():
    """Off the layout by a millimetre, the stronger press may be the weaker one in the simulation."""
    true = np.repeat([4.81, 4.62, 47.0], 2000)
    measured = np.minimum(np.repeat([4.89, 4.94, 47.0], 2000), 10.0) + noise(6, 0.05)
    gain, error, limit = fit_clip_and_gain(true, measured, 0.05)
    assert 4.89 / 4.81 <= gain <= 4.94 / 4.62
    assert error < 0.01
    assert limit == pytest.approx(10, rel=0.01)


def test_a_channel_at_its_limit_has_no_gain():
    true = np.repeat([20.0, 30.0, 40.0], 2000)
    gain, _, limit = fit_clip_and_gain(true, 10.0 + noise(7, 0.05), 0.05)
    assert np.isnan(gain)
    assert limit == pytest.approx(10, rel=0.01)


def test_a_limit_is_found_where_only_the_first_step_is_below_it():
    true = np.repeat([4.8, 9.6, 47.0], 2000)
    gain, _, limit = fit_clip_and_gain(true, np.minimum(1.6 * true, 10.0) + noise(8, 0.05), 0.05)
    assert gain == pytest.approx(1.6, rel=0.01)
    assert limit == pytest.approx(10, rel=0.01)


def test_values_that_differ_in_the_last_digit_alone_have_no_step():
    values = np.where(np.arange(100) % 2, 512.0, np.nextafter(np.float32(512), np.float32(600)))
    assert find_quantum(values) == 0
