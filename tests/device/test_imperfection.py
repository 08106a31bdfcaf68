"""Imperfections, one by one, and simulated readings between the frames of a model, against a stream."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.device.calibration import Calibration
from skin.device.imperfection import Imperfection, outside
from skin.device.resampling import Frame, Window, resample
from skin.device.sampling import between_frames, measure
from skin.errors import InputError

NONE = {"gain_spread": 0.0, "offset": 0.0, "noise": 0.0}
CALIBRATION = Calibration(
    {"gain": [0.8, 1.2, None], "offset": [0.1, -0.2, 0.3], "clip": [9.0, 5.0, None]},
    {"stuck": [2]},
    {"gain": [0.5, 1.5], "dead": [0, 2]},
)


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def apply(readings: torch.Tensor, seed: int = 0, **settings):
    imperfection = Imperfection(**(NONE | settings))
    constants = imperfection.constants(readings.shape[-1], generator(seed))
    return imperfection.apply(readings, constants, generator(seed + 1000))


def test_noise_and_offset_come_after_gain_and_clip():
    """So what is said passes the clip, as in the report (2.1.4)."""
    readings = torch.linspace(-3, 9, 24).view(2, 3, 4)
    said, valid, _ = apply(readings)
    torch.testing.assert_close(said, readings)
    assert valid.all()
    said, *_ = apply(torch.full((400, 30, 25), 50.0), noise=0.05, offset=0.1)
    assert said.max() > 10.05
    frames, sensors = said.std(dim=(0, 1)), said.mean(dim=(0, 1)) - 10
    torch.testing.assert_close(frames, torch.full((25,), 0.05), rtol=0.05, atol=0)
    assert 0.05 < sensors.std() < 0.16
    assert (apply(torch.full((2, 3, 1000), 50.0), gain_spread=0.05)[0] == 10).all()
    below, *_ = apply(torch.full((2, 3, 1000), 5.0), gain_spread=0.05)
    assert 0.045 < below[0, 0].div(5).log().std() < 0.055
    assert torch.equal(below[0], below[1])


def test_axes_of_a_site_talk_to_each_other_and_to_no_other_site():
    """Fractions are normal with the deviation as set; each channel has a gain of its own, too."""
    force = torch.zeros(1, 1, 3 * 4000)
    force[..., 2::3] = 10.0
    said = apply(force, cross_talk=0.02, clip=100.0)[0].unflatten(-1, (-1, 3))[0, 0]
    assert (said[:, 2] == 10).all()
    assert (said[:, :2].std(dim=0) / 10).tolist() == pytest.approx([0.02, 0.02], rel=0.05)
    force[..., 3:] = 0
    assert (apply(force, cross_talk=0.02)[0][..., 3:] == 0).all()
    many = Imperfection(cross_talk=0.1).constants(6, generator(), gestures=5).cross_talk
    assert (many.shape, len(many.unique())) == ((5, 1, 2, 3, 3), 5 * 2 * 6 + 1)
    gains = apply(torch.ones(1, 1, 3000), gain_spread=0.1)[0].log().view(-1, 3)
    assert np.abs(np.corrcoef(gains.T.numpy()) - np.eye(3)).max() < 0.15


def test_tare_removes_the_offset_but_for_the_noise_of_its_idle_frames():
    idle = torch.zeros(1, 1, 4000)
    with_offset, *_ = apply(idle, offset=0.1)
    tared, *_ = apply(idle, offset=0.1, noise=0.05, tare=True)
    assert with_offset.std() > 0.09
    assert abs(float(tared.std()) - 0.05 * np.sqrt(1 + 1 / 30)) < 0.003


def test_every_device_draws_its_own_number_of_dead_sensors():
    """1 to 4 of 25, equally often: 3000 draws leave a share of a quarter within 0.03 (4 standard errors)."""
    constants = Imperfection(dead=[1, 4]).constants(25, generator(), gestures=3000)
    counts = constants.dead.sum(-1).flatten()
    assert counts.unique().tolist() == [1, 2, 3, 4]
    assert ((counts.bincount()[1:] / 3000 - 0.25).abs() < 0.032).all()
    pairs = zip(*(Imperfection(dead=dead).constants(25, generator()) for dead in ([3, 3], 3)), strict=True)
    assert all(torch.equal(*both) for both in pairs)


def test_living_sensors_at_their_limit_are_saturated():
    imperfection = Imperfection(gain_spread=0, dead=1)
    constants = imperfection.constants(2, generator())
    readings = torch.zeros(3, 4, 2)
    living = int((~constants.dead).nonzero())
    readings[0, 2, living], readings[1, 2, 1 - living], readings[2, 0, living] = 11.0, 11.0, 9.9
    said, valid, saturated = imperfection.apply(readings, constants, generator(1))
    assert saturated.nonzero().tolist() == [[0, 2, living]]
    assert valid[0, 2, living]
    assert said[0, 2, living] == pytest.approx(10.0, abs=1.0)


def test_the_default_device_is_what_it_was():
    """Written down again: clip the force, add noise and offset; the order of the draws is part of it."""
    true = 8 * torch.randn(40, 30, 25, generator=torch.Generator().manual_seed(0)).abs()
    imperfection, draws, again = Imperfection(dead=2), generator(5), generator(5)
    constants = imperfection.constants(25, draws)
    said, valid, _ = imperfection.apply(true, constants, draws)
    gain = torch.from_numpy(np.exp(0.05 * again.standard_normal(25))).float()
    offset = torch.from_numpy(0.1 * again.standard_normal(25)).float()
    dead = torch.from_numpy(again.random(25).argsort().argsort() < 2)
    again.standard_normal(25)
    noise = torch.from_numpy(again.standard_normal(true.shape, dtype=np.float32))
    expected = (true * gain).clamp(-10, 10) + (0.05 * noise + offset)
    assert torch.equal(said, torch.where(dead, 0, expected))
    assert torch.equal(valid, (~dead).expand(true.shape))


def test_stuck_and_saturated_sensors_are_invalid_and_say_one_thing():
    imperfection = Imperfection(dead=1, stuck=2, saturated=3)
    constants = imperfection.constants(25, generator())
    readings = torch.rand(2, 30, 25)
    said, valid, _ = imperfection.apply(readings, constants, generator(1))
    assert (~valid).sum(-1).eq(6).all()
    assert (said[~valid] == 0).all()
    raw = imperfection.raw(readings, constants, generator(1))
    levels = raw[0, 0, ~valid[0, 0]]
    assert (raw[..., ~valid[0, 0]] == levels).all()
    assert ((levels == 0).sum(), (levels == 10).sum()) == (1, 3)
    assert ((levels > 0) & (levels < 10)).sum() == 2


def test_a_tare_is_taken_after_the_converter():
    said, *_ = apply(torch.zeros(1, 50, 200), quantum=0.5, offset=2.0, tare=True, noise=0.01)
    steps = (said - said[:, :1]) / 0.5
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-4)


def test_a_calibrated_device_is_the_real_one_whatever_the_seed():
    imperfection = Imperfection(gain_spread=3, noise=3, offset=3, dead=0, calibration=CALIBRATION)
    for seed in (0, 1):
        constants = imperfection.constants(3, generator(seed))
        said, valid, _ = imperfection.apply(torch.full((1, 2, 3), 10.0), constants, generator())
        torch.testing.assert_close(said[0, 0], torch.tensor([8.1, 4.8, 0]))
        assert valid[0, 0].tolist() == [True, True, False]


def test_the_curve_of_a_calibration_is_undone_as_in_the_live_view():
    """What the hardware sends is bent; a network that learned from bent readings would see others live."""
    curved = Calibration({"gain": [0.8, 1.2, 1.0], "exponent": [0.5, 0.7, 1.0]}, exponent_at=2.0)
    imperfection = Imperfection(calibration=curved, aligned=False, rate=50.0)
    force = torch.linspace(0, 8, 18).view(2, 3, 3)
    constants = imperfection.constants(3, generator())
    expected = force * torch.tensor([0.8, 1.2, 1.0])
    torch.testing.assert_close(imperfection.apply(force, constants, generator())[0], expected)
    sent = imperfection.raw(force, constants, generator())
    assert float(sent[1, 2, 0]) == pytest.approx(2 * (float(expected[1, 2, 0]) / 2) ** 0.5)
    rising = torch.linspace(0, 8, 90).view(1, 30, 3)
    highest, *_ = measure(imperfection, constants, rising, 10.0, generator())
    straight = replace(imperfection, calibration=Calibration({"gain": [0.8, 1.2, 1.0]}))
    plain, *_ = measure(straight, straight.constants(3, generator()), rising, 10.0, generator())
    torch.testing.assert_close(highest, plain, rtol=0.02, atol=0.1)


def test_ranges_give_every_gesture_another_device():
    constants = Imperfection(calibration=CALIBRATION).constants(3, generator(), gestures=3000)
    assert constants.gain.min() >= 0.5
    assert constants.gain.max() <= 1.5
    assert abs(float(constants.gain.mean()) - 1) < 0.02
    assert torch.equal(constants.offset[7], torch.tensor([[0.1, -0.2, 0.3]]))
    counts = constants.dead.sum(-1).flatten().bincount(minlength=4)
    assert counts[3] == 0
    assert (counts[:3] > 900).all()


def test_further_sensors_of_a_calibrated_device_may_die():
    imperfection = Imperfection(dead=1, calibration=CALIBRATION)
    alive = {int((~imperfection.constants(3, generator(seed)).dead).sum()) for seed in range(20)}
    assert alive == {1, 2}
    with pytest.raises(InputError, match=r"device.dead=25 of 25 sensors leaves none alive"):
        Imperfection(dead=25).constants(25, generator())
    with pytest.raises(InputError, match=r"the calibration has 3 sensors, the layout 25"):
        imperfection.constants(25, generator())


def test_a_device_takes_one_share_of_all_its_ranges():
    ranges = {"noise": [0.05, 0.2], "time_constant": (0.0, 0.2), "hysteresis": [0.0, 0.1], "offset": 0.0}
    drawn = Imperfection(**ranges, gain_spread=[0.0, 0.4], drift=[0.0, 0.1]).constants(25, generator(), 2000)
    fraction = (drawn.noise - 0.05) / 0.15
    assert fraction.shape == (2000, 1, 1)
    assert 0 <= fraction.min() < 0.01 < 0.99 < fraction.max() <= 1
    assert fraction.mean() == pytest.approx(0.5, abs=0.03)
    torch.testing.assert_close(drawn.time_constant, 0.2 * fraction)
    torch.testing.assert_close(drawn.hysteresis, 0.1 * fraction)
    for value, maximum in ((drawn.gain.log(), 0.4), (drawn.drift, 0.1)):
        spread = value[:, 0].std(dim=1)
        assert (spread / (maximum * fraction[:, 0, 0])).median().item() == pytest.approx(1, abs=0.05)
    one = Imperfection(**ranges).constants(5, generator(1))
    assert 0.05 <= one.noise.item() <= 0.2


def test_what_lies_outside_of_other_devices_is_named():
    ranges = {"rate": [20.0, 500.0], "time_constant": [0.0, 0.1], "noise": 0.05, "drift": [0.0, 0.05]}
    assert outside({"rate": 100.0, "time_constant": 0.1, "noise": 0.02, "gain_spread": 0.3}, ranges) == []
    device = {"rate": 10.0, "time_constant": [0.0, 0.2], "noise": 0.06}
    lag, noise = "lag 0 to 0.2 s (0 to 0.1 s)", "noise 0.06 N (0.05 to 0.05 N)"
    assert outside(device, ranges) == ["rate 10 Hz (20 to 500 Hz)", lag, noise]


def read(device, force, *gestures, **more):
    """Return what a device says of forces (B, T, S) at 10 Hz: readings, valid and saturated."""
    constants = device.constants(force.shape[-1], generator(), *gestures)
    return measure(device, constants, force, 10.0, generator(1), **more)


ROUGH = {"noise": 0.1, "drift": 0.05, "time_constant": 0.1, "hysteresis": 0.05, "quantum": 0.02, "clip": 4.0}


def touches():
    """Return true readings (2, 12, 3) at 10 Hz of a press that slides, and of a tap of one frame."""
    force = torch.zeros(2, 12, 3)
    force[0, 3:9] = torch.tensor([[1.0, 0, 0], [2, 1, 0], [1, 3, 1], [0, 2, 3], [0, 1, 5], [0, 0, 2]])
    force[1, 6] = torch.tensor([1.0, 2.0, 0.5])
    return force


@pytest.mark.parametrize("rate", [20.0, 40.0, 50.0, 500.0])
def test_a_device_reads_a_short_tap_at_any_phase(rate):
    """A reading is up to half its interval from the peak, towards which the force rises in half a frame."""
    tap = torch.zeros(4000, 3, 1)
    tap[:, 1] = 1.0
    highest = read(Imperfection(rate=rate, **NONE), tap)[0].amax(dim=(1, 2)).numpy()
    loss = 10 / rate  # the largest
    assert 1 - loss <= highest.min() < 1 - 0.99 * loss
    assert 1 - 0.01 * loss < highest.max() <= 1.0
    error = 5 * loss / np.sqrt(12 * len(highest))
    assert highest.mean() == pytest.approx(1 - loss / 2, abs=error)


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0, 1000.0])
def test_a_touch_begins_and_ends_at_the_edges_of_its_frames(rate):
    fine = between_frames(touches(), 10.0, rate)
    number = round(rate / 10)
    touched = (touches() != 0).any(2).repeat_interleave(number, dim=1)
    assert torch.equal((fine != 0).any(2), touched)
    rising = fine[1, 6 * number : 6 * number + number // 2]
    assert (rising[:, 1] <= 2.0).all()
    assert rising[0, 1].item() == pytest.approx(2.0 / number)


@pytest.mark.parametrize("rate", [9.6, 10.0, 20.0, 50.0, 100.0])
def test_a_simulated_device_reads_like_a_real_one(rate):
    """The frames of a device at a rate, added one by one to the window of a live skin."""
    device = Imperfection(rate=rate, dead=1, **ROUGH)
    constants, found = device.constants(3, generator()), read(device, touches())
    noise = generator(1)
    fine = touches() if rate <= 10.0 else between_frames(touches(), 10.0, rate, noise.random(2))
    values, works, limited = (one.numpy() for one in device.apply(fine, constants, noise))
    for gesture in range(2):
        window = Window(12, 10.0, 3)
        for number, row in enumerate(values[gesture]):
            frame = Frame(number, number / rate, 0.0, row, works[gesture, number])
            window.add(frame._replace(saturated=limited[gesture, number]))
        for measured, seen in zip(found, window.read(), strict=False):
            np.testing.assert_array_equal(measured[gesture].numpy(), seen)


def test_each_gesture_is_read_as_a_single_one_is():
    """At one rate, touches that are read each at a rate of their own are those that are read together."""
    settings = {"drift": 0.05, "quantum": 0.02, "clip": 4.0, "noise": 0.0}
    together, each = (Imperfection(rate=rate, dead=1, **settings) for rate in (70.0, (70.0, 70.0)))
    constants = together.constants(3, generator())
    expected, drawn = (measure(one, constants, touches(), 10.0, generator(1)) for one in (together, each))
    # A drift is taken in the middle of the interval, so a few readings round to the next step.
    error = (drawn[0] - expected[0]).abs()
    assert (error <= 0.021).all()
    assert (error > 1e-5).float().mean() < 0.25
    assert all(torch.equal(one, other) for one, other in zip(drawn[1:], expected[1:], strict=True))


@pytest.mark.parametrize("rate", [40.0, 100.0, 370.0])
def test_lag_and_hysteresis_before_the_converter_are_those_at_the_rate_of_the_device(rate):
    """They are computed at 50 Hz whatever the rate; the device's own steps differ by part of a step."""
    slow = {"time_constant": 0.05, "hysteresis": 0.05, "noise": 0.0, "offset": 0.0}
    together, each = (Imperfection(rate=bounds, **slow) for bounds in (rate, (rate, rate)))
    constants = together.constants(3, generator())
    expected, drawn = (measure(one, constants, touches(), 10.0, generator(1))[0] for one in (together, each))
    step = max(1 / rate, 0.02)
    # The force rises by at most 2 N in 0.05 s, of which the lag passes on 1 - exp(-step / 0.05).
    assert (drawn - expected).abs().max() < 5.0 * (1 - np.exp(-step / 0.05))
    assert (drawn - expected).abs().mean() < 0.1


def test_unaligned_readings_are_those_of_the_common_resampler():
    """Each device reads at its own rate; the window is cut as that of a live skin is."""
    rates, tap = np.array([10.0, 12.3, 47.0, 100.0, 999.0]), torch.zeros(5, 12, 2)
    tap[:, 6] = torch.tensor([1.0, -3.0])
    tap[4, 6:] = torch.tensor([1.0, -3.0])  # until the end of the window: it is moved to the front
    device = Imperfection(rate=(10.0, 1000.0), aligned=False, **NONE)
    constants = device.constants(2, generator(0), 5)
    constants = constants._replace(rate=torch.from_numpy(rates).reshape(5, 1, 1))
    readings, valid, saturated = measure(device, constants, tap, 10.0, generator(1))
    later = generator(1).random(5) - (tap[:, -1, 0] != 0).numpy()
    for number, (rate, shift) in enumerate(zip(rates, later, strict=True)):
        time = 1.2 - (np.arange(round(1.2 * rate + 0.5), 0, -1) - 0.5) / rate
        time = time[time > 0]
        knots, force = ([6, 6.5, 11.5, 12], [0, 1, 1, 0]) if number == 4 else ([6, 6.5, 7], [0, 1, 0])
        fraction = np.interp(10 * time - shift, knots, force)
        values = fraction[:, None] * [1.0, -3.0]
        works = np.ones(values.shape, dtype=bool)
        seen = resample(time, values, works, ~works, 1.2, 0.1, 12)
        np.testing.assert_allclose(readings[number].numpy(), seen.values, atol=1e-5)
    assert valid.all()
    assert not saturated.any()


def test_a_touch_that_goes_on_is_shown_to_the_middle_of_its_last_frame():
    rising = torch.arange(-2.0, 4.0).clamp(min=0)[None, :, None].expand(2000, -1, 1)
    device = Imperfection(rate=1000.0, aligned=False, **NONE)
    readings = read(device, rising, ongoing=True)[0][:, :, 0]
    # A reading is up to 1 ms from the middle, in which it falls by 0.06.
    torch.testing.assert_close(readings[:, -1], torch.full((2000,), 3.0), atol=0.06, rtol=0)
    # With a uniform phase: the first interval of the touch holds from nothing to its first frame.
    assert 0.2 < (readings[:, 2] > 0.01).float().mean() < 0.8
    assert readings[:, 4].min() < 2.1
    assert readings[:, 4].max() > 2.4


def test_a_share_of_devices_has_no_lag_and_each_has_one_scale():
    ranges = {"time_constant": (0.02, 0.1), "hysteresis": (0.01, 0.1), "independent": True}
    device = Imperfection(without_lag=0.4, **ranges)
    constants = device.constants(3, generator(0), 2000)
    assert (constants.time_constant == 0).float().mean().item() == pytest.approx(0.4, abs=0.04)
    assert (constants.hysteresis > 0).all()
    former = Imperfection(**ranges, gain_spread=0.0, scale_spread=0.2)
    gain = former.constants(3, generator(0), 2000).gain
    assert torch.equal(gain, gain[:, :, :1].expand_as(gain))
    assert gain[:, 0, 0].log().std().item() == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("rate", [10.0, 30.0, 1000.0])
def test_the_noise_of_an_interval_is_the_largest_of_its_frames(rate):
    """It is drawn at once where nothing touches, and frame by frame elsewhere; both are the same noise."""
    device = Imperfection(rate=(rate, rate), noise=0.1, offset=0.0, aligned=False)
    force = torch.zeros(1000, 8, 20)
    force[:, 2:5] = 0.002  # N, felt by the device, and nothing beside the noise
    readings = read(device, force)[0]
    direct = 0.1 * generator(2).standard_normal((20000, round(rate / 10))).max(axis=1)
    fractions = np.linspace(0.02, 0.98, 25)
    for values in (readings[:, 3], readings[:, 6:]):
        drawn, expected = (np.quantile(noise, fractions) for noise in (values.numpy(), direct))
        np.testing.assert_allclose(drawn, expected, atol=0.008)
