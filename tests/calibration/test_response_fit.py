"""Responses that are no lines: is the hidden curve found, named, and undone on held-out presses?"""

from dataclasses import replace

import numpy as np
import pytest

from skin.calibration.bench import BenchData
from skin.calibration.fit import evaluate_held_out, fit_calibration, print_calibration
from skin.calibration.response_fit import fit_shape
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
    assert f"follow force^{exponent:.1f}"[:-1] in capsys.readouterr().out


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
    assert "follow a table" in capsys.readouterr().out


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


def test_a_response_of_noise_alone_has_no_shape():
    random = np.random.default_rng(0)
    true, press = np.tile(np.linspace(0.01, 2, 200), 2), np.repeat([0, 1], 200)
    assert fit_shape(true, random.normal(0, 0.1, 400), press, 0.1, 0.0).kind == "linear"


def test_curves_are_undone_exactly_and_below_zero_too():
    curves = Curves(np.array([0.5, 1.0, 1.3]), np.full(3, 2.0), {1: DIVIDER})
    linear = np.random.default_rng(1).uniform(-50, 50, (40, 3))
    np.testing.assert_allclose(curves.straighten(curves.bend(linear)), linear, rtol=1e-9)
    again = Curves.of_json(curves.to_json(), 3)
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
