"""Gauge rows: presses, forces at the session's times, their true readings, and units of a bench."""

import numpy as np
import pyarrow as pa
import pytest

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.calibration import bench
from skin.calibration.bench import BenchSession, Units, read_bench_session, write_bench_session
from skin.calibration.fit import check_force, fit_calibration
from skin.calibration.known_loads import emulate_session
from skin.calibration.wiring import Confirmed, wired_bench
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.errors import InputError
from skin.mechanics.simulator.naive import Naive
from skin.record.comparison import compare_session
from tests.calibration.test_fit import PROTOCOL, device

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])


def rows(**changes) -> pa.Table:
    columns = {
        "time": [1.0, 1.5, 2.0, 2.5, 6.0, 6.5],
        "force": [0.0, 10.0, 20.0, 0.0, 5.0, 5.0],
        "x_m": [0.05] * 6,
        "y_m": [0.06] * 6,
    }
    return pa.table(columns | changes)


@pytest.mark.parametrize(
    ("changes", "press"),
    [
        ({}, [0, 0, 0, 0, 1, 1]),
        ({"x_m": [0.05, 0.05, 0.06, 0.06, 0.06, 0.06]}, [0, 0, 1, 1, 2, 2]),
        ({"indenter": ["disc"] * 3 + ["square"] * 3}, [0, 0, 0, 1, 2, 2]),
    ],
)
def test_a_pause_or_another_place_or_indenter_begins_a_press(changes, press):
    assert bench.gauge_from_table(rows(**changes), "x", "disc", 0.01).press.tolist() == press


def test_forces_are_interpolated_within_a_press_only():
    found = bench.gauge_from_table(rows(), "x", "disc", 0.01, delay=1.0)
    force, press = found.at(np.array([0.0, 2.25, 2.5, 3.25, 5.0, 7.25, 7.5, 9.0]))
    np.testing.assert_allclose(force, [0, 5, 10, 10, 0, 5, 5, 0])
    assert press.tolist() == [-1, 0, 0, 0, -1, 1, 1, -1]


def test_a_press_of_a_newton_on_the_naive_skin_is_force_over_area():
    """A square of 40 mm over a footprint of 10 mm: a sixteenth of the force, whoever computes it."""
    sensors = Grid(1, 1).sensors(BODY)
    table = rows(x_m=[0.08] * 6, y_m=[0.08] * 6)
    found = bench.gauge_from_table(table, "x", "square", 0.02)
    each = bench.per_newton(Naive(BODY, sensors), BODY, found)
    np.testing.assert_allclose(each, 0.01**2 / 0.04**2, rtol=0.1)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"time": [1.0, 1.5, 1.2, 2.5, 6.0, 6.5]}, "time must grow"),
        ({"force": [0.0, -10.0, 20.0, 0.0, 5.0, 5.0]}, "zero the gauge"),
        ({"force": ["a"] * 6}, "column force must hold numbers"),
        ({"x_m": [None] * 6}, "no row has a time"),
    ],
)
def test_bad_rows_are_refused(changes, reason):
    with pytest.raises(InputError, match=reason):
        bench.gauge_from_table(rows(**changes), "gauge.csv", "disc", 0.01)


def test_places_outside_the_sheet_are_refused():
    found = bench.gauge_from_table(rows(x_m=[50.0] * 6), "x", "disc", 0.01)
    with pytest.raises(InputError, match=r"outside the sheet of \[0.16, 0.16\] m: x_m and y_m are metres"):
        bench.per_newton(Naive(BODY, Grid(2, 2).sensors(BODY)), BODY, found)


@pytest.mark.parametrize("name", ["x.csv", "x.parquet"])
@pytest.mark.parametrize("unit", ["N", "adc"])
def test_a_session_is_read_as_it_was_written(tmp_path, name, unit):
    found = bench.gauge_from_table(rows(), "x", "disc", 0.01)
    raw = np.random.default_rng(0).integers(0, 1023, (700, 3)).astype(float)
    written = BenchSession(np.arange(700) / 100, raw, unit, found, 10 if unit == "adc" else None)
    bench.write_bench_session(written, tmp_path / name)
    again = bench.read_bench_session(tmp_path / name, "none", 1.0)
    np.testing.assert_array_equal(again.raw, raw)
    np.testing.assert_array_equal(again.time, written.time)
    assert (again.unit, again.bits) == (unit, written.bits)
    for one, other in zip(again.gauge.at(again.time), found.at(written.time), strict=True):
        np.testing.assert_allclose(one, other)
    assert set(again.gauge.indenter) == {"disc"}


def test_a_log_of_a_microcontroller_is_a_session(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("# skin proto=1 n=2\nseq,t_us,v0,v1\n0,0,1,2\n1,10000,,4\n")
    found = bench.read_bench_session(path, "disc", 0.01, "adc")
    np.testing.assert_allclose(found.time, [0, 0.01])
    np.testing.assert_array_equal(found.raw, [[1, 2], [np.nan, 4]])
    assert found.gauge is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time,a\n", "no rows"),
        ("time\n1\n2\n", "no column of a sensor"),
        ("a,b\n1,2\n3,4\n", "the column time must hold numbers, found a, b"),
        ("time,a\n1,2\n", "at least two frames, this one has 1"),
        ("time,a\n1,2\n1,3\n", "clock stood still: all 2 frames of the session have the time 1 s"),
        ("t_us,a\n5,2\n5,3\n5,2\n", "clock stood still: all 3 frames of the session have the time 5e-06 s"),
        ("time,a\n1,2\n2,2\n1.5,3\n", "after frame 1 it goes from 2 to 1.5 s"),
        ("time,a\n1,2\n1,2,3\n", "cannot read"),
    ],
)
def test_bad_sessions_are_refused(tmp_path, text, reason):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        bench.read_bench_session(path, "disc", 0.01)


@pytest.mark.parametrize("about", ["[]", "3", "{", "[" * 5000, '{"unit": ["N"]}', '{"bits": "many"}'])
def test_what_a_session_says_of_itself_is_checked(tmp_path, about):
    path = tmp_path / "log.csv"
    path.write_text("time,a\n1,2\n2,3\n")
    (tmp_path / "log.csv.json").write_text(about)
    with pytest.raises(InputError, match=r"log\.csv"):
        bench.read_bench_session(path, "disc", 0.01)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    skin, randomness = device(), np.random.default_rng(0)
    gauge = PROTOCOL.gauge(PROTOCOL.positions(skin, randomness))
    session = emulate_session(skin, gauge, PROTOCOL, randomness, 12)
    path = write_bench_session(session, tmp_path_factory.mktemp("units") / "bench.csv")
    return path, [line.split(",") for line in path.read_text().splitlines()]


def changed(written, tmp_path, **factors):
    source, lines = written
    names = [name.strip('"') for name in lines[0]]
    table = [list(line) for line in lines]
    for name, factor in factors.items():
        for line in table[1:]:
            position = names.index(name)
            line[position] = line[position] and repr(float(line[position]) * factor)
    path = tmp_path / "bench.csv"
    path.write_text("\n".join(map(",".join, table)) + "\n")
    path.with_name("bench.csv.json").write_text(source.with_name("bench.csv.json").read_text())
    return path


@pytest.mark.parametrize(("factor", "unit", "scale"), [(1000, "ms", 0.001), (1 / 60, "minutes", 60)])
def test_times_in_another_unit_are_named(written, tmp_path, factor, unit, scale):
    path = changed(written, tmp_path, time=factor)
    with pytest.raises(InputError, match=f"{unit} would be 100 Hz: add calibrate.time_scale={scale}"):
        read_bench_session(path, "disc", 0.01)
    session = read_bench_session(path, "disc", 0.01, units=Units(time_scale=scale))
    assert np.median(np.diff(session.time)) == pytest.approx(0.01)
    assert len(session.gauge) == 12


def test_a_gauge_that_counts_downwards_is_named(written, tmp_path):
    path = changed(written, tmp_path, force=-1)
    with pytest.raises(InputError, match=r"add calibrate\.force_scale=-1"):
        read_bench_session(path, "disc", 0.01)
    assert read_bench_session(path, "disc", 0.01, units=Units(force_scale=-1.0)).gauge.force.max() > 100


def test_a_comparison_takes_the_units_and_axes_of_the_calibration(written, tmp_path):
    """A session that was calibrated with settings is compared with the same ones."""
    source = load_yaml(CONF / "compare.yaml")["compare"] | {"scale": 0.04}
    straight = compare_session(device(), str(written[0]), None, source)
    path = str(changed(written, tmp_path, time=1000, force=-1 / 9.80665))
    with pytest.raises(InputError, match=r"ms would be 100 Hz: add compare\.time_scale=0\.001"):
        compare_session(device(), path, None, source)
    with pytest.raises(InputError, match=r"add compare\.force_scale=-1"):
        compare_session(device(), path, None, source | {"time_scale": 0.001})
    scales = source | {"time_scale": 0.001, "force_scale": -9.80665}
    pairs = compare_session(device(), path, None, scales).pairs
    for pair, other in zip(pairs, straight.pairs, strict=True):
        assert pair.measures == pytest.approx(other.measures, rel=1e-3)
    turned = compare_session(device(), str(written[0]), None, source | {"places": "mirror_y"})
    assert turned.pairs[0].sensors[0] != straight.pairs[0].sensors[0]


@pytest.mark.parametrize(("unit", "newtons"), [("kg", 9.80665), ("g", 0.00980665), (None, 1.0)])
def test_forces_in_another_unit_are_named(written, tmp_path, unit, newtons):
    session = read_bench_session(changed(written, tmp_path, force=1 / newtons), "disc", 0.01)
    calibration = fit_calibration(wired_bench(device(), session, None, Confirmed()))
    if unit is None:
        check_force(calibration, 10.0)
        return
    with pytest.raises(InputError, match=f"seems to be in {unit}; add calibrate.force_scale={newtons:g}"):
        check_force(calibration, 10.0)
