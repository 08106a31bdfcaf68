"""Picture of the skin: readings interpolated between the sensors."""

import numpy as np
from scipy.spatial import ConvexHull, Delaunay

from skin.representation._interpolation import weights
from skin.representation._pixels import centres

_FEWEST = 3
_INWARDS = 1e-6


class SkinPicture:
    """Interpolates readings between the sensors, for display only.

    Linear inside the sensors' hull, as ``representation=interp`` does; outside, as at the nearest point of
    the hull, so that there is no edge. Nearest neighbour if there is no triangle.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        pixels: edge length of the picture, which is stretched over the sheet.
        top: N at the brightest value.
    """

    def __init__(self, positions: np.ndarray, size: tuple[float, float], pixels: int, top: float) -> None:
        self.pixels, self.top = pixels, top
        self._points, self._targets = np.asarray(positions, dtype=float)[:, :2], centres(size, pixels)
        self._known = np.ones(len(self._points), dtype=bool)
        self._matrix = self._weights()

    def _weights(self) -> np.ndarray:
        """Return the weights (P, S) of the known sensors."""
        points, found = (
            self._points[self._known],
            np.zeros((len(self._targets), len(self._known)), np.float32),
        )
        if len(points):
            flat = len(points) < _FEWEST or np.linalg.matrix_rank(points - points[0], tol=1e-6) < 2
            if flat:
                found[:, self._known] = weights(points, self._targets, "nearest")
            else:
                found[:, self._known] = weights(points, _inside(points, self._targets), "linear")
        return found

    def __call__(self, values: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
        """Return the picture of readings (S,), N, as (pixels, pixels), uint8: 255 is ``top`` and above.

        Args:
            values: N.
            known: (S,), bool; other sensors are left out, not shown as 0; None: all are known.
        """
        known = np.ones(len(values), dtype=bool) if known is None else known
        if not np.array_equal(known, self._known):
            self._known = known.copy()
            self._matrix = self._weights()
        image = self._matrix @ values.astype(np.float32)
        return (255 * np.clip(image / self.top, 0, 1)).astype(np.uint8).reshape(self.pixels, self.pixels)


def _inside(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return targets (P, 2), those outside of the hull of points (S, 2) moved to its nearest point."""
    outside = Delaunay(points).find_simplex(targets) < 0
    corners = points[ConvexHull(points).vertices]
    along = np.roll(corners, -1, axis=0) - corners
    share = ((targets[outside, None] - corners) * along).sum(axis=2) / (along**2).sum(axis=1)
    feet = corners + share.clip(0, 1)[..., None] * along
    nearest = ((feet - targets[outside, None]) ** 2).sum(axis=2).argmin(axis=1)
    moved = targets.copy()
    on_edge = feet[np.arange(len(feet)), nearest]
    # A little inwards, so that rounding does not leave them outside.
    moved[outside] = on_edge + _INWARDS * (corners.mean(axis=0) - on_edge)
    return moved
