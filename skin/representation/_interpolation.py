"""Weights of the interpolation between sensors, without torch."""

from typing import Literal

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import QhullError

from skin.errors import InputError

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
