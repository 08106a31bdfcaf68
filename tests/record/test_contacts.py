"""The contacts of an emulated skin reach a recorded session whole, or not at all; a gauge tells its own."""

from itertools import islice

import numpy as np
import pandas as pd
import pytest

from skin import Grid, read_recording
from skin.calibration import bench, known_loads
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.record.comparison import compare_session
from skin.record.serial import Serial, convert_session, record_session
from skin.record.session import read_session
from skin.wire.emulator import emulated_gestures
from tests.made_up import SHEET, naive_skin

COUNT = 3


@pytest.fixture(scope="module")
def device():
    tips = {"radius": [0.006, 0.012], "window": 1.0, "press": [0.4, 0.8]}
    return naive_skin(touch=tips)


@pytest.fixture(scope="module")
def played(device):
    return list(islice(emulated_gestures(device), COUNT))


def same(one, other):
    return np.array_equal(np.asarray(one, np.float32), np.asarray(other, np.float32), equal_nan=True)


def test_a_recorded_session_has_them(emulate, device, played, tmp_path):
    emulator = emulate(device, rate=100.0, speed=5.0, gap=0.1)
    settings = {"touch": {"window": 1.0}, "tare": 1.0, "scale": emulator.converter.scale, "timeout": 20.0}
    port, path = emulator.port.address, tmp_path / "s"
    reader = Serial(body=SHEET, layout=Grid(3, 3), port=port, gestures=COUNT, **settings)
    record_session(reader, path, None, False, lambda text: None)
    stored = read_session(path)
    for number, gesture in enumerate(played):
        assert same(stored.gestures[number][0].contacts, gesture.contacts)
    parquet, count = convert_session(reader, path)
    assert count == COUNT
    touches = read_recording(parquet).touches
    assert same(touches.contacts, np.stack([gesture.contacts for gesture in played]))
    # They are in time with the readings: nothing is felt without a contact.
    absent = touches.contacts[..., 0].isnan().all(2)
    force = touches.readings.amax(2)
    assert force[absent].max() < 0.5
    assert force[~absent].max() > 1.0


def test_a_gauge_tells_its_contacts():
    columns = {"time": [1.0, 1.5, 2.0, 2.5], "force": [0.0, 10.0, 20.0, 0.0], "x_m": [0.05] * 4}
    table = pd.DataFrame(columns | {"y_m": [0.06] * 4})
    rows = bench.Gauge.of(table, "x", bench.BenchSettings())
    peaks = bench.pressed_peaks(SHEET, rows)
    assert peaks == pytest.approx(1 / (np.pi * 0.01**2), rel=0.02)
    contacts = rows.contacts(np.array([0.5, 1.25, 2.0, 3.0]), peaks)
    assert contacts.shape == (4, 1, 5)
    assert np.isnan(contacts[[0, 3]]).all()
    assert contacts[1, 0] == pytest.approx([0.05, 0.06, 0.01, 5.0, 5 * peaks[0]])
    assert contacts[2, 0, 3] == 20.0


def test_presses_of_a_bench_session_have_them(device, tmp_path):
    places = np.array([[0.03, 0.03], [0.08, 0.08]])
    gauge = known_loads.stair_gauge(places, rate=50.0, indenter="disc")
    session = known_loads.emulate_session(device, gauge, np.random.default_rng(0))
    path = bench.write_bench_session(session, tmp_path / "s.parquet")
    settings = load_yaml(CONF / "compare.yaml")["compare"]
    sides = compare_session(device, str(path), None, settings).touches
    for touches in sides:
        assert touches.contacts.shape == (2, 10, 1, 5)
        *circles, force, _ = touches.contacts[:, -1, 0].T.numpy()
        expected = np.array([[0.03, 0.08], [0.03, 0.08], [0.01, 0.01]])
        assert np.stack(circles) == pytest.approx(expected, abs=1e-6)
        assert (force > 0).all()
