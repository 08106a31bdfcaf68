"""An upright Euler-Bernoulli beam of rectangular section.

Its ends are the lower and the upper node, each with the degrees of freedom (u, v, w, rx, ry, rz), w upwards.
"""

import numpy as np

from skin.material import Material

# Local axes in the rows: x runs up the beam, y along the sheet's y, z against the sheet's x. PyNite turns an
# upright member without rotation like this.
_AXES = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def beam_stiffness(width: np.ndarray, height: np.ndarray, length: float, material: Material) -> np.ndarray:
    """Return the stiffness (n, 12, 12) of n beams of one length.

    Args:
        width: (n,), the sections' extent along x, m.
        height: (n,), the sections' extent along y, m.
        length: m.
        material: what the beams are made of.

    The second moments are the report's (equations 6 to 9): Iy = w h^3 / 12 bends the beam about its local y,
    which moves it along x, and Ix = h w^3 / 12 bends it about its local z. On square cells they are equal.
    """
    second_y = width * height**3 / 12
    second_x = height * width**3 / 12
    modes = {
        "axial": material.young * width * height,
        "torsion": material.shear * (second_y + second_x),
        "about_y": material.young * second_y,
        "about_z": material.young * second_x,
    }
    turn = np.kron(np.eye(4), _AXES)
    local = sum(rigidity[:, None, None] * _unit(mode, length) for mode, rigidity in modes.items())
    return turn.T @ local @ turn


def _unit(mode: str, length: float) -> np.ndarray:
    """Return the local stiffness (12, 12) of one way to deform, at rigidity 1."""
    matrix = np.zeros((12, 12))
    if mode in {"axial", "torsion"}:
        first = 0 if mode == "axial" else 3
        ends = [first, first + 6]
        matrix[np.ix_(ends, ends)] = np.array([[1, -1], [-1, 1]]) / length
        return matrix
    # Bending couples a deflection and a rotation at each end; about y a rotation is a negative slope.
    ends, sign = ([1, 5, 7, 11], 1) if mode == "about_z" else ([2, 4, 8, 10], -1)
    arm = sign * length
    matrix[np.ix_(ends, ends)] = (
        np.array(
            [
                [12, 6 * arm, -12, 6 * arm],
                [6 * arm, 4 * arm**2, -6 * arm, 2 * arm**2],
                [-12, -6 * arm, 12, -6 * arm],
                [6 * arm, 2 * arm**2, -6 * arm, 4 * arm**2],
            ]
        )
        / length**3
    )
    return matrix
