"""The perceptron keeps sensors apart."""

import torch

from skin.learning.model import Mlp


def test_no_layer_leaves_the_readings_as_they_are():
    model = Mlp("readings", (5,), widths=[])
    x = torch.randn(3, 5)
    assert torch.equal(model(x, None), x)
    assert model.width == 5


def test_every_sensor_has_weights_of_its_own():
    torch.manual_seed(0)
    model = Mlp("readings", (5,), widths=[8])
    x = torch.randn(3, 5)
    assert not torch.allclose(model(x.flip(1), None), model(x, None))
