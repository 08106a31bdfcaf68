"""The spectrum of the sensor image."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from skin.core.settings import checked
from skin.learning.representation.base import AbstractRepresentation, Frames
from skin.learning.representation.image import Image, Pixels


@checked("representation")
class Fourier(AbstractRepresentation):
    """Returns ``log(1 + |FFT|)`` of the sensor image, zero frequency in the middle (report, section 2.2).

    It shows regular patterns of active sensors. Absolute positions are lost with the phase.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the image and of its spectrum.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 at the pixels (not frequencies) of invalid readings.

    Raises:
        InputError: ``pixels`` is below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.image = Image(positions, size, pixels=pixels, scale=scale, mask=mask)

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        image = self.image(readings, valid).x
        spectrum = torch.fft.fftshift(torch.fft.fft2(image[:, :, :1]).abs(), dim=(-2, -1))
        return Frames(torch.cat([torch.log1p(spectrum), image[:, :, 1:]], dim=2), None)
