"""Gauge rows: presses, forces at the session's times, their true readings, and units of a bench."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.calibration import bench
from skin.calibration.bench import BenchSession, BenchSettings, Gauge, read_bench_session, write_bench_session
from skin.calibration.fit import check_force, fit_calibration
from skin.calibration.known_loads import choose_presses, emulate_session, stair_gauge
from skin.calibration.wiring import wired_bench
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.errors import InputError
from skin.mechanics.simulator.naive import Naive
from skin.record.comparison import compare_session
from tests.calibration.test_fit import device

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


def gauge(settings=None, **changes) -> Gauge:
    columns = {
        "time": [1.0, 1.5, 2.0, 2.5, 6.0, 6.5],
        "force": [0.0, 10.0, 20.0, 0.0, 5.0, 5.0],
        "x_m": [0.05] * 6,
        "y_m": [0.06] * 6,
    }
    return Gauge.of(pd.DataFrame(columns | changes), "gauge.csv", settings or BenchSettings())


@pytest.mark.parametrize(
    ("changes", "press"),
    [
        ({}, [0, 0, 0, 0, 1, 1]),
        ({"x_m": [0.05, 0.05, 0.06, 0.06, 0.06, 0.06]}, [0, 0, 1, 1, 2, 2]),
        ({"indenter": ["disc"] * 3 + ["square"] * 3}, [0, 0, 0, 1, 2, 2]),
    ],
)
def test_a_pause_or_another_place_or_indenter_begins_a_press(changes, press):
    assert gauge(**changes).press.tolist() == press


def test_forces_are_interpolated_within_a_press_only():
    force, press = gauge().at(np.array([-1.0, 1.25, 1.5, 2.25, 4.0, 6.25, 6.5, 8.0]))
    np.testing.assert_allclose(force, [0, 5, 10, 10, 0, 5, 5, 0])
    assert press.tolist() == [-1, 0, 0, 0, -1, 1, 1, -1]


def test_a_press_of_a_newton_on_the_naive_skin_is_force_over_area():
    """A square of 40 mm over a footprint of 10 mm: a sixteenth of the force, whoever computes it."""
    sensors = Grid(1, 1).sensors(BODY)
    found = gauge(BenchSettings("square", 0.02), x_m=[0.08] * 6, y_m=[0.08] * 6)
    each = bench.per_newton(Naive(BODY, sensors), BODY, found)
    np.testing.assert_allclose(each, 0.01**2 / 0.04**2, rtol=0.1)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"force": [0.0, -10.0, 20.0, 0.0, 5.0, 5.0]}, "zero the gauge"),
        ({"force": ["a"] * 6}, "gauge.csv: time, force, .* must be columns of numbers"),
        ({"x_m": [None] * 6}, "no row has a time"),
    ],
)
def test_bad_rows_are_refused(changes, reason):
    with pytest.raises(InputError, match=reason):
        gauge(**changes)


def test_places_outside_the_sheet_are_refused():
    with pytest.raises(InputError, match=r"outside the sheet of \[0.16, 0.16\] m: x_m and y_m are metres"):
        bench.per_newton(Naive(BODY, Grid(2, 2).sensors(BODY)), BODY, gauge(x_m=[50.0] * 6))


@pytest.mark.parametrize("name", ["x.csv", "x.parquet"])
@pytest.mark.parametrize("unit", ["N", "adc"])
def test_a_session_is_read_as_it_was_written(tmp_path, name, unit):
    raw = np.random.default_rng(0).integers(0, 1023, (700, 3)).astype(float)
    written = BenchSession(np.arange(700) / 100, raw, unit, gauge(), 10 if unit == "adc" else None)
    write_bench_session(written, tmp_path / name)
    settings = BenchSettings("square", 1.0, unit if name == "x.csv" else None)
    again = read_bench_session(tmp_path / name, settings)
    np.testing.assert_array_equal(again.raw, raw)
    np.testing.assert_array_equal(again.time, written.time)
    assert (again.unit, again.bits) == (unit, None if name == "x.csv" else written.bits)
    for values, others in zip(again.gauge.at(again.time), gauge().at(written.time), strict=True):
        np.testing.assert_allclose(values, others)
    pd.testing.assert_frame_equal(again.gauge.presses, gauge().presses)


def test_a_log_of_a_microcontroller_is_a_session(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("# skin proto=1 n=2\nseq,t_us,v0,v1\n0,0,1,2\n1,10000,,4\n")
    found = read_bench_session(path, BenchSettings(unit="adc"))
    np.testing.assert_allclose(found.time, [0, 0.01])
    np.testing.assert_array_equal(found.raw, [[1, 2], [np.nan, 4]])
    assert found.gauge is None


def test_a_gauge_of_its_own_file_is_delayed(tmp_path):
    (tmp_path / "bench.csv").write_text("time,a\n1,2\n1.5,3\n2,3\n")
    (tmp_path / "gauge.csv").write_text("time,force,x_m,y_m\n0,1,0.1,0.1\n0.5,2,0.1,0.1\n")
    found = read_bench_session(tmp_path / "bench.csv", BenchSettings(delay=1.0), tmp_path / "gauge.csv")
    assert found.gauge.at(found.time)[0].tolist() == [1, 2, 0]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a,b\n1,2\n3,4\n", "time must be columns of numbers, found a, b"),
        ("time,a\n1,2\n", "at least two rows are needed, got 1"),
        ("t_us,a\n5,2\n5,3\n5,2\n", "after row 0 it goes from 5e-06 to 5e-06 s: check the clock"),
        ("time,a\n1,2\n1,2,3\n", "cannot read"),
    ],
)
def test_bad_sessions_are_refused(tmp_path, text, reason):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_bench_session(path, BenchSettings())


@pytest.mark.parametrize("about", ["[]", "3", "{", "[" * 5000, '{"unit": ["N"]}', '{"bits": "many"}'])
def test_what_a_session_says_of_itself_is_checked(tmp_path, about):
    table = pa.table({"time": [1.0, 2.0], "a": [2, 3]}).replace_schema_metadata({"skin_session": about})
    pa.parquet.write_table(table, tmp_path / "log.parquet")
    with pytest.raises(InputError, match=r"log\.parquet"):
        read_bench_session(tmp_path / "log.parquet", BenchSettings())


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    skin, randomness = device(), np.random.default_rng(0)
    session = emulate_session(skin, stair_gauge(choose_presses(skin, randomness)), randomness)
    return write_bench_session(session, tmp_path_factory.mktemp("units") / "bench.parquet")


def changed(written, tmp_path, **factors):
    table = pd.read_parquet(written)
    table = table.assign(**{name: factor * table[name] for name, factor in factors.items()})
    table.to_csv(tmp_path / "bench.csv", index=False)
    return tmp_path / "bench.csv"


def test_a_comparison_takes_the_units_and_axes_of_the_calibration(written, tmp_path):
    """A session that was calibrated with settings is compared with the same ones."""
    source = load_yaml(CONF / "compare.yaml")["compare"] | {"scale": 0.04}
    straight = compare_session(device(), str(written), None, source)
    path = str(changed(written, tmp_path, time=1000, force=-1 / 9.80665))
    with pytest.raises(InputError, match=r"0\.1 rows per second, .* add compare\.time_scale=0\.001"):
        compare_session(device(), path, None, source)
    with pytest.raises(InputError, match=r"add compare\.force_scale=-1"):
        compare_session(device(), path, None, source | {"time_scale": 0.001})
    scales = source | {"time_scale": 0.001, "force_scale": -9.80665}
    pairs = compare_session(device(), path, None, scales).pairs
    for pair, other in zip(pairs, straight.pairs, strict=True):
        assert pair.measures == pytest.approx(other.measures, rel=1e-3)
    turned = compare_session(device(), str(written), None, source | {"places": "mirror_y"})
    assert turned.pairs[0].sensors[0] != straight.pairs[0].sensors[0]


@pytest.mark.parametrize(("unit", "newtons"), [("kg", 9.80665), ("g", 0.00980665), (None, 1.0)])
@pytest.mark.parametrize("bits", [None, 12])
def test_forces_in_another_unit_are_named(unit, newtons, bits):
    skin, randomness = device(), np.random.default_rng(0)
    session = emulate_session(skin, stair_gauge(choose_presses(skin, randomness)), randomness, bits)
    gauge = replace(session.gauge, force=session.gauge.force / newtons)
    bench = wired_bench(skin, replace(session, gauge=gauge), BenchSettings())
    calibration = fit_calibration(bench)
    if unit is None:
        check_force(calibration, 10.0)
        return
    with pytest.raises(InputError, match=f"seems to be in {unit}; add calibrate.force_scale={newtons:g}"):
        check_force(calibration, 10.0)
