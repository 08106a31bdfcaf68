"""A sparse image with one pixel per sensor."""

from typing import Annotated, ClassVar, Literal

import numpy as np
import torch
from annotated_types import Ge
from torch import Tensor

from skin.core.settings import checked
from skin.learning.representation.base import AbstractRepresentation, Frames, channels

# The pixel grid that covers the sheet, shared by the image representations.


Pixels = Annotated[int, Ge(8)]
"""Edge length of a square image."""


def pixel_of(positions: np.ndarray, size: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the flat index (S,) of the pixel in which each position (S, 3), m, falls; rows run along y."""
    # a sensor on the line between two pixels must not fall here or there by rounding to float32
    scaled = np.floor(positions[:, :2] / np.asarray(size) * pixels + 1e-4).astype(int)
    column, row = np.clip(scaled, 0, pixels - 1).T
    return row * pixels + column


def centres(size: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the centres (pixels * pixels, 2) of all pixels as x, y in m, row by row."""
    middle = (np.arange(pixels) + 0.5) / pixels
    y, x = np.meshgrid(middle * size[1], middle * size[0], indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


@checked("representation")
class Image(AbstractRepresentation):
    """Writes each reading to the pixel of its sensor; all other pixels are 0 (report, section 2.2).

    It needs positions only and applies to any layout. Sensors that share a pixel are averaged, because a sum
    would depend on the density of sensors.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m; the square image covers all of it.
        pixels: edge length of the image; the report tries 48, 64 and 128.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 at the pixels of invalid readings.

    Raises:
        InputError: ``pixels`` is below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"
    where: Tensor
    average: Tensor

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.pixels, self.scale, self.mask = pixels, scale, mask
        where, place = np.unique(pixel_of(positions.cpu().numpy(), size, pixels), return_inverse=True)
        share = np.eye(len(where))[place]
        self.register_buffer("where", torch.from_numpy(where))
        self.register_buffer("average", torch.from_numpy(share / share.sum(axis=0)).to(torch.float32))

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        values = channels(readings, valid, self.scale, self.mask).mT @ self.average
        blank = values.new_zeros((*values.shape[:-1], self.pixels**2))
        image = blank.scatter(-1, self.where.expand_as(values), values)
        return Frames(image.unflatten(-1, (self.pixels, self.pixels)), None)
