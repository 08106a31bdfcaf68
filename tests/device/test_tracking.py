"""How far sensors have moved, as a device tells it."""

from functools import partial

import numpy as np
import pytest
import torch

from skin.body.sheet import Sheet
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.layout.grid import Grid
from skin.layout.scattered import Scattered
from skin.simulator.fem import PlatesAndBeams
from skin.simulator.naive import Naive

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
BODY = Sheet([0.16, 0.16], [16, 16], LAYERS)


def device(**changes) -> Simulated:
    """Return a small device whose sensors may move along the sheet."""
    given = {
        "body": BODY,
        "layout": Grid(4, 4),
        "simulator": partial(PlatesAndBeams, constraint="free"),
        "gestures": 60,
        "test_gestures": 200,
    }
    return Simulated(**(given | changes))


@pytest.fixture(scope="module")
def oracle():
    return device(track="oracle")


def test_without_tracking_nothing_changes(oracle):
    plain, told = device().touches("test"), oracle.touches("test")
    assert plain.motion is None
    assert torch.equal(plain.readings, told.readings)
    assert torch.equal(plain.positions, told.positions)
    assert told.motion.shape == (*told.readings.shape, 3)


def test_true_motion_is_what_each_frame_of_the_movie_does(oracle):
    """Independent answer: the dense movie, frame by frame, through the float64 rows."""
    movie = oracle.sampler.sample(8, np.random.default_rng(0))
    frames = movie.pressure().flatten(2).double().numpy()
    operator = oracle.model.operator
    expected = np.stack(
        [frames @ rows.T for rows in (operator.along_x, operator.along_y, operator.sensor)], axis=-1
    )
    motion = oracle.tracker.motion(movie).numpy()
    np.testing.assert_allclose(motion, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_a_split_keeps_each_touch_with_its_motion(oracle):
    """A sensor sinks exactly as far as the recording's D_s says."""
    for split in ("train", "holdout", None):
        recording = oracle.recording(split)
        torch.testing.assert_close(recording.touches.motion[..., 2], recording.displacement[..., 0])


def test_the_estimate_foretells_the_motion_of_test_gestures(oracle):
    told, true = device(track="estimated").touches("test").motion, oracle.touches("test").motion
    for axis in range(3):
        unexplained = (told - true)[..., axis].square().mean() / true[..., axis].square().mean()
        assert unexplained < (0.5 if axis < 2 else 0.1)


def test_the_estimate_is_a_matter_of_readings_alone():
    """It is one linear map, the same for every device of a kind, and knows neither noise nor error of one."""
    first = device(track="estimated")
    touches = first.touches("test")
    expected = (touches.readings @ first.tracker.weights).view_as(touches.motion)
    torch.testing.assert_close(touches.motion, expected)
    for changes in ({"seed": 5}, {"position_error": 0.005}):
        assert torch.equal(device(track="estimated", **changes).tracker.weights, first.tracker.weights)
    varied = device(track="estimated", body=Sheet([0.16, 0.16], [16, 16], LAYERS, variation=0.2))
    assert torch.equal(varied.tracker.weights, first.tracker.weights)


def test_another_layout_is_tracked_as_itself(oracle):
    other = oracle.replace(layout=Scattered(4, 4, seed=1), track="estimated")
    assert other.touches("test").motion.shape == (200, 30, 16, 3)
    assert not torch.equal(other.tracker.weights, device(track="estimated").tracker.weights)


def test_windows_of_a_stream_are_tracked_too():
    """Where a window shows no touch nothing has moved; elsewhere sensors sink as far as D_s says."""
    recording = device(track="oracle", stream=True).recording("train")
    motion = recording.touches.motion
    torch.testing.assert_close(motion[..., 2], recording.displacement[..., 0])
    idle = recording.force == 0
    assert idle.any()
    assert not motion[idle].any()


@pytest.mark.parametrize("track", ["oracle", "estimated"])
@pytest.mark.parametrize(("simulator", "says"), [(PlatesAndBeams, "constraint=vertical"), (Naive, "=naive")])
def test_sensors_that_cannot_move_are_refused_with_what_mends_it(track, simulator, says):
    with pytest.raises(InputError, match=rf"{says}: set .*simulator\.constraint=free"):
        device(track=track, simulator=simulator)


def test_an_unknown_choice_is_refused():
    with pytest.raises(InputError, match=r"device.track=camera must be 'none', 'oracle' or 'estimated'"):
        device(track="camera")
