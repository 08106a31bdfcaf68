"""Touches of a session beside their simulation: what was put in comes out."""

from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

from skin import Grid, InputError
from skin.calibration.bench import build_bench_data, write_bench_session
from skin.calibration.known_loads import choose_presses, emulate_session, stair_gauge
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.device.resampling import Frame, Window
from skin.evaluation.guarantee import describe_presses
from skin.live.engine import Detection, Engine
from skin.live.engine_builder import raises_alarm
from skin.record.comparison import (
    compare_gestures,
    compare_session,
    describe_agreement,
    judge_presses,
    publish_comparison,
)
from skin.record.session import SessionLog
from skin.touch.labels import TOUCH
from skin.wire.channels import UnitConversion
from skin.wire.emulator import emulated_gestures, upsample
from skin.wire.segmentation import ContinuousSegmenter
from tests.made_up import PERFECT, naive_skin

RATE, COUNT, GAIN = 50.0, 6, 0.8


@pytest.fixture(scope="module")
def device():
    return naive_skin(**(PERFECT | {"offset": 0.3, "clip": 100.0}))


def session(device, path, labels, known=True):
    """Write what a skin of another gain says of the emulator's gestures, in counts above 500."""
    positions = device.sensors.positions.tolist()
    about = {"positions": positions, "unit": "adc", "bits": 10, "id": None, "labels": labels}
    log = SessionLog(path, about | {"window": device.window, "rate": device.model_rate})
    conversion = UnitConversion(np.full(9, 0.01), np.full(9, 500.0), np.zeros(9, dtype=bool))
    gestures = list(islice(emulated_gestures(device), COUNT))
    force = [upsample(gesture.force, device.model_rate, RATE) for gesture in gestures]
    segmenter = ContinuousSegmenter(Window(device.window, device.model_rate, 9))
    for number, row in enumerate(500 + GAIN * np.concatenate([*force, np.zeros((1, 9))]) / 0.01):
        frame = Frame(number, number / RATE, number / RATE, row, np.ones(9, dtype=bool))
        if done := segmenter.add(frame):
            done.labels = gestures[done.number].labels if known else None
            log.write((done, conversion))
        log.add(frame, frame.t)
    log.write()
    return str(path)


def test_a_gain_between_session_and_simulation_is_found(device, tmp_path):
    path = session(device, tmp_path / "s", "announced")
    comparison = compare_gestures(device, path, 0)
    assert [pair.same for pair in comparison.pairs] == [True] * COUNT
    for pair, played in zip(comparison.pairs, emulated_gestures(device), strict=False):
        assert pair.measures["ratio"] == pytest.approx(GAIN, rel=1e-3)
        error = (1 - GAIN) * np.sqrt((played.force**2).mean())
        assert pair.measures["rmse"] == pytest.approx(error, rel=2e-3)
        # The applied force is the sum of the pressure, told by the movie and not by any sensor.
        assert pair.applied.max() > pair.measures["simulated"]
    path, picture = publish_comparison(comparison, [], "Here.", 2, tmp_path)
    page = path.read_text()
    assert "gain ratio of readings (recorded over simulated), median: 0.800" in page
    assert publish_comparison(comparison, [], "Here.", 2, tmp_path)[0].read_text() == page
    assert picture.stat().st_size > 10_000
    simulated, recorded = comparison.touches
    assert recorded.readings.numpy() == pytest.approx(GAIN * simulated.readings.numpy(), abs=2e-3)


def test_agreements_are_counted(device, tmp_path):
    comparison = compare_gestures(device, session(device, tmp_path / "s", "announced"), 0)
    truth = np.array([[bool(pair.labels[name]) for name in TOUCH.names] for pair in comparison.pairs])
    wrong = truth.copy()
    wrong[:2, 1] ^= True
    page = "\n".join(describe_agreement(comparison, TOUCH.names, truth, wrong))
    assert "the same of `big` on 6 of 6 gestures, and is right on 6 simulated and 6 recorded ones" in page
    assert "the same of `dynamic` on 4 of 6 gestures, and is right on 6 simulated and 4 recorded" in page


def test_what_a_person_did_is_compared_with_gestures_of_the_same_labels(device, tmp_path):
    comparison = compare_gestures(device, session(device, tmp_path / "s", "prompted"), 0)
    assert not comparison.pairs[0].same
    played = list(islice(emulated_gestures(device), COUNT))
    assert [pair.labels for pair in comparison.pairs] == [one.labels for one in played]
    assert not np.allclose(comparison.pairs[0].simulated, played[0].force)
    page = publish_comparison(comparison, [], "Here.", 2, tmp_path)[0].read_text()
    assert page.startswith("# Gestures of the same labels")
    assert "RMSE of readings" not in page
    assert publish_comparison(comparison, [], "Here.", 2, tmp_path)[1].stat().st_size > 10_000


def test_other_gestures_layouts_and_windows_and_no_labels_are_refused(device, tmp_path):
    path = session(device, tmp_path / "s", "announced")
    with pytest.raises(InputError, match=r"emulate\.seed as compare\.seed"):
        compare_gestures(device, path, 1)
    with pytest.raises(InputError, match="another layout"):
        compare_gestures(device.replace(layout=Grid(1, 9)), path, 0)
    with pytest.raises(InputError, match=r"30 frames at 10 Hz, .* at 5 Hz: give .*touch\.rate=10"):
        compare_gestures(device.replace(touch={"rate": 5.0, "tap": [0.2, 0.4], "press": [0.6, 2.0]}), path, 0)
    path = session(device, tmp_path / "s", "none", known=False)
    with pytest.raises(InputError, match=r"no gesture with labels.*device\.labels=prompted"):
        compare_gestures(device, path, 0)


def test_presses_are_compared_as_gestures_are(device, tmp_path):
    """A skin reads 80 % of what the device does; a lost frame and a silent channel do not count."""
    randomness = np.random.default_rng(0)
    rows = stair_gauge(choose_presses(device, randomness), rate=50.0)
    session = emulate_session(device, rows, randomness)
    raw = GAIN * session.raw
    force, press = rows.at(session.time)
    raw[np.flatnonzero(press == 1)[5]] = np.nan
    raw[:, 8] = np.nan
    path = write_bench_session(replace(session, raw=raw), tmp_path / "bench.csv")
    settings = load_yaml(CONF / "compare.yaml")["compare"]
    comparison = compare_session(device, str(path), None, settings)
    assert comparison.things == "presses"
    assert [pair.number for pair in comparison.pairs] == [n for n in range(len(rows)) if n % 9 != 8]
    first = comparison.pairs[0]
    assert first.measures["ratio"] == pytest.approx(GAIN, rel=1e-3)
    assert first.measures["recorded"] == pytest.approx(GAIN * first.measures["simulated"], rel=1e-3)
    assert first.measures["force"] == pytest.approx(force[press == 0].max())
    assert comparison.pairs[1].valid.sum() == comparison.pairs[1].valid.any(axis=1).sum() * 8
    simulated, measured = comparison.touches
    assert measured.readings.numpy() == pytest.approx(GAIN * simulated.readings.numpy(), abs=2e-2)
    assert not measured.valid[:, :, 8].any()
    path, picture = publish_comparison(comparison, [], "Here.", 2, tmp_path)
    assert "gain ratio of readings (recorded over simulated), median: 0.800" in path.read_text()
    assert picture.stat().st_size > 10_000


def loud(readings, valid):
    """Say that a window is dangerous if a reading is above 1 N."""
    return np.repeat((readings * valid).max(axis=(1, 2))[:, None] > 1, 4, axis=1).astype(float)


def test_a_press_that_the_engine_misses_counts_if_it_is_above_the_limit_and_on_a_valid_sensor(device):
    positions = np.tile(device.sensors.positions[:, :2], (3, 1))
    positions[17] = 0.055
    rows = stair_gauge(positions, peak=60.0, steps=(1.0,), rate=50.0)
    rows = replace(rows, force=np.where(rows.press >= 18, 0.15, 1.0) * rows.force)
    session = emulate_session(device, rows, np.random.default_rng(0))
    press, raw = rows.at(session.time)[1], session.raw.copy()
    raw[press == 2] *= 0.01  # the skin hardly felt it
    raw[:, 8] = np.nan  # presses 8, 17 and 26 are on no valid sensor
    raw[np.flatnonzero(press == 3)[::7]] = np.nan
    raw[press == 4, 4] = raw[press == 5] = np.nan  # of which nothing is known
    bench = build_bench_data(device, replace(session, raw=raw))
    engine = Engine(loud, TOUCH, 9, device.window, device.model_rate, Detection(0.5))
    judged = judge_presses(device, bench, None, device.model_rate, partial(raises_alarm, engine))
    peak, sensed, alarmed = judged
    assert (peak > 1.1).tolist() == [True] * 18 + [False] * 9
    assert np.flatnonzero(sensed < 1).tolist() == [8, *range(17, 27)]
    assert np.flatnonzero(~alarmed[:17]).tolist() == [2, 4, 5, 8]
    lines = describe_presses(*judged)
    assert "16 of 27, 3 missed (numbers 2, 4, 5)" in lines[0]
    assert "below 0.9 x the limit: 9, 8 raise the alarm" in lines[2]
    with pytest.raises(InputError, match=r"3 misses of 16 presses .* needed"):
        describe_presses(*judged, 0.05)
