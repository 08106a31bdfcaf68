"""The spectrum against numpy's."""

import numpy as np
import torch

from skin.learning.representation import Fourier, Image


def test_the_spectrum_is_that_of_numpy(made_up_device):
    touches = made_up_device.touches("test")[:3]
    given = touches.positions, made_up_device.size
    image = Image(*given, pixels=48)(touches.readings, touches.valid).x.double().numpy()
    wanted = np.log(1 + np.abs(np.fft.fftshift(np.fft.fft2(image), axes=(-2, -1))))
    spectrum = Fourier(*given, pixels=48)(touches.readings, touches.valid).x
    np.testing.assert_allclose(spectrum.numpy(), wanted, atol=1e-5)


def test_a_constant_lies_in_the_middle(made_up_device):
    touches = made_up_device.touches("test")[:1]
    spectrum = Fourier(touches.positions, made_up_device.size)(touches.readings.abs(), touches.valid).x[
        0, 3, 0
    ]
    assert spectrum.argmax() == 32 * 64 + 32
    assert torch.isclose(spectrum[32, 32], torch.log1p(touches.readings.abs()[0, 3].sum() / 10))
