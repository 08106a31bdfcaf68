"""Units of a bench: what fits is named, and a setting converts it."""

import numpy as np
import pytest

from skin.calibration.bench import Units, read_bench_session, write_bench_session
from skin.calibration.fit import check_force, fit_calibration
from skin.calibration.known_loads import emulate_session
from skin.calibration.wiring import Confirmed, wired_bench
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.errors import InputError
from skin.record.comparison import compare_session
from tests.calibration.test_fit import PROTOCOL, device


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    skin, randomness = device(), np.random.default_rng(0)
    gauge = PROTOCOL.gauge(PROTOCOL.positions(skin, randomness))
    session = emulate_session(skin, gauge, PROTOCOL, randomness, 12)
    path = write_bench_session(session, tmp_path_factory.mktemp("units") / "bench.csv")
    return path, [line.split(",") for line in path.read_text().splitlines()]


def changed(rows, tmp_path, **factors):
    source, lines = rows
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
def test_times_in_another_unit_are_named(rows, tmp_path, factor, unit, scale):
    path = changed(rows, tmp_path, time=factor)
    with pytest.raises(InputError, match=f"{unit} would be 100 Hz: add calibrate.time_scale={scale}"):
        read_bench_session(path, "disc", 0.01)
    session = read_bench_session(path, "disc", 0.01, units=Units(time_scale=scale))
    assert np.median(np.diff(session.time)) == pytest.approx(0.01)
    assert len(session.gauge) == 12


def test_a_gauge_that_counts_downwards_is_named(rows, tmp_path):
    path = changed(rows, tmp_path, force=-1)
    with pytest.raises(InputError, match=r"add calibrate\.force_scale=-1"):
        read_bench_session(path, "disc", 0.01)
    assert read_bench_session(path, "disc", 0.01, units=Units(force_scale=-1.0)).gauge.force.max() > 100


def test_a_comparison_takes_the_units_and_axes_of_the_calibration(rows, tmp_path):
    """A session that was calibrated with settings is compared with the same ones."""
    source = load_yaml(CONF / "compare.yaml")["compare"] | {"scale": 0.04}
    straight = compare_session(device(), str(rows[0]), None, source)
    path = str(changed(rows, tmp_path, time=1000, force=-1 / 9.80665))
    with pytest.raises(InputError, match=r"ms would be 100 Hz: add compare\.time_scale=0\.001"):
        compare_session(device(), path, None, source)
    with pytest.raises(InputError, match=r"add compare\.force_scale=-1"):
        compare_session(device(), path, None, source | {"time_scale": 0.001})
    scales = source | {"time_scale": 0.001, "force_scale": -9.80665}
    pairs = compare_session(device(), path, None, scales).pairs
    for pair, other in zip(pairs, straight.pairs, strict=True):
        assert pair.measures == pytest.approx(other.measures, rel=1e-3)
    turned = compare_session(device(), str(rows[0]), None, source | {"places": "mirror_y"})
    assert turned.pairs[0].sensors[0] != straight.pairs[0].sensors[0]


@pytest.mark.parametrize(("unit", "newtons"), [("kg", 9.80665), ("g", 0.00980665), (None, 1.0)])
def test_forces_in_another_unit_are_named(rows, tmp_path, unit, newtons):
    session = read_bench_session(changed(rows, tmp_path, force=1 / newtons), "disc", 0.01)
    calibration = fit_calibration(wired_bench(device(), session, None, Confirmed()))
    if unit is None:
        check_force(calibration, 10.0)
        return
    with pytest.raises(InputError, match=f"seems to be in {unit}; add calibrate.force_scale={newtons:g}"):
        check_force(calibration, 10.0)
