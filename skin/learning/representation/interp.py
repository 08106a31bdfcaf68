"""An image interpolated between the sensors."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
import torch
from annotated_types import MinLen
from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import QhullError
from torch import Tensor

from skin.core.settings import checked
from skin.errors import InputError
from skin.learning.representation.base import AbstractRepresentation, Frames, channels
from skin.learning.representation.image import Pixels, centres

# Weights of the interpolation between sensors, without torch.


Method = Literal["nearest", "linear", "cubic"]


def weights(points: np.ndarray, targets: np.ndarray, method: Method) -> np.ndarray:
    """Return the matrix (P, S) that interpolates values at ``points`` (S, 2) to ``targets`` (P, 2).

    Methods: nearest; linear on the Delaunay triangles; cubic after Clough and Tocher. All are linear in the
    values, so the columns of the matrix are the images of unit readings. Outside the convex hull the nearest
    value is used.

    Raises:
        InputError: the points do not form a triangle.
    """
    unit = np.eye(len(points))
    matrix = NearestNDInterpolator(points, unit)(targets)
    if method == "nearest":
        return matrix
    try:
        if method == "linear":
            inner = LinearNDInterpolator(points, unit)(targets)
        else:
            # the gradients come from an iteration: only a converged one is linear in the values
            inner = CloughTocher2DInterpolator(points, unit, tol=1e-12, maxiter=5000)(targets)
    except QhullError:
        raise InputError(
            f"representation.method={method} needs at least three sensors that are not in one line, "
            f"got {len(points)}: set representation.method=nearest"
        ) from None
    return np.where(np.isnan(inner), matrix, inner)


@checked("representation")
class Interpolation(AbstractRepresentation):
    """Fills the image between the sensors (report, section 2.2 and figure 4).

    One precomputed matrix (pixels * pixels, S) per method is applied to whole batches. The results table
    shows whether interpolated values help a network.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m; the square image covers all of it.
        method: nearest, linear or cubic (:func:`skin.learning.representation.interp.weights`); or several of
            them, each giving one channel.
        pixels: edge length of the image.
        scale: N; readings are divided by it.
        mask: append the interpolated mask of invalid readings, one channel per method.

    Raises:
        InputError: an unknown method, none at all, too few sensors for it, or ``pixels`` below 8.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "image"
    matrix: Tensor

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        method: Method | Annotated[Sequence[Method], MinLen(1)] = "linear",
        pixels: Pixels = 64,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.pixels, self.scale, self.mask = pixels, scale, mask
        methods: Sequence = method if isinstance(method, list | tuple) else [method]
        points, targets = positions[:, :2].cpu().numpy(), centres(size, pixels)
        matrix = np.concatenate([weights(points, targets, method) for method in methods])
        self.register_buffer("matrix", torch.from_numpy(matrix).to(torch.float32))

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, C, pixels, pixels) of readings (B, T, S), N."""
        values = channels(readings, valid, self.scale, self.mask).mT @ self.matrix.mT
        images = values.unflatten(
            -1, (-1, self.pixels, self.pixels)
        )  # (B, T, readings or mask, methods, ...)
        return Frames(images.flatten(2, 3), None)
