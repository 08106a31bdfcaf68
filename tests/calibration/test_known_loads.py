"""Calibration without a gauge: sessions of hidden devices, found placements, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.body.arm import Arm
from skin.body.base import Sensors, Sheet
from skin.body.layout import Grid
from skin.calibration.bench import BenchSession, BenchSettings, build_bench_data
from skin.calibration.fit import fit_presses, print_calibration
from skin.calibration.known_loads import (
    GRAVITY,
    KnownLoad,
    base_readings,
    choose_presses,
    emulate_placements,
    emulate_session,
    find_placements,
    firm_readings,
    fit_known_load,
    stair_gauge,
)
from skin.calibration.wiring import list_numbers, ordered
from skin.device.calibration import write_calibration
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.evaluation.alarm import _remaining
from skin.mechanics.simulator.solid import Solid
from skin.touch.fingertips import read_touch
from skin.wire.channels import AGREES
from tests.budget import free
from tests.calibration.test_fit import device, solid

WEIGHT = KnownLoad(2.0, 0.02)
ORDER = [3, 0, 5, 1, 4, 2]


def weight_readings(skin) -> np.ndarray:
    return base_readings(skin.model, skin.body, skin.sensors, WEIGHT)[0]


def weighed(skin, order, bits=None) -> BenchSession:
    readings = weight_readings(skin)[order]
    return emulate_placements(skin, readings, np.random.default_rng(0), bits, idle=5.0)


@pytest.mark.parametrize("hidden", [{}, {"polarity": -1, "quantum": 0.01}, {"time_constant": 0.1}])
def test_a_weight_in_any_order_gives_the_gains(hidden):
    skin = device(**hidden)
    calibration = fit_known_load(device(), weighed(skin, ORDER + ORDER[::-1]), WEIGHT)
    assert calibration.about["placements"] == 12
    np.testing.assert_allclose(calibration.known("gain"), skin.constants.gain, rtol=0.08)
    assert (calibration.signs == skin.imperfection.polarity).all()


def test_counts_are_converted_to_newtons_of_the_same_force():
    skin = device(noise=0.02)
    calibration = fit_known_load(device(), weighed(skin, ORDER, bits=12), WEIGHT)
    true = weight_readings(skin)[0]
    gain, offset = skin.constants.gain.numpy(), skin.constants.offset.numpy()
    raw = np.round(2**11 + (true * gain + offset) / (20 / 2**11))
    np.testing.assert_allclose(calibration.corrected(raw)[0], true[0], rtol=0.05)


def test_sensors_of_unknown_gain_are_dead_and_a_lag_is_expected(capsys, tmp_path):
    skin = solid(dead=1, noise=0.002, offset=0.0)
    dead = int(np.flatnonzero(skin.constants.dead)[0])
    left_out, floating = (dead + 5) % 16, (dead + 9) % 16
    session = weighed(skin, [n for n in range(16) if n != left_out])
    session.raw[:, floating] = 0.6 * session.raw[:, floating - 1]  # as behind a multiplexer
    calibration = fit_known_load(solid(), session, WEIGHT)
    path = str(write_calibration(calibration, tmp_path / "mine.yaml"))
    # What a weight does not show must not break the promise of the alarm.
    assert [_remaining(path, False, bounded)["time_constant"] for bounded in (False, True)] == [0, 0.1]
    print_calibration(calibration)
    numbers = list_numbers(sorted([dead, left_out, floating]))
    assert f"dead or never loaded: sensors {numbers} (from 0)" in capsys.readouterr().out


def test_half_a_session_is_refused_and_names_the_sensors():
    skin = solid()
    with pytest.raises(InputError, match="sensors 8, 9, 10, 11, 12, 13, 14 and 15 were never loaded"):
        fit_known_load(solid(), weighed(skin, list(range(8))), WEIGHT)


@pytest.mark.parametrize(
    ("bits", "slope", "rail"), [(10, 450, 1023), (None, -450, 1023), (10, 440, 1000), (None, 105, 255)]
)
def test_a_sensor_at_its_limit_is_refused_until_it_is_left_out(bits, slope, rail):
    skin = solid(noise=0.01, gain_spread=0.3, offset=0.0)
    session = weighed(skin, list(range(16)))
    raw = np.clip(np.round(rail * (slope < 0) + np.sign(slope) * 20 + slope * session.raw), 0, rail)
    known = raw >= rail if rail == 1000 else None  # by the device's own limits
    session, full = replace(session, raw=raw, unit="adc", bits=bits, saturated=known), [3, 7, 15]
    reason = r"sensors 3, 7 and 15 .* at their limit.* lighter weight .*'calibrate\.broken=\[3,7,15\]'"
    with pytest.raises(InputError, match=reason):
        fit_known_load(solid(), session, WEIGHT)
    found = fit_known_load(solid(), ordered(session, BenchSettings(broken=full)), WEIGHT)
    ratios = np.delete(found.values()["gain"] / skin.constants.gain.numpy(), full)
    np.testing.assert_allclose(ratios / np.median(ratios), 1, atol=0.02)
    assert found.broken["dead"] == full


def thick(thickness: float, **hidden) -> Simulated:
    body = Sheet([0.09, 0.09], [9, 9], [{"material": "EcoFlex 00-30", "thickness": thickness}])
    return Simulated(body=body, layout=Grid(3, 3, depth=thickness * 2 / 3), simulator=Solid, **hidden)


def test_a_wrong_thickness_is_named_with_the_one_that_fits_and_a_right_one_is_not():
    hidden, thickness = {"gain_spread": 0.3, "position_error": 0.001}, "thickness that fits"
    right, wrong = (weighed(thick(true, **hidden), [*range(9)] * 2) for true in (0.030, 0.024))
    assert thickness not in fit_known_load(thick(0.030), right, WEIGHT).about
    with pytest.warns(UserWarning, match="better than the described 30 mm"):
        found = fit_known_load(thick(0.030), wrong, WEIGHT)
    assert found.about[thickness] == pytest.approx(0.024, rel=0.06)


def test_presses_of_a_gauge_name_it_too():
    described, true, generator = thick(0.030), thick(0.024, gain_spread=0.3), np.random.default_rng(0)
    gauge = stair_gauge(choose_presses(true, generator), 60.0, rate=20.0)
    whole = emulate_session(true, gauge, generator)  # the last press is lost
    bench = build_bench_data(described, BenchSession(whole.time[:-150], whole.raw[:-150], "N", gauge))
    with pytest.warns(UserWarning, match="than the described 30 mm"):
        found = fit_presses(described, bench, 0.25, known_unit=True)[0].about["thickness that fits"]
    assert found == pytest.approx(0.024, rel=0.06)


INCLINED = KnownLoad.of(4.0, 0.02, (0.16, 0.16), 20, [45, 225], 0.005)


def test_sensors_that_cover_a_plane_feel_the_weight_along_and_across_an_incline(monkeypatch):
    # A base near the rim is far from the sensor.
    monkeypatch.setattr("skin.calibration.known_loads._ALONG", 0.0)
    places = np.stack(np.meshgrid(*2 * [0.01 * np.arange(6) + 0.005]), axis=-1).reshape(-1, 2)
    positions = np.column_stack([places, np.full(36, 0.009)]).repeat(3, axis=0)
    sensors = Sensors(positions, (0.01, 0.01), directions=np.tile(np.eye(3), (36, 1)))
    body = Sheet([0.06, 0.06], [12, 12], [{"material": "EcoFlex 00-30", "thickness": 0.01}])
    load = KnownLoad(2 / GRAVITY, 0.02, 30, [45, 120])
    sums = base_readings(Solid(body, sensors), body, sensors, load)[:, 14].reshape(2, 36, 3).sum(axis=1)
    slope = np.radians([45, 120])
    expected = np.column_stack([np.cos(slope), np.sin(slope), np.full(2, 3**0.5)])  # 2 N sin 30, 2 N cos 30
    np.testing.assert_allclose(sums, expected, atol=0.02)


def three_axes(**hidden) -> Simulated:
    body = Sheet([0.16, 0.16], [16, 16], [{"material": "EcoFlex 00-30", "thickness": 0.015}])
    layout = Grid(3, 3, depth=0.005, axes="three")
    return Simulated(body=body, layout=layout, simulator=Solid, noise=0.02, **hidden)


def test_a_weight_gives_normal_gains_and_one_on_an_incline_those_along_the_surface():
    """One axis of a site is inverse."""
    skin, turned = three_axes(gain_spread=0.3), np.where(np.arange(27) == 3, -1, 1)
    for load, axes in ((WEIGHT, slice(2, 3)), (INCLINED, slice(0, 3))):
        with free():  # the operator
            expected = base_readings(skin.model, skin.body, skin.sensors, load)
        rows = np.vstack([np.random.default_rng(0).permutation(turn) for turn in expected])
        session = emulate_placements(skin, rows, np.random.default_rng(0))
        session.raw[:] *= turned
        found = fit_known_load(three_axes(), session, load)
        gains = np.array(found.sensors["gain"], dtype=float)
        errors = (gains / skin.constants.gain.numpy() - 1).reshape(9, 3)
        assert np.sqrt((errors[:, axes] ** 2).mean(axis=0)).max() < 0.04
        assert np.isnan(gains).sum() == 18 * (load is WEIGHT)
        assert ("along the surface" in found.about) == (load is WEIGHT)
        assert not found.broken["dead"]
    assert found.signs.tolist() == turned.tolist()


@pytest.mark.parametrize(
    ("first", "second"), [([4], []), ([], [4]), ([], [4, 4]), ([3], [4]), ([4], [4, 4, 4]), ([4], [3])]
)
def test_placements_whose_direction_is_unknown_are_refused(first, second):
    """Site 4 has another number of them in one direction than in the other, or another site has."""
    skin, others = three_axes(gain_spread=0.3), [0, 1, 2, 3, 5, 6, 7, 8]
    with free():  # the operator
        expected = base_readings(skin.model, skin.body, skin.sensors, INCLINED)
    rows = np.vstack([expected[0][others + first], expected[1][others + second]])
    session = emulate_placements(skin, rows, np.random.default_rng(0))
    with pytest.raises(InputError, match="put it on each site equally often for each of the 2 directions"):
        fit_known_load(three_axes(), session, INCLINED)


@pytest.mark.parametrize(
    ("incline", "axes", "reason"),
    [
        ((20, None, 0.005), "three", "got incline=20 downhill=None height=0.005: an incline needs its angle"),
        ((20, [45], 0.02), "three", "upper edge: take a flatter one, or incline it by up to 14.0 deg"),
        ((20, [45, 180], 0.005), "three", "does not load each axis along the surface"),
        ((20, [45], 0.005), "normal", "of layout.axes=three"),
    ],
)
def test_inclines_that_give_no_gains_are_refused(incline, axes, reason):
    skin = three_axes()
    sensors = Grid(3, 3, depth=0.005, axes=axes).sensors(skin.body)
    with free():
        model = Solid(skin.body, sensors)
    with pytest.raises(InputError, match=reason):
        base_readings(model, skin.body, sensors, KnownLoad.of(2.0, 0.02, skin.size, *incline))


def test_an_incline_of_an_arm_is_refused():
    """Downhill is another direction of the surface at every place of it."""
    layers = [{"material": "EcoFlex 00-30", "thickness": 0.015}]
    arm = Arm(radius=0.05, length=0.16, angle=3.2, cells=[12, 12], layers=layers)
    sensors = Grid(2, 2, depth=0.005, axes="three").sensors(arm)
    with free():
        model = Solid(arm, sensors)
    with pytest.raises(InputError, match="the body is no flat sheet"):
        base_readings(model, arm, sensors, INCLINED)


def test_a_second_load_reads_enough_to_show_a_curve():
    body = Sheet([0.12, 0.12], [12, 12], [{"material": "EcoFlex 00-30", "thickness": 0.02}])
    skin, limits = (body, Grid(2, 2, depth=0.0195).sensors(body)), read_touch(None).danger
    with free():
        model = Solid(*skin)
    with pytest.raises(InputError, match=r"reads only \d+% of .* as in weight=3.5 base=0.011"):
        firm_readings(model, *skin, KnownLoad(1.5, 0.006), limits)
    first = base_readings(model, *skin, WEIGHT)[0].max(axis=1)
    second = firm_readings(model, *skin, KnownLoad(3.5, 0.011), limits).max(axis=1)
    square_roots = (first * second) ** 0.5  # with the gains that the first load gives
    assert (square_roots / second < 1 - AGREES).all()


def test_an_untouched_session_has_no_placement():
    skin = device()
    noise = skin.imperfection.raw(torch.zeros(1, 3000, 6), skin.constants, np.random.default_rng(0))
    session = BenchSession(np.arange(3000) / 100, noise[0].numpy(), "N")
    with pytest.raises(InputError, match="no placement in the session"):
        fit_known_load(device(), session, WEIGHT)


def test_a_touch_or_a_sliding_load_is_no_placement():
    skin = device(noise=0.01)
    readings = weight_readings(skin)[[0]]
    session = emulate_placements(skin, readings, np.random.default_rng(0), idle=5.0)
    time = session.time
    ramp = np.where((time > 5.0) & (time < 7.0), (time - 5.0) / 2, 0.0)
    session.raw[:, 0] += 3 * ramp  # a hand that leans on the weight more and more
    with pytest.raises(InputError, match="1 changed while they lay"):
        fit_known_load(skin, session, WEIGHT)


@pytest.mark.parametrize("bits", [None, 12])
def test_a_load_in_another_unit_shows_in_the_noise(bits):
    session = weighed(device(), ORDER, bits)
    reason = r"^weight=0\.002 \(kg\) would mean a noise of \S+ N, device.noise is 0.05"
    with pytest.raises(InputError, match=reason):
        fit_known_load(device(), session, KnownLoad(0.002, 0.02))
    fit_known_load(device(), session, KnownLoad(0.1, 0.02))
    fit_known_load(device(noise=0.0), session, KnownLoad(0.002, 0.02))


@pytest.mark.parametrize("load", [(2000.0, 0.02), (2.0, 20.0), (2.0, None)])
def test_impossible_loads_are_refused(load):
    with pytest.raises(InputError, match=r"give a mass in kg, up to 50, .* up to 0\.08: as in weight=2\.0"):
        KnownLoad.of(*load, (0.16, 0.16))


@pytest.mark.parametrize("noise", [0.0005, 0.05])
def test_loads_are_found_on_a_skin_that_creeps_and_recovers(noise):
    """Noise shows neither where a load begins nor how far the skin recovers."""
    time, begin = np.arange(0, 22, 0.02), 5 + 3.2 * np.arange(5)
    since = time[:, None] - begin
    on, creep = (since >= 0) & (since < 1.6), 0.09 * np.exp(-np.maximum(since, 0) / 0.8)
    raw = np.where(on, 3 - creep, np.where(since < 0, 0.0, 0.1 * np.exp(-(since - 1.6) / 0.8)))
    raw = raw + noise * np.random.default_rng(0).standard_normal(raw.shape)
    found = find_placements(BenchSession(time, raw, "N"))
    assert (len(found.change), found.unsteady) == (5, 0)
    np.testing.assert_allclose(np.diagonal(found.change), 2.95, atol=0.04)


def test_a_load_that_a_weak_sensor_feels_more_and_more_is_found():
    time = np.arange(0, 20, 0.01)
    ramps = [np.interp(time, begin + np.array([0, 0.8, 2.8, 2.9]), [0, 1, 1, 0]) for begin in (4, 9, 14)]
    raw = np.column_stack(ramps) * [1.0, 0.3, 1.0]
    raw = raw + 0.1 * np.random.default_rng(0).standard_normal(raw.shape)
    found = find_placements(BenchSession(time, raw, "N"))
    assert found.reached.all()
    np.testing.assert_allclose(np.diagonal(found.change), [1.0, 0.3, 1.0], atol=0.05)
