"""The skin as a picture: what lies between the sensors, guessed."""

import numpy as np
from scipy.spatial import ConvexHull, Delaunay

from skin.representation._pixels import centres
from skin.representation.interp import weights

__all__ = ["Picture"]

_FEWEST = 3
_INWARDS = 1e-6


class Picture:
    """Interpolates between the sensors: to look at, not to measure.

    Linear inside the sensors' hull, as ``representation=interp`` does; outside, as at the nearest point of
    the hull, so that there is no edge. Nearest where no triangle can be made.

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
        found = (
            weights(points, targets, "nearest")
            if flat
            else weights(points, _inside(points, targets), "linear")
        )
        self._matrix = found.astype(np.float32)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the picture of readings (S,), N, as (pixels, pixels), uint8: 255 is ``top`` and above."""
        image = self._matrix @ values.astype(np.float32)
        return (255 * np.clip(image / self.top, 0, 1)).astype(np.uint8).reshape(self.pixels, self.pixels)


def _inside(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return targets (P, 2), those outside of the hull of points (S, 2) moved to the nearest place in it."""
    outside = Delaunay(points).find_simplex(targets) < 0
    corners = points[ConvexHull(points).vertices]
    along = np.roll(corners, -1, axis=0) - corners
    share = ((targets[outside, None] - corners) * along).sum(axis=2) / (along**2).sum(axis=1)
    feet = corners + share.clip(0, 1)[..., None] * along
    nearest = ((feet - targets[outside, None]) ** 2).sum(axis=2).argmin(axis=1)
    moved = targets.copy()
    on_edge = feet[np.arange(len(feet)), nearest]
    # A little inwards, for rounding must not leave them outside.
    moved[outside] = on_edge + _INWARDS * (corners.mean(axis=0) - on_edge)
    return moved
