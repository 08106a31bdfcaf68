"""The skin as a picture: what lies between the sensors, guessed."""

import numpy as np

from skin.representation._pixels import centres
from skin.representation.interp import weights

__all__ = ["Picture"]

_FEWEST = 3


class Picture:
    """Interpolates between the sensors as ``representation=interp`` does: to look at, not to measure.

    Linear inside the sensors' hull and nearest outside; nearest where no triangle can be made.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the picture, which is stretched over the sheet.
        top: N that are shown brightest.
    """

    def __init__(self, positions: np.ndarray, size: tuple[float, float], pixels: int, top: float) -> None:
        self.pixels, self.top = pixels, top
        points, targets = np.asarray(positions, dtype=float)[:, :2], centres(size, pixels)
        flat = len(points) < _FEWEST or np.linalg.matrix_rank(points - points[0], tol=1e-6) < 2
        self._matrix = weights(points, targets, "nearest" if flat else "linear").astype(np.float32)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the picture of readings (S,), N, as (pixels, pixels), uint8: 255 is ``top`` and above."""
        image = self._matrix @ values.astype(np.float32)
        return (255 * np.clip(image / self.top, 0, 1)).astype(np.uint8).reshape(self.pixels, self.pixels)
