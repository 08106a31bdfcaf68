"""Channels whose values fall with force, and channels in another order than the layout's."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.calibration import Calibration, read_calibration, write_calibration
from skin.device.resampling import Window
from skin.errors import InputError
from skin.wire.channels import unit_conversion
from skin.wire.decoder import Decoder
from skin.wire.protocol import Header, encode_header, encode_line
from skin.wire.reader import Port
from skin.wire.skin import SerialSource
from skin.wire.tare import Tare
from tests.wire.memory import opened

FALLING = Calibration(
    {"gain": [2.0, 0.5, 1.0], "offset": [0.1, -0.2, 0.0], "clip": [10.0, 10.0, 10.0]},
    scale=0.02,
    zero=500.0,
    polarity=(1, -1, -1),
)


def raw_of(true: np.ndarray) -> np.ndarray:
    newtons = true * [2.0, 0.5, 1.0] + [0.1, -0.2, 0.0]
    return 500 + np.array([1, -1, -1]) * newtons / 0.02


def test_a_file_keeps_polarity_and_channels(tmp_path):
    whole = replace(FALLING, channels=(2, 0, 1))
    assert read_calibration(write_calibration(whole, tmp_path / "mine.yaml")) == whole
    assert "polarity" not in write_calibration(replace(FALLING, polarity=()), tmp_path / "a.yaml").read_text()


def test_a_person_may_write_one_polarity_for_all(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("format: 1\ncount: 3\nsensors: {gain: 1}\npolarity: -1\n")
    assert read_calibration(path).signs.tolist() == [-1, -1, -1]
    odd = "polarity: [[1]]", "polarity: up", "polarity: [1, 1, x]", "channels: 2", "channels: [0, 1, a]"
    for wrong in odd:
        path.write_text(f"format: 1\ncount: 3\nsensors: {{gain: 1}}\n{wrong}\n")
        with pytest.raises(InputError):
            read_calibration(path)


@pytest.mark.parametrize(
    ("wiring", "reason"),
    [
        ({"polarity": [1, -1]}, "polarity must be 1 or -1 for each of 3 sensors"),
        ({"polarity": [1, -1, 0]}, "polarity must be 1 or -1"),
        ({"channels": [0, 1, 1]}, "channels must hold each of 0 to 2 once"),
        ({"channels": [0, 1]}, "channels must hold each of 0 to 2 once"),
    ],
)
def test_wiring_that_fits_no_skin_is_refused(wiring, reason):
    with pytest.raises(InputError, match=reason):
        replace(FALLING, **{"polarity": ()} | wiring)


def test_contact_reads_positive_newtons():
    true = np.array([[0.0, 0.0, 0.0], [4.0, 5.0, 6.0]])
    np.testing.assert_allclose(FALLING.corrected(raw_of(true)), true, atol=1e-9)
    conversion = unit_conversion(3, None, None, FALLING, None)
    readings, valid = conversion(raw_of(true), np.ones(3, dtype=bool))
    np.testing.assert_allclose(readings, true, atol=1e-5)
    assert valid.all()
    tared = unit_conversion(3, raw_of(true)[0], None, FALLING, None)
    np.testing.assert_allclose(tared(raw_of(true), np.ones(3, dtype=bool))[0], true, atol=1e-5)


def test_a_scale_may_be_negative_but_not_beside_a_calibration_and_not_0():
    conversion = unit_conversion(2, np.array([900.0, 900.0]), -0.02, None, None)
    readings, _ = conversion(np.array([900.0, 400.0]), np.ones(2, dtype=bool))
    np.testing.assert_allclose(readings, [0, 10], atol=1e-6)
    assert SerialSource(Port(scale=-0.02), 2, 10.0).polarity == [-1, -1]
    with pytest.raises(InputError, match=r"must not be 0.*device.scale=-0.039 if values fall"):
        SerialSource(Port(scale=0.0), 2, 10.0)
    for scale in (float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"device.scale=(nan|inf) must be a finite number"):
            Port(scale=scale)
    with pytest.raises(InputError, match="above 0 beside a calibration"):
        unit_conversion(3, None, -0.02, FALLING, None)


def test_frames_come_in_the_order_of_the_layout():
    decoder = Decoder(3, channels=(2, 0, 1), polarity=[1, -1, 1])
    frames = decoder.feed(b"".join(encode_line([1, 2, 3], n, 1000 * n) for n in range(4)))
    assert frames[-1].values.tolist() == [3, 1, 2]
    assert frames[-1].polarity.tolist() == [1, -1, 1]
    plain = Decoder(3, polarity=[1, 1, 1])
    assert plain.feed(b"".join(encode_line([1, 2, 3], n, 1000 * n) for n in range(4)))[0].polarity is None


def test_both_ends_of_the_converter_saturate_a_channel_whose_values_fall():
    rows = [[500 + n % 2, 500 + n % 2] for n in range(10)] + [[0, 0], [1023, 1023], [1, 1022]]
    data = encode_header(Header(n=2, bits=10))
    data += b"".join(encode_line(row, n, 1000 * n) for n, row in enumerate(rows))
    with opened(data, layout=2, polarity=[1, -1]) as skin:
        frames = skin.read(len(rows), timeout=20)
    assert [(*frame.saturated,) for frame in frames[-3:]] == [(False, True), (True, True), (False, False)]
    assert all(frame.valid.all() for frame in frames)


def test_a_press_on_a_falling_channel_reads_its_peak_after_a_tare():
    source = SerialSource(Port(scale=-0.02, tare=1.0), 1, 10.0)
    rng, rows = np.random.default_rng(0), []
    for number in range(200):
        force = 5.0 if 150 <= number < 155 else 0.0
        rows.append([round(900 - force / 0.02 + rng.normal())])
    lines = b"".join(encode_line(row, n, 10_000 * n) for n, row in enumerate(rows))
    tare, window = Tare(source.convert, 1.0, 10.0), Window(5, 10.0, 1)
    for frame in Decoder(1, polarity=source.polarity).feed(lines):
        tare.add(frame)
        window.add(frame)
        if frame.seq == 160:
            seen = window.read()
    readings, _ = tare.conversion(seen.values, seen.valid)
    assert readings.max() == pytest.approx(5.0, abs=0.15)
    assert readings.min() == pytest.approx(0.0, abs=0.15)
