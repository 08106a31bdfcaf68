"""Readings as they are, as images, and as spectra of images."""

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.learning.representation import Fourier, Image, Readings


def image(positions, readings, **options):
    positions = torch.tensor(positions)
    readings = torch.tensor(readings)[None, None]
    return Image(positions, (0.16, 0.08), **options)(readings, torch.ones_like(readings, dtype=torch.bool)).x[
        0, 0, 0
    ]


def test_x_is_the_column_and_y_the_row_also_on_an_oblong_sheet():
    picture = image([[0.15, 0.01, 0.0], [0.01, 0.07, 0.0]], [5.0, 10.0], pixels=16)
    assert picture[2, 15] == 0.5
    assert picture[14, 1] == 1.0
    assert picture.count_nonzero() == 2


def test_a_sensor_on_the_far_edges_falls_in_the_last_pixel():
    assert image([[0.16, 0.08, 0.0]], [10.0], pixels=48)[47, 47] == 1.0


def test_sensors_on_one_pixel_are_averaged():
    picture = image([[0.101, 0.041, 0.0], [0.1011, 0.0412, 0.0], [0.02, 0.02, 0.0]], [2.0, 4.0, 6.0])
    torch.testing.assert_close(picture[picture != 0].sort().values, torch.tensor([0.3, 0.6]))


@pytest.mark.parametrize("pixels", [7, 0, 64.5])
def test_an_image_of_few_pixels_is_refused(pixels):
    with pytest.raises(InputError, match=r"representation\.pixels=64"):
        image([[0.1, 0.01, 0.0]], [5.0], pixels=pixels)


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


def test_readings_then_their_mask():
    readings = torch.tensor([[[1.0, 2.0, 3.0]]])
    valid = torch.tensor([[[True, False, True]]])
    x = Readings(torch.zeros(3, 3), (0.16, 0.16), scale=2.0, mask=True)(readings, valid).x
    assert x.tolist() == [[[0.5, 0.0, 1.5, 0.0, 1.0, 0.0]]]
