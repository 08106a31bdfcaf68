"""One channel: statistics of its rest, gain and limit from few steps, and hidden curves found and undone."""

from dataclasses import replace

import numpy as np
import pytest

from skin.calibration.bench import BenchData, BenchSession
from skin.calibration.channel import Channel, Loads, fit_channel
from skin.calibration.fit import evaluate_held_out, fit_calibration, print_calibration
from skin.calibration.known_loads import stair_gauge
from skin.calibration.wiring import find_quantum, measure_rest
from skin.device.calibration import Calibration, Curves, read_calibration, write_calibration
from skin.errors import InputError
from skin.wire.channels import unit_conversion
from tests.calibration.test_fit import device, session_of

# A voltage divider: the value tends to 16 N, and its slope falls from 1 to 0.14 at 10 N.
FORCES = np.linspace(0, 40, 60)
DIVIDER = [FORCES.tolist(), (16 * FORCES / (FORCES + 16)).tolist()]


def bent(**hidden) -> BenchData:
    return session_of(device(**{"offset": 0.02, "noise": 0.02} | hidden))


@pytest.mark.parametrize("exponent", [0.5, 0.7, 1.4])
def test_a_power_law_is_found_and_named(exponent, capsys):
    bench = bent(exponent=exponent)
    calibration, outcome = fit_calibration(bench), evaluate_held_out(bench, 0.25)
    np.testing.assert_allclose(calibration.sensors["exponent"], exponent, rtol=0.04)
    np.testing.assert_allclose(outcome.force, 1, atol=0.03)
    print_calibration(calibration, outcome)
    assert f"exponent           {exponent:.1f}"[:-1] in capsys.readouterr().out


@pytest.mark.parametrize("curve", [{"exponent": 0.5}, {"table": DIVIDER}])
def test_the_noise_of_a_curved_sensor_is_that_of_its_force(curve):
    """A root amplifies the noise at rest, which says nothing of that under load."""
    hidden = {"noise": 0.0, "offset": 0.0, "clip": 100.0, **curve}
    bench, gain = bent(**hidden), device(**hidden).constants.gain.numpy()
    tables = dict.fromkeys(range(6), curve["table"]) if "table" in curve else {}
    curves = Curves(np.full(6, curve.get("exponent", 1.0)), np.full(6, 2.0), tables)
    noise = np.random.default_rng(0).normal(0, 0.05, bench.session.raw.shape)
    raw = curves.bend(curves.straighten(bench.session.raw) + gain * noise)
    calibration = fit_calibration(replace(bench, session=replace(bench.session, raw=raw)))
    assert calibration.curves is not None
    fitted = calibration.known("noise") / calibration.curves.slopes / calibration.known("gain")
    np.testing.assert_allclose(fitted, 0.05, rtol=0.15)


def test_a_table_is_found_where_no_power_law_fits(capsys):
    bench = bent(table=DIVIDER, clip=100.0)
    calibration, outcome = fit_calibration(bench), evaluate_held_out(bench, 0.25)
    assert set(calibration.tables) == set(range(6))
    np.testing.assert_allclose(outcome.force, 1, atol=0.03)
    print_calibration(calibration, outcome)
    assert "curved, as in a table: sensors 0, 1, 2, 3, 4 and 5" in capsys.readouterr().out


def test_the_same_response_with_lag_hysteresis_and_falling_values():
    bench = bent(exponent=0.5, time_constant=0.08, hysteresis=0.03, polarity=-1)
    calibration, outcome = fit_calibration(bench), evaluate_held_out(bench, 0.25)
    assert (calibration.signs == -1).all()
    np.testing.assert_allclose(calibration.sensors["exponent"], 0.5, rtol=0.06)
    np.testing.assert_allclose(calibration.sensors["time_constant"], 0.08, rtol=0.15)
    np.testing.assert_allclose(outcome.force, 1, atol=0.05)


@pytest.mark.parametrize("hidden", [{}, {"hysteresis": 0.05, "time_constant": 0.08}, {"clip": 4.0}])
def test_a_line_stays_a_line(hidden):
    calibration = fit_calibration(session_of(device(**hidden)))
    assert calibration.curves is None
    assert "exponent" not in calibration.sensors


TIME = np.arange(6000) / 100


def noise(seed: int, spread: float, count: int = len(TIME)) -> np.ndarray:
    return spread * np.random.default_rng(seed).standard_normal(count)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.05, 0.08, 0.1])
def test_noise_is_found_under_steps_of_its_own_size(step):
    values = 3.21 + noise(0, 0.05)
    values = np.round(values / step) * step if step else values
    found = measure_rest(TIME, values, step)
    assert found["noise"] == pytest.approx(0.05, rel=0.06)
    assert found["offset"] == pytest.approx(3.21, abs=0.004)
    assert found["drift"] == 0


def test_one_outlier_in_ten_changes_little():
    values = noise(1, 0.05)
    values[::10] += 5
    found = measure_rest(TIME, values, 0.0)
    assert found["noise"] == pytest.approx(0.05, rel=0.2)
    assert abs(found["offset"]) < 0.01


def test_a_drift_is_told_from_none():
    found = measure_rest(TIME, 1.0 - 0.004 * TIME + noise(2, 0.05), 0.0)
    expected = [pytest.approx(1.0, abs=0.01), pytest.approx(-0.004, rel=0.05), pytest.approx(0.05, rel=0.05)]
    assert [found["offset"], found["drift"], found["noise"]] == expected
    assert sum(measure_rest(TIME, noise(seed, 0.05), 0.0)["drift"] != 0 for seed in range(40)) <= 6


def test_the_smallest_step_is_found_in_single_precision():
    values = np.round(noise(3, 1.0) / 0.07) * 0.07
    assert find_quantum(values.astype(np.float32)) == pytest.approx(0.07, rel=1e-3)
    assert find_quantum(noise(3, 1.0)) == 0
    last = np.where(np.arange(100) % 2, 512.0, np.nextafter(np.float32(512), np.float32(600)))
    assert find_quantum(last) == 0


def channel(each, steps, shown) -> Channel | None:
    """Return the fit to presses of 50 N with a true reading ``each`` per N, N; ``shown(true, press)``."""
    gauge = stair_gauge(np.zeros((len(each), 2)), peak=50.0, steps=steps, idle=5.0)
    time = np.arange(round((gauge.time[-1] + 2) * 100)) / 100
    bench = BenchData(BenchSession(time, np.zeros((len(time), 1)), "N"), gauge, np.array(each)[:, None])
    values = shown(bench.true[:, 0], bench.applied[1]) + noise(5, 0.05, len(time))
    values[::20] = np.nan
    return fit_channel(Loads(bench, range(len(each))), bench.each[:, 0], values, 0.05)


@pytest.mark.parametrize("limit", [np.inf, 15.8, 6.0, 3.0])
def test_gain_and_limit(limit):
    """At 3 N, only the first step is below it; 15.8 N is hardly reached."""
    found = channel([0.2, 0.19], (0.1, 0.2, 0.5, 1.0), lambda true, _: np.minimum(1.6 * true, limit))
    assert found.kind == "linear"
    assert found.gain(1.0) == pytest.approx(1.6, rel=0.01)
    assert found.error < 0.02
    assert found.clip == pytest.approx(np.nan if limit > 15 else limit, rel=0.01, nan_ok=True)


def test_the_gain_is_between_those_of_presses_that_disagree():
    """Off the layout by a millimetre, the stronger press may be the weaker one in the simulation."""
    factors = np.array([0.98, 1.07, 1.0])
    found = channel([0.96, 0.92], (0.1, 0.2, 1.0), lambda true, n: np.minimum(true * factors[n], 10.0))
    assert 0.98 <= found.gain(1.0) <= 1.07
    assert found.clip == pytest.approx(10, rel=0.01)


def test_a_channel_at_its_limit_or_of_noise_alone_has_no_gain():
    found = channel([1.0], (0.4, 0.7, 1.0), lambda true, _: np.minimum(100 * true, 10.0))
    assert not found.known
    assert found.clip == pytest.approx(10, rel=0.01)
    assert channel([0.2, 0.2], (0.2, 1.0), lambda true, _: 0 * true) is None


def test_curves_are_undone_exactly_and_below_zero_too():
    curves = Curves(np.array([0.5, 1.0, 1.3]), np.full(3, 2.0), {1: DIVIDER})
    linear = np.random.default_rng(1).uniform(-50, 50, (40, 3))
    np.testing.assert_allclose(curves.straighten(curves.bend(linear)), linear, rtol=1e-9)
    again = Curves.of_json(curves.to_json())
    np.testing.assert_array_equal(again.bend(linear), curves.bend(linear))


def test_a_live_device_is_converted_by_the_curves_of_its_file(tmp_path):
    sensors = {"gain": [0.8, 1.2], "offset": [0.1, -0.2], "exponent": [0.5, 1.0]}
    whole = Calibration(sensors, scale=0.02, zero=100.0, exponent_at=3.0, tables={1: DIVIDER})
    stored = read_calibration(write_calibration(whole, tmp_path / "mine.yaml"))
    assert stored == whole
    conversion = unit_conversion(2, None, None, stored, None)
    force = np.array([[0.0, 0.0], [1.0, 2.0], [7.0, 9.0]])
    raw = conversion.raw(force)
    # By hand: the gain, the curve, the offset, the scale.
    assert raw[1, 0] == pytest.approx(100 + (0.1 + 3 * np.sqrt(0.8 / 3)) / 0.02)
    np.testing.assert_allclose(conversion(raw, np.ones(raw.shape, bool))[0], force, atol=1e-5)
    np.testing.assert_allclose(stored.corrected(raw), force, atol=1e-9)


@pytest.mark.parametrize(
    "table", [[[0, 1], [0, 0]], [[1, 2], [0, 1]], [[0, 1]], "x", [[0, 1], [0, float("nan")]]]
)
def test_a_table_that_does_not_rise_is_refused(table):
    with pytest.raises(InputError, match=r"a calibration\.tables="):
        Calibration({"gain": [1.0]}, tables={0: table})
