"""Simulated readings between the frames of a model, against a stream that is read frame by frame."""

import numpy as np
import pytest
import torch

from skin.device.imperfection import Imperfection, between_frames, draw_constants, idle_excess, measure
from skin.device.resampling import Frame, Window

ROUGH = {"noise": 0.1, "drift": 0.05, "time_constant": 0.1, "hysteresis": 0.05, "quantum": 0.02, "clip": 4.0}


def touches():
    """Return true readings (2, 12, 3) at 10 Hz of a press that slides, and of a tap of one frame."""
    force = torch.zeros(2, 12, 3)
    force[0, 3:9] = torch.tensor([[1.0, 0, 0], [2, 1, 0], [1, 3, 1], [0, 2, 3], [0, 1, 5], [0, 0, 2]])
    force[1, 6] = torch.tensor([1.0, 2.0, 0.5])
    return force


def test_at_the_rate_of_the_model_nothing_changes():
    assert torch.equal(between_frames(touches(), 10.0, 10.0), touches())


@pytest.mark.parametrize("rate", [30.0, 50.0, 70.0])
def test_the_middle_of_an_interval_is_the_frame(rate):
    number = round(rate / 10)
    fine = between_frames(touches(), 10.0, rate)
    assert torch.equal(fine[:, number // 2 :: number], touches())


def test_between_two_frames_the_force_changes_linearly():
    fine = between_frames(touches(), 10.0, 50.0)[0]
    # From the middle of frame 4, the third of its interval, to that of frame 5.
    expected = torch.stack([torch.lerp(touches()[0, 4], touches()[0, 5], share / 5) for share in range(6)])
    torch.testing.assert_close(fine[22:28], expected)


@pytest.mark.parametrize("rate", [20.0, 40.0, 50.0, 500.0])
def test_a_device_reads_a_short_tap_at_any_phase(rate):
    """A reading is up to half its interval from the peak, towards which the force rises in half a frame."""
    tap = torch.zeros(4000, 3, 1)
    tap[:, 1] = 1.0
    ideal = Imperfection(rate=rate, gain_spread=0.0, offset=0.0, noise=0.0)
    constants = ideal.constants(1, np.random.default_rng(0))
    highest = measure(ideal, constants, tap, 10.0, np.random.default_rng(1))[0].amax(dim=(1, 2)).numpy()
    loss = 10 / rate  # the largest
    assert 1 - loss <= highest.min() < 1 - 0.99 * loss
    assert 1 - 0.01 * loss < highest.max() <= 1.0
    error = 5 * loss / np.sqrt(12 * len(highest))
    assert highest.mean() == pytest.approx(1 - loss / 2, abs=error)


@pytest.mark.parametrize("rate", [12.3, 37.0])
@pytest.mark.parametrize("phase", [0.0, 0.5, 0.999])
def test_between_frames_never_exceeds_them(rate, phase):
    force = touches().roll(3, dims=1)  # a press until the last frame
    fine = between_frames(force, 10.0, rate, phase)
    assert (fine >= 0).all()
    assert (fine <= force.amax(dim=1, keepdim=True)).all()


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0, 1000.0])
def test_a_touch_begins_and_ends_at_the_edges_of_its_frames(rate):
    fine = between_frames(touches(), 10.0, rate)
    number = round(rate / 10)
    touched = (touches() != 0).any(2).repeat_interleave(number, dim=1)
    assert torch.equal((fine != 0).any(2), touched)
    rising = fine[1, 6 * number : 6 * number + number // 2]
    assert (rising[:, 1] <= 2.0).all()
    assert rising[0, 1].item() == pytest.approx(2.0 / number)


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 100.0])
def test_a_simulated_device_reads_like_a_real_one(rate):
    """The frames of a device at a rate, added one by one to the window of a live skin."""
    device = Imperfection(rate=rate, dead=1, **ROUGH)
    constants = device.constants(3, np.random.default_rng(0))
    readings, valid, saturated = measure(device, constants, touches(), 10.0, np.random.default_rng(1))
    noise = np.random.default_rng(1)
    fine = touches() if rate == 10.0 else between_frames(touches(), 10.0, rate, noise.random(2))
    values, works, limited = (one.numpy() for one in device.apply(fine, constants, noise))
    for gesture in range(2):
        window = Window(12, 10.0, 3)
        for number, row in enumerate(values[gesture]):
            frame = Frame(number, number / rate, 0.0, row, works[gesture, number])
            window.add(frame._replace(saturated=limited[gesture, number]))
        seen = window.read()
        np.testing.assert_array_equal(readings[gesture].numpy(), seen.values)
        np.testing.assert_array_equal(valid[gesture].numpy(), seen.valid)
        np.testing.assert_array_equal(saturated[gesture].numpy(), seen.saturated)


def test_a_device_slower_by_five_percent_gives_a_frame_to_each_interval():
    device = Imperfection(rate=9.6)
    constants = device.constants(3, np.random.default_rng(0))
    found = measure(device, constants, touches(), 10.0, np.random.default_rng(1))
    expected = device.apply(touches(), constants, np.random.default_rng(1))
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


@pytest.mark.parametrize("rate", [20.0, 100.0, 500.0])
def test_the_noise_of_an_interval_raises_idle_readings(rate):
    device = Imperfection(rate=rate, noise=0.1)
    constants = device.constants(3, np.random.default_rng(0))
    drawn = 0.1 * np.random.default_rng(0).standard_normal((100000, round(rate / 10))).max(axis=1)
    excess = idle_excess(device, constants, 10.0).item()
    assert excess == pytest.approx(drawn.mean(), abs=5 * drawn.std() / np.sqrt(len(drawn)))
    tared = Imperfection(rate=rate, noise=0.1, tare=True)
    raised = draw_constants(tared, 3, 10.0, np.random.default_rng(0)).baseline
    torch.testing.assert_close(raised, tared.constants(3, np.random.default_rng(0)).baseline + excess)
