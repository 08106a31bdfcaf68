"""Where sensors fall in the image."""

import pytest
import torch

from skin.errors import InputError
from skin.learning.representation import Image


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
