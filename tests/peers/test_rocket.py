"""Inputs of the convolution kernels."""

import torch

from experiments.peers.rocket import Rocket
from skin.device.touches import Touches


def touches(sensors=4):
    """Two touches of ten frames; the first sensor is invalid."""
    readings = torch.randn(2, 10, sensors, generator=torch.Generator().manual_seed(0))
    valid = torch.ones_like(readings, dtype=torch.bool)
    valid[..., 0] = False
    return Touches(readings, valid, torch.zeros(sensors, 3), None, 10.0)


def test_a_channel_is_a_sensor():
    given = touches()
    found = Rocket().inputs(given)
    assert found.shape == (2, 4, 10)
    assert torch.equal(found[:, 1:], given.readings[..., 1:].mT)
    assert not found[:, 0].any()


def test_sorted_channels_do_not_depend_on_offsets_order_and_number_of_sensors():
    given, learner = touches(), Rocket(channels="sorted", largest=6)
    found = learner.inputs(given)
    assert found.shape == learner.inputs(touches(9)).shape == (2, 7, 10)
    # Three valid sensors and an invalid one, which is 0, then nothing.
    assert (found[:, :4].diff(dim=1) <= 0).all()
    torch.testing.assert_close(found[:, -1], found[:, :4].sum(dim=1))
    assert not found[:, 4:6].any()
    other = given.readings.flip(2) + torch.arange(4.0)
    moved = Touches(other, given.valid.flip(2), given.positions, None, given.rate)
    torch.testing.assert_close(learner.inputs(moved), found, atol=1e-5, rtol=0)
