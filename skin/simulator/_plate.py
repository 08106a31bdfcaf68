"""A rectangular plate: Adini-Clough-Melosh bending and a bilinear membrane.

Nodes run (0, 0), (a, 0), (a, b), (0, b); each has the six degrees of freedom (u, v, w, rx, ry, rz) with w
upwards, rx = dw/dy and ry = -dw/dx. Rotation about z has no stiffness: supports hold it.
"""

import numpy as np

from skin.material import Material

_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
# Powers (of x, of y) of the twelve terms of the deflection (Melosh 1963).
_POWERS = np.array(
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3), (3, 1), (1, 3)]
)
_BENDING = [6 * node + dof for node in range(4) for dof in (2, 3, 4)]
_MEMBRANE = [6 * node + dof for node in range(4) for dof in (0, 1)]


def plate_stiffness(a: float, b: float, thickness: float, material: Material) -> np.ndarray:
    """Return the stiffness (24, 24) of a plate a x b x thickness, m: forces in N, moments in N m."""
    elastic = (
        material.young
        / (1 - material.poisson**2)
        * np.array([[1, material.poisson, 0], [material.poisson, 1, 0], [0, 0, (1 - material.poisson) / 2]])
    )
    matrix = np.zeros((24, 24))
    matrix[np.ix_(_BENDING, _BENDING)] = _integral(_curvature, a, b, elastic * thickness**3 / 12)
    matrix[np.ix_(_MEMBRANE, _MEMBRANE)] = _integral(_strain, a, b, elastic * thickness)
    return matrix


def pressure_load(a: float, b: float) -> np.ndarray:
    """Return the nodal forces and moments (24,) of a downward pressure of 1 Pa on a plate a x b, m.

    Four equal corner forces and the corner moments consistent with the bending terms.
    """
    load = np.zeros((4, 6))
    for node, (x, y) in enumerate(_CORNERS):
        load[node, 2] = -a * b / 4
        load[node, 3] = -a * b * b / 24 * (1 - 2 * y)
        load[node, 4] = a * b * a / 24 * (1 - 2 * x)
    return load.ravel()


def _integral(strains, a: float, b: float, elastic: np.ndarray) -> np.ndarray:
    """Integrate B' D B over the plate; three Gauss points a side are exact for both fields."""
    points, weights = np.polynomial.legendre.leggauss(3)
    total = np.zeros(1)
    for x, weight_x in zip((points + 1) / 2, weights / 2, strict=True):
        for y, weight_y in zip((points + 1) / 2, weights / 2, strict=True):
            matrix = strains(x, y, a, b)
            total = total + a * b * weight_x * weight_y * (matrix.T @ elastic @ matrix)
    return total


def _terms(x: float, y: float, a: float, b: float, along_x: int = 0, along_y: int = 0) -> np.ndarray:
    """Return a derivative of the twelve terms (x/a)^p (y/b)^q at x, y in units of a, b.

    In these units the fit below stays well conditioned on cells of a few millimetres.
    """
    p, q = _POWERS.T
    return _power(x, p, along_x) * _power(y, q, along_y) / (a**along_x * b**along_y)


def _power(x: float, powers: np.ndarray, derivative: int) -> np.ndarray:
    factor = np.ones(len(powers))
    for step in range(derivative):
        factor = factor * (powers - step)
    return factor * np.float64(x) ** np.maximum(powers - derivative, 0)


def _curvature(x: float, y: float, a: float, b: float) -> np.ndarray:
    """Return the curvatures (w_xx, w_yy, 2 w_xy) per bending degree of freedom, (3, 12)."""
    fit = np.vstack(
        [
            row
            for corner in _CORNERS
            for row in (
                _terms(*corner, a, b),
                _terms(*corner, a, b, along_y=1),
                -_terms(*corner, a, b, along_x=1),
            )
        ]
    )
    curvatures = [
        _terms(x, y, a, b, along_x=2),
        _terms(x, y, a, b, along_y=2),
        2 * _terms(x, y, a, b, along_x=1, along_y=1),
    ]
    return np.vstack(curvatures) @ np.linalg.inv(fit)


def _strain(x: float, y: float, a: float, b: float) -> np.ndarray:
    """Return the strains (u_x, v_y, u_y + v_x) per membrane degree of freedom, (3, 8)."""
    matrix = np.zeros((3, 8))
    for node, (corner_x, corner_y) in enumerate(_CORNERS):
        share_x, share_y = (x if corner_x else 1 - x), (y if corner_y else 1 - y)
        slope_x, slope_y = (2 * corner_x - 1) / a, (2 * corner_y - 1) / b
        matrix[0, 2 * node] = matrix[2, 2 * node + 1] = slope_x * share_y
        matrix[1, 2 * node + 1] = matrix[2, 2 * node] = slope_y * share_x
    return matrix
