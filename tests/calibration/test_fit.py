"""Emulated devices with hidden constants: are these found, and what one channel tells?"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.calibration.bench import BenchData, BenchSession, build_bench_data, per_newton
from skin.calibration.channel import Channel, Loads, fit_channel
from skin.calibration.fit import estimate_force, evaluate_held_out, fit_calibration, print_calibration
from skin.calibration.known_loads import choose_presses, emulate_session, stair_gauge
from skin.calibration.wiring import find_quantum, measure_rest
from skin.device.calibration import Calibration, Curves, read_calibration, write_calibration
from skin.device.imperfection import Imperfection
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.solid import Solid
from skin.wire.channels import unit_conversion
from tests.budget import free

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
BODY = Sheet([0.16, 0.16], [32, 32], LAYERS)


def device(**hidden) -> Simulated:
    return Simulated(body=BODY, layout=Grid(2, 3), simulator=PlatesAndBeams, gain_spread=0.2, **hidden)


def session_of(skin: Simulated, bits: int | None = None) -> BenchData:
    randomness = np.random.default_rng(0)
    rows = stair_gauge(choose_presses(skin, randomness), idle=10.0)
    return build_bench_data(skin, emulate_session(skin, rows, randomness, bits))


SLOW = {"hysteresis": 0.05, "time_constant": 0.08, "drift": 0.002, "quantum": 0.01}


@pytest.fixture(scope="module", params=[{}, SLOW], ids=["plain", "slow"])
def known(request) -> tuple[Simulated, BenchData, Calibration]:
    skin = device(**request.param)
    found = session_of(skin)
    return skin, found, fit_calibration(found)


def test_hidden_constants_are_found(known):
    skin, _, found = known
    values, hidden = found.values(), {name: value.numpy() for name, value in skin.constants._asdict().items()}
    np.testing.assert_allclose(values["gain"], hidden["gain"], rtol=0.02)
    # 2 % of the range of offsets, whose deviation is 0.1 N: a share of an offset near 0 says nothing.
    np.testing.assert_allclose(values["offset"], hidden["offset"], atol=0.02 * 0.5)
    np.testing.assert_allclose(values["noise"], 0.05, rtol=0.1)
    np.testing.assert_allclose(values["drift"], hidden["drift"], atol=2e-4)
    np.testing.assert_allclose(values["time_constant"], hidden["time_constant"], rtol=0.05)
    np.testing.assert_allclose(values["hysteresis"], hidden["hysteresis"], rtol=0.1, atol=0.004)
    np.testing.assert_allclose(values["quantum"], hidden["quantum"], rtol=1e-3)
    np.testing.assert_allclose(values["clip"], 10, rtol=0.01)


def solid(**hidden) -> Simulated:
    body = Sheet([0.16, 0.16], [16, 16], [{"material": "EcoFlex 00-30", "thickness": 0.015}])
    return Simulated(body=body, layout=Grid(4, 4), simulator=Solid, **hidden)


def test_gains_are_not_trusted_where_sensors_are_not_where_the_layout_says():
    with free():  # the operator, which others use, too
        skin = solid(position_error=0.008)
    bench = session_of(skin)
    with pytest.warns(UserWarning, match="not where the layout says"):
        print_calibration(fit_calibration(bench), evaluate_held_out(bench, 0.25))


def test_held_out_presses_are_simulated_down_to_the_noise(known):
    _, found, _ = known
    outcome = evaluate_held_out(found, 0.25)
    assert len(outcome.held_out) == 3
    assert outcome.helps
    assert outcome.rmse["calibrated"] < 0.07 < 0.3 < min(outcome.rmse["simulated"], outcome.rmse["tared"])
    np.testing.assert_allclose(outcome.force, 1, atol=0.05)


def test_counts_become_newtons():
    skin = device()
    found = fit_calibration(session_of(skin, bits=12))
    per_newton_counts = 2**11 / (2 * 10)
    hidden = skin.constants.gain.numpy() * per_newton_counts
    np.testing.assert_allclose(found.values()["gain"] / found.scale, hidden, rtol=0.02)
    assert np.median(found.values()["gain"]) == pytest.approx(1, rel=1e-5)
    assert found.zero == pytest.approx(2**11, rel=0.05)
    np.testing.assert_allclose(found.values()["quantum"], found.scale, rtol=1e-3)


@pytest.mark.parametrize("indenter", ["blurred_disc", "disc"])
def test_the_press_of_the_report(tmp_path, indenter):
    """40 N on a disc of 20 mm radius over a sensor read 2 N (report 3.1.2): both ways, within 10 %."""
    sensor, plain = 2, device()
    position = plain.sensors.positions[[sensor], :2]
    each = per_newton(plain.model, BODY, stair_gauge(position, indenter=indenter, radius=0.02))[0]
    gains = np.linspace(0.6, 1.6, 6)
    gains[sensor] = 2.0 / (40 * each[sensor])
    hidden = {"gain": gains.tolist(), "offset": [0.3] * 6, "noise": [0.05] * 6, "clip": [10.0] * 6}
    skin = device(calibration=str(write_calibration(Calibration(hidden), tmp_path / "hidden.yaml")))
    found = fit_calibration(session_of(skin))
    raw = found.values()["offset"].copy()
    raw[sensor] += 2.0
    assert estimate_force(raw, each, found) == pytest.approx(40, rel=0.1)
    calibrated = Imperfection(noise=0, calibration=found)
    constants = calibrated.constants(6, np.random.default_rng(0))._replace(noise=torch.zeros(()))
    true = torch.from_numpy(40 * each).float()[None, None]
    said, *_ = calibrated.apply(true, constants, np.random.default_rng(0))
    assert said[0, 0, sensor] - found.values()["offset"][sensor] == pytest.approx(2.0, rel=0.1)


def test_broken_channels_are_named():
    skin = device(dead=1, stuck=1, saturated=1)
    found = fit_calibration(session_of(skin))
    levels = skin.constants.level.numpy()[skin.constants.dead.numpy()]
    where = np.flatnonzero(skin.constants.dead.numpy())
    kinds = {0.0: "dead", 10.0: "saturated"}
    named = {int(n): kinds.get(float(level), "stuck") for n, level in zip(where, levels, strict=True)}
    assert named == {n: kind for kind, numbers in found.broken.items() for n in numbers}
    assert found.ranges["dead"] == [0, 3]


def test_lost_frames_do_no_harm_and_a_channel_that_only_hums_is_dead():
    skin, rng = device(), np.random.default_rng(1)
    found = session_of(skin)
    found.session.raw[rng.random(found.session.raw.shape) < 0.1] = np.nan
    found.session.raw[:, 4] = 0.3 + 0.05 * rng.standard_normal(len(found.session.time))
    calibration, others = fit_calibration(found), [0, 1, 2, 3, 5]
    assert calibration.broken["dead"] == [4]
    hidden = skin.constants.gain.numpy()[others]
    np.testing.assert_allclose(calibration.values()["gain"][others], hidden, rtol=0.02)


def test_a_sensor_that_nothing_pressed_has_no_gain_of_its_own():
    skin = device()
    found = session_of(skin)
    spared = [n for n in range(len(found.gauge)) if found.each[n].argmax() != 3]
    assert fit_calibration(found, spared).sensors["gain"][3] is None


def test_what_cannot_be_calibrated_is_refused():
    skin = device()
    found = session_of(skin)
    with pytest.raises(InputError, match=r"6 channels, the layout 4 sensors"):
        build_bench_data(skin.replace(layout=Grid(2, 2)), found.session)
    silent = BenchData(found.session, found.gauge, found.each)
    silent.session.raw[:] = 0.05 * np.random.default_rng(0).standard_normal(silent.session.raw.shape)
    with pytest.raises(InputError, match=r"no channel responds to a press|strongest"):
        fit_calibration(silent)


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
    """A root amplifies the hum at rest, which says nothing of that under load."""
    hidden = {"noise": 0.0, "offset": 0.0, "clip": 100.0, **curve}
    bench, gain = bent(**hidden), device(**hidden).constants.gain.numpy()
    tables = dict.fromkeys(range(6), curve["table"]) if "table" in curve else {}
    curves = Curves(np.full(6, curve.get("exponent", 1.0)), np.full(6, 2.0), tables)
    hum = np.random.default_rng(0).normal(0, 0.05, bench.session.raw.shape)
    raw = curves.bend(curves.straighten(bench.session.raw) + gain * hum)
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


def hum(seed: int, spread: float, count: int = len(TIME)) -> np.ndarray:
    return spread * np.random.default_rng(seed).standard_normal(count)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.05, 0.08, 0.1])
def test_noise_is_found_under_steps_of_its_own_size(step):
    values = 3.21 + hum(0, 0.05)
    values = np.round(values / step) * step if step else values
    found = measure_rest(TIME, values, step)
    assert found["noise"] == pytest.approx(0.05, rel=0.06)
    assert found["offset"] == pytest.approx(3.21, abs=0.004)
    assert found["drift"] == 0


def test_one_outlier_in_ten_changes_little():
    values = hum(1, 0.05)
    values[::10] += 5
    found = measure_rest(TIME, values, 0.0)
    assert found["noise"] == pytest.approx(0.05, rel=0.2)
    assert abs(found["offset"]) < 0.01


def test_a_drift_is_told_from_none():
    found = measure_rest(TIME, 1.0 - 0.004 * TIME + hum(2, 0.05), 0.0)
    expected = [pytest.approx(1.0, abs=0.01), pytest.approx(-0.004, rel=0.05), pytest.approx(0.05, rel=0.05)]
    assert [found["offset"], found["drift"], found["noise"]] == expected
    assert sum(measure_rest(TIME, hum(seed, 0.05), 0.0)["drift"] != 0 for seed in range(40)) <= 6


def test_the_smallest_step_is_found_in_single_precision():
    values = np.round(hum(3, 1.0) / 0.07) * 0.07
    assert find_quantum(values.astype(np.float32)) == pytest.approx(0.07, rel=1e-3)
    assert find_quantum(np.round(8.4e6 + hum(3, 9.0))) == 1.0  # counts of 24 bits
    last = np.where(np.arange(100) % 2, 512.0, np.nextafter(np.float32(512), np.float32(600)))
    assert find_quantum(hum(3, 1.0)) == find_quantum(last) == 0


def channel(each, steps, shown) -> Channel | None:
    """Return the fit to presses of 50 N with a true reading ``each`` per N, N; ``shown(true, press)``."""
    gauge = stair_gauge(np.zeros((len(each), 2)), peak=50.0, steps=steps, idle=5.0)
    time = np.arange(round((gauge.time[-1] + 2) * 100)) / 100
    bench = BenchData(BenchSession(time, np.zeros((len(time), 1)), "N"), gauge, np.array(each)[:, None])
    values = shown(bench.true[:, 0], bench.applied[1]) + hum(5, 0.05, len(time))
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


@pytest.mark.parametrize("table", [[[0, 1], [0, 0]], [[1, 2], [0, 1]], "x", [[0, 1], [0, float("nan")]]])
def test_a_table_that_does_not_rise_is_refused(table):
    with pytest.raises(InputError, match=r"a calibration\.tables="):
        Calibration({"gain": [1.0]}, tables={0: table})
