"""A skin at a port: the touches that were played, with their contacts, prompts, and what is refused."""

import os
from itertools import count, islice
from threading import Thread
from time import sleep

import numpy as np
import pandas as pd
import pytest
import torch

from skin import Grid, InputError, read_recording
from skin.calibration import bench, known_loads
from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.device.resampling import Frame
from skin.record.comparison import compare_session
from skin.record.serial import Serial, convert_session, record_session
from skin.record.session import read_session
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.touch.shapes import pressed_peaks
from skin.wire.channels import UnitConversion
from skin.wire.emulator import Emulator, EmulatorSettings, PtyPort, emulated_gestures
from skin.wire.segmentation import label_plan
from tests.made_up import PERFECT, SHEET, naive_skin

LAYOUT, COUNT = Grid(2, 3), 6


def skin(**settings):
    return naive_skin(layout=LAYOUT, **settings)


def serial(emulator, layout=LAYOUT, **settings):
    port = emulator and emulator.port.address
    return Serial(body=SHEET, layout=layout, port=port, gestures=COUNT, timeout=30.0, **settings)


@pytest.fixture
def emulate():
    """Return a function that plays a device at a port and returns the emulator; nothing is left behind."""
    playing = []

    def begin(device, count=7, **settings):
        chosen = EmulatorSettings(**{"speed": 40.0, "idle": 4.0, "rate": 40.0} | settings)
        emulator = Emulator(device, PtyPort(None), chosen)
        thread = Thread(target=emulator.run, kwargs={"count": count})
        thread.start()
        playing.append((emulator, thread))
        return emulator

    yield begin
    for emulator, thread in playing:
        emulator.stop()
        thread.join(20)
        assert not thread.is_alive()
        emulator.port.unplug()


def test_it_reads_what_was_played(emulate):
    # Nothing but the converter's own rounding is between what is drawn and what is read.
    device = skin(**(PERFECT | {"clip": 100.0}))
    touches = serial(emulate(device, bits=None)).touches("test")
    played = list(islice(emulated_gestures(device), COUNT))
    assert touches.labels.int().tolist() == [list(one.labels.values()) for one in played]
    expected = torch.from_numpy(np.stack([one.force for one in played])).float()
    assert torch.allclose(touches.readings, expected, atol=1e-4, rtol=1e-5)
    assert touches.valid.all()
    assert touches.rate == 10.0


def test_counts_offsets_and_lost_frames_change_little(emulate, monkeypatch):
    device, sent, send = skin(gain_spread=0.0, offset=0.5, noise=0.0, clip=10.0), count(), Emulator._send
    damage = lambda self, data: send(self, data[1:] if next(sent) % 97 == 50 else data)  # noqa: E731
    monkeypatch.setattr(Emulator, "_send", damage)
    touches = serial(emulate(device), scale=20 / 512).touches("test")
    played = {(*one.labels.values(),): one.force for one in islice(emulated_gestures(device), COUNT + 1)}
    for labels, readings, valid in zip(touches.labels.int(), touches.readings, touches.valid, strict=True):
        expected = np.clip(played[*labels.tolist()], -10, 10)
        wrong = np.abs(readings.numpy() - expected)[valid.numpy()]
        # Half a count each for baseline and value; most intervals lose no frame.
        assert np.median(wrong) <= 20 / 512


@pytest.mark.parametrize(
    ("played", "settings", "reason"),
    [
        ({}, {"layout": Grid(2, 2), "scale": 1.0}, "sends 6 values per frame, the layout has 4"),
        ({"rate": 5.0, "idle": 30.0}, {"scale": 1.0}, r"sends 5 frames a second, the model needs 10"),
        ({}, {}, r"sends adc.*device\.scale"),
    ],
)
def test_a_device_that_does_not_match_is_refused(emulate, played, settings, reason):
    with pytest.raises(InputError, match=reason):
        serial(emulate(skin(noise=0.5), **played), **settings).touches("test")


@pytest.mark.parametrize("split", ["train", "validation", "holdout", "test"])
def test_only_a_test_split_of_a_port(split):
    with pytest.raises(InputError, match=r"device\.port=" if split == "test" else "skin record"):
        serial(None).touches(split)


FEW = 3


@pytest.fixture(scope="module")
def device():
    tips = {"radius": [0.006, 0.012], "window": 1.0, "press": [0.4, 0.8]}
    return naive_skin(touch=tips)


@pytest.fixture(scope="module")
def played(device):
    return list(islice(emulated_gestures(device), FEW))


def same(one, other):
    return np.array_equal(np.asarray(one, np.float32), np.asarray(other, np.float32), equal_nan=True)


def test_a_recorded_session_has_them(emulate, device, played, tmp_path):
    emulator = emulate(device, rate=100.0, speed=5.0, gap=0.1)
    settings = {"touch": {"window": 1.0}, "tare": 1.0, "scale": emulator.converter.scale, "timeout": 20.0}
    port, path = emulator.port.address, tmp_path / "s"
    reader = Serial(body=SHEET, layout=Grid(3, 3), port=port, gestures=FEW, **settings)
    record_session(reader, path, None, False, lambda text: None)
    stored = read_session(path)
    for number, gesture in enumerate(played):
        assert same(stored.gestures[number][0].contacts, gesture.contacts)
    parquet, count = convert_session(reader, path)
    assert count == FEW
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
    peaks = pressed_peaks(SHEET, rows.presses)
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


IDLE = 12.0  # s, of which the first is the tare
NOISE = 0.03  # N, with rounding a little more
LEAST = 0.09  # N: five times that, less what the largest value of an interval has anyway


@pytest.fixture
def recorded(emulate, tmp_path, monkeypatch, capfd):
    """Return a function that records an emulated skin and gives the session, and what was said.

    Nothing touches the skin for some seconds, and then fingertips do. Enter is pressed at every prompt.
    """

    def record(count, stream=False, dead=()):
        tips = {"window": 1.0, "press": [0.8, 0.95], "radius": [0.006, 0.012]}
        device = naive_skin(touch=tips, noise=NOISE)
        emulator = emulate(device, count=40, rate=100.0, speed=5.0, idle=IDLE, gap=0.1, dead=dead)
        there = {"port": emulator.port.address, "scale": emulator.converter.scale, "timeout": 20.0}
        asked = {"labels": "prompted", "gestures": count, "stream": stream, "tare": 1.0}
        reader = Serial(body=SHEET, layout=device.layout, touch={"window": 1.0}, **there, **asked)
        typed, keyboard = os.pipe()
        os.write(keyboard, b"\n" * 60)
        with os.fdopen(typed) as lines:
            monkeypatch.setattr("sys.stdin", lines)
            record_session(reader, tmp_path / "s", None, False, lambda text: None)
            os.close(keyboard)
        recording = read_recording(convert_session(reader, tmp_path / "s")[0])
        return recording.touches, capfd.readouterr().err.splitlines()

    return record


def refused(said):
    """Return the prompts for what was not felt; the same prompt follows each."""
    prompts = [line for line in said if line.startswith(("next: ", "no touch was detected"))]
    positions = [position for position, line in enumerate(prompts) if line.startswith("no touch was")]
    assert all(prompts[position - 1] == prompts[position + 1] for position in positions)
    return [prompts[position - 1] for position in positions]


def test_a_gesture_that_nobody_made_is_asked_for_again(recorded, tmp_path):
    touches, said = recorded(3)
    assert touches.readings.amax(dim=(1, 2)).min() > LEAST
    assert touches.labels.int().tolist() == [list(one.values()) for one in label_plan(TOUCH.names, 1, 0)][:3]
    assert refused(said)
    assert sorted(read_session(tmp_path / "s").gestures) == [0, 1, 2]


def test_frames_between_two_gestures_are_kept_however_many(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr("skin.record.serial._MOST", 50)
    recorded(2)
    tables = read_session(tmp_path / "s").tables
    rows = sorted((row for table in tables for row in table.to_pylist()), key=lambda row: row["time"])
    assert len(tables) > 3
    assert [row["seq"] for row in rows] == list(range(rows[0]["seq"], rows[0]["seq"] + len(rows)))
    assert [sum(row["gesture"] == number for row in rows) for number in (0, 1)] == [100, 100]


def test_a_prompt_for_no_touch_needs_none(recorded):
    plan = [list(one.values()) for one in label_plan(TOUCH_OR_NOT.names, 1, 0)]
    touches, said = recorded(16, stream=True)
    assert touches.labels.int().tolist() == plan[:16]
    felt = touches.readings.amax(dim=(1, 2)) > LEAST
    wanted = touches.labels[:, TOUCH_OR_NOT.names.index("touch")] == 1
    assert felt[wanted].all()
    assert not felt[0]  # before the first touch
    assert not any("not touch" in prompt for prompt in refused(said))


def test_dead_sensors_feel_nothing_and_the_others_do(recorded):
    touches, said = recorded(2, dead=[0, 1, 2, 3])
    assert touches.readings[:, :, 4:].amax(dim=(1, 2)).min() > LEAST
    assert refused(said)


@pytest.mark.parametrize(("change", "felt"), [(0, False), (1, False), (2, True)])
def test_a_count_more_is_no_touch_for_a_skin_without_noise(change, felt, monkeypatch, tmp_path):
    """Its channels are still during the tare, and one changes by a count afterwards."""
    (tmp_path / "typed").write_text("\n")
    reader = Serial(body=SHEET, layout=Grid(3, 3), port="/dev/null", labels="prompted", scale=0.04)
    still = np.zeros(9)
    conversion = UnitConversion(np.full(9, 0.04), np.full(9, 512.0), still > 0, noise=still, rest=still)
    rows = [np.full(9, 512.0) for _ in range(450)]
    rows[350][4] += change
    frames = [Frame(number, number / 100, 0.0, row, row > 0) for number, row in enumerate(rows)]
    with (tmp_path / "typed").open() as lines:
        monkeypatch.setattr("sys.stdin", lines)
        segmenter = reader.segmenter(None, conversion, frames[:100])
        while segmenter._typed.qsize() < 2:  # Enter, and the end
            sleep(0.01)
    assert any(segmenter.add(frame) for frame in frames[100:]) is felt
