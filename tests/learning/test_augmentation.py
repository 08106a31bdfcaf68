"""Changed touches keep their labels true."""

import pytest
import torch

from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.data import Augmentation

TIME, SENSORS = 30, 4


@pytest.fixture
def touches():
    """Return touches of 8 frames that begin at frame 5 to 12, over constant offsets."""
    generator = torch.Generator().manual_seed(0)
    readings = torch.randn(64, 1, SENSORS, generator=generator).expand(-1, TIME, -1).clone()
    for number in range(64):
        start = 5 + number % 8
        readings[number, start : start + 8] += torch.arange(1.0, 9.0)[:, None]
    valid = torch.ones_like(readings, dtype=torch.bool)
    return Touches(readings, valid, torch.rand(SENSORS, 3), torch.ones(64, 4), 10.0)


def changed(touches, seed=1, **settings):
    return Augmentation(**settings)(touches, torch.Generator().manual_seed(seed))


def pressed(touches):
    excess = touches.readings - touches.readings.amin(dim=1, keepdim=True)
    return excess.amax(dim=2)


def test_nothing_asked_changes_nothing(touches):
    assert torch.equal(changed(touches).readings, touches.readings)


def test_a_shift_moves_the_touch_whole(touches):
    before, after = pressed(touches), pressed(changed(touches, shift=True))
    first = (after > 0).int().argmax(dim=1)
    assert len(first.unique()) > 8
    for number, start in enumerate(first.tolist()):
        assert torch.allclose(after[number, start : start + 8], torch.arange(1.0, 9.0))
    torch.testing.assert_close(after.sum(dim=1), before.sum(dim=1))


def test_every_second_touch_runs_backwards(touches):
    after = changed(touches, reverse=True).readings
    back = (after == touches.readings.flip(1)).all(dim=(1, 2))
    kept = (after == touches.readings).all(dim=(1, 2))
    assert (back ^ kept).all()
    assert 16 < back.sum() < 48


def test_gain_is_one_factor_per_sensor_and_touch(touches):
    factor = changed(touches, gain=0.1).readings / touches.readings
    torch.testing.assert_close(factor, factor[:, :1].expand_as(factor))
    assert factor[:, 0].log().std() == pytest.approx(0.1, rel=0.15)


def test_noise_has_the_deviation_that_was_asked_for(touches):
    assert (changed(touches, noise=0.2).readings - touches.readings).std() == pytest.approx(0.2, rel=0.05)


def test_the_generator_decides(touches):
    settings = {"shift": True, "reverse": True, "gain": 0.1, "noise": 0.1}
    once = changed(touches, **settings).readings
    assert torch.equal(changed(touches, **settings).readings, once)
    assert not torch.equal(changed(touches, seed=2, **settings).readings, once)


def test_what_cannot_be_is_refused(touches):
    with pytest.raises(InputError, match=r"data\.augment\.noise=-1 must be"):
        Augmentation(noise=-1)
