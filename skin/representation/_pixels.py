"""The pixel grid that covers the sheet, shared by the image representations."""

from typing import Annotated

import numpy as np
from annotated_types import Ge

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
