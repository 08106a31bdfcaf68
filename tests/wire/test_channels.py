"""Channels that mean nothing, that fall with force, or that come in another order than the layout's."""

from dataclasses import replace

import numpy as np
import pytest

from skin.device.calibration import Calibration, read_calibration
from skin.device.resampling import INWARDS, Window
from skin.errors import InputError
from skin.wire.channels import ChannelHealth, Reason, unit_conversion
from skin.wire.decoder import Decoder
from skin.wire.protocol import Header, encode_header, encode_line
from skin.wire.reader import Port
from skin.wire.skin import SerialSource
from skin.wire.tare import Tare
from tests.wire.memory import opened

OK, SATURATED, STUCK, DEAD = 0, Reason.SATURATED, Reason.STUCK, Reason.DEAD


def check(health, frames, start=0.0):
    frames = np.asarray(frames, dtype=float)
    return np.array([health.check(row, start + position * 0.01) for position, row in enumerate(frames)])


def noisy(count, sensors=5):
    return np.random.default_rng(0).integers(500, 510, (count, sensors))


def test_a_value_at_a_limit_is_saturated():
    frames = noisy(3)
    frames[1, 2] = 1023
    expected = [[OK] * 5, [OK, OK, SATURATED, OK, OK], [OK] * 5]
    assert check(ChannelHealth((None, 1023)), frames).tolist() == expected
    health = ChannelHealth((0, None))
    assert check(health, [[0.0, 1.0]]).tolist() == [[SATURATED, OK]]
    health.limits = (None, 1)  # a header may come late
    assert check(health, [[0.0, 1.0]], 0.01).tolist() == [[OK, SATURATED]]


@pytest.mark.parametrize("limits", [(None, 900.0), (None, None)])
def test_a_held_press_that_saturates_is_never_stuck(limits):
    frames = noisy(1500)
    frames[200:230, 1] += np.linspace(0, 390, 30).astype(int)
    frames[230:1430, 1] = 900
    health = ChannelHealth(limits)
    masks = check(health, frames[:700])
    health.restart()  # the device starts anew under the press
    masks = np.concatenate([masks, check(health, frames[700:], 7.0)])
    assert (masks <= SATURATED).all()
    # A limit that is not declared shows after five seconds.
    first = 230 if limits[1] else 1230
    assert (masks[first:1430] == [OK, SATURATED, OK, OK, OK]).all()
    assert health.states() == ("ok",) * 5


@pytest.mark.parametrize(("low", "first"), [(0, 200), (None, 700)])
def test_a_held_press_of_a_falling_channel_at_its_end_is_never_stuck(low, first):
    frames, falling = noisy(1500), np.full(5, -1)
    frames[200:1400, 1] = 0
    health = ChannelHealth((low, 1023))
    masks = [health.check(row, n * 0.01, None, falling) for n, row in enumerate(frames * 1.0)]
    assert (np.array(masks[first:1400]) == [OK, SATURATED, OK, OK, OK]).all()


def test_a_silence_makes_no_channel_stuck():
    """An untouched channel often has the same value behind a silence as before it."""
    frames, health = noisy(500), ChannelHealth()
    check(health, frames)
    assert not health.check(frames[-1].astype(float), 20.0).any()
    masks = check(health, np.where(np.arange(5) == 1, frames[-1], noisy(600)), 20.01)
    assert masks[-1, 1] == STUCK, "what stays is found after it"
    assert not masks[:, [0, 2, 3, 4]].any()


@pytest.mark.parametrize(("polarity", "state"), [(1, SATURATED), (-1, STUCK)])
def test_a_wire_that_breaks_to_the_end_without_force_is_stuck(polarity, state):
    frames, health = noisy(1500), ChannelHealth((None, 1023))
    frames[200:, 1] = 1023
    masks = [health.check(row, n * 0.01, polarity=np.full(5, polarity)) for n, row in enumerate(frames * 1.0)]
    assert masks[-1][1] == state
    three, ends = ChannelHealth((None, 1023), judges=INWARDS), np.full(3, 1023.0)
    ends = three.check(ends, 0.0, polarity=np.full(3, polarity))
    assert ends.tolist() == [SATURATED, SATURATED, SATURATED if polarity > 0 else OK]


@pytest.mark.parametrize("state", ["dead", "stuck"])
def test_a_channel_that_stays_while_others_change(state):
    frames = noisy(700)
    frames[0, 1], frames[0 if state == "dead" else 3 :, 1] = 1, 77
    health = ChannelHealth()
    masks = check(health, frames)
    assert not masks[:500].any()
    assert (masks[520:] == [OK, DEAD if state == "dead" else STUCK, OK, OK, OK]).all()
    assert health.states() == ("ok", state, "ok", "ok", "ok")
    assert not health.check(np.array([500.0, 78, 500, 500, 500]), 7.0).any()


@pytest.mark.parametrize("alive", [1, 2])
def test_most_channels_dead_from_the_start_are_found_by_the_noise_of_the_others(alive):
    frames = noisy(700)
    frames[:, alive:] = 0
    health = ChannelHealth()
    masks = check(health, frames)
    assert not masks[:500].any()
    assert (masks[620:] == [OK] * alive + [DEAD] * (5 - alive)).all()
    assert health.check(np.array([500.0, 505, 1, 0, 0]), 7.0).tolist() == [OK, OK, OK, DEAD, DEAD]


def constant():
    """Return an untouched skin without visible noise, with a touch of two of five channels."""
    frames = np.full((2000, 5), 12)
    frames[900:950, :2] = 200
    return frames


def near_an_edge():
    """Return noise of a fifth of a count: only the value that rests near an edge ever changes."""
    draw = np.random.default_rng(0)
    return np.round(np.array([500.5, 77.0, 12.0, 300.1, 8.9]) + draw.normal(scale=0.1, size=(2000, 5)))


def short_touch():
    frames = np.zeros((2000, 5))
    frames[300:700, 0] = np.random.default_rng(0).integers(200, 210, 400)
    return frames


@pytest.mark.parametrize("make", [constant, near_an_edge, short_touch, lambda: np.zeros((3, 5))])
def test_a_skin_without_visible_noise_is_no_defect(make):
    assert not check(ChannelHealth((None, 1023)), make()).any()


def test_a_value_that_the_converter_cannot_give_is_unusable_at_once():
    health = ChannelHealth((None, 1023.0))
    health.largest = 1023.0
    found = health.check(np.array([500.0, -300.0, 1023.0, 65535.0, -3.0]), 0.0)
    assert found.tolist() == [OK, Reason.IMPOSSIBLE, SATURATED, Reason.IMPOSSIBLE, OK]
    assert health.states()[1] == "impossible"


FALLING = Calibration(
    {"gain": [2.0, 0.5, 1.0], "offset": [0.1, -0.2, 0.0], "clip": [10.0, 10.0, 10.0]},
    scale=0.02,
    zero=500.0,
    polarity=(1, -1, -1),
)


def raw_of(true: np.ndarray) -> np.ndarray:
    newtons = true * [2.0, 0.5, 1.0] + [0.1, -0.2, 0.0]
    return 500 + np.array([1, -1, -1]) * newtons / 0.02


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
    for zero in (None, raw_of(true)[0]):
        conversion = unit_conversion(3, zero, None, FALLING, None)
        readings, valid = conversion(raw_of(true), np.ones(3, dtype=bool))
        np.testing.assert_allclose(readings, true, atol=1e-5)
        assert valid.all()


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
    assert (frames[-1].values.tolist(), frames[-1].polarity.tolist()) == ([3, 1, 2], [1, -1, 1])
    plain = Decoder(3, polarity=[1, 1, 1])
    assert plain.feed(b"".join(encode_line([1, 2, 3], n, 1000 * n) for n in range(4)))[0].polarity is None


def test_the_other_end_of_the_converter_saturates_a_channel_whose_values_fall():
    rows = [[500 + n % 2, 500 + n % 2] for n in range(10)] + [[0, 0], [1023, 1023], [1, 1022]]
    data = encode_header(Header(n=2, bits=10))
    data += b"".join(encode_line(row, n, 1000 * n) for n, row in enumerate(rows))
    with opened(data, layout=2, polarity=[1, -1]) as skin:
        frames = skin.read(len(rows), timeout=20)
    assert [(*frame.saturated,) for frame in frames[-3:]] == [(False, True), (True, False), (False, False)]
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
