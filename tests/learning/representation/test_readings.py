"""Plain readings keep the order of the sensors."""

import torch

from skin.learning.representation import Readings


def test_readings_then_their_mask():
    readings = torch.tensor([[[1.0, 2.0, 3.0]]])
    valid = torch.tensor([[[True, False, True]]])
    x = Readings(torch.zeros(3, 3), (0.16, 0.16), scale=2.0, mask=True)(readings, valid).x
    assert x.tolist() == [[[0.5, 0.0, 1.5, 0.0, 1.0, 0.0]]]
