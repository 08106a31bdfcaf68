"""Emulated devices with hidden constants: are these found, and the report's press with them?"""

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.calibration.bench import BenchData, build_bench_data, per_newton
from skin.calibration.fit import estimate_force, evaluate_held_out, fit_calibration, print_calibration
from skin.calibration.known_loads import choose_presses, emulate_session, stair_gauge
from skin.device.calibration import Calibration, write_calibration
from skin.device.imperfection import Imperfection
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.solid import Solid
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
