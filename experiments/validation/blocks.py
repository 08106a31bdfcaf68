"""Blocks of the solid's elements with any faces fixed, solved without the simulator's own solver."""

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from skin.body.sheet import Sheet
from skin.simulator._factors import factorised
from skin.simulator._hexahedra import Hexahedra

# Faces of a block, as indices into its nodes (depth, y, x).
FACES: dict[str, tuple[int | slice, ...]] = {
    "left": (slice(None), slice(None), 0),
    "right": (slice(None), slice(None), -1),
    "near": (slice(None), 0, slice(None)),
    "far": (slice(None), -1, slice(None)),
    "top": (0, slice(None), slice(None)),
    "base": (-1, slice(None), slice(None)),
}
ALL = (0, 1, 2)
# Smooth walls on all sides: the block is then one period of an infinite layer.
WALLS: dict[str, tuple[int, ...]] = {"left": (0,), "right": (0,), "near": (1,), "far": (1,), "base": ALL}

_FLAT = Sheet([1.0, 1.0], [2, 2], [{"material": "EcoFlex 00-30", "thickness": 1.0}])  # type: ignore[arg-type]


def block(
    lines: tuple[np.ndarray, np.ndarray, np.ndarray], young: float | np.ndarray, poisson: float | np.ndarray
) -> Hexahedra:
    """Return a flat block.

    Args:
        lines: of its elements along x, y and depth, m.
        young: E, Pa, of all or of each row of elements (K,).
        poisson: nu, of all or of each row (K,).
    """
    x, y, z = (len(line) - 1 for line in lines)
    rows = np.broadcast_to(np.asarray(young, dtype=float), (z,))
    modulus = np.broadcast_to(rows[:, None, None], (z, y, x)).copy()
    ratio = np.broadcast_to(np.asarray(poisson, dtype=float), (z,)).copy()
    return Hexahedra(lines, modulus, ratio, _FLAT.place, _FLAT.frame)


def graded(fine: float, count: int, far: float, growth: float) -> np.ndarray:
    """Return grid lines from 0: ``count`` steps of length ``fine``, then growing steps to beyond ``far``."""
    lines = list(fine * np.arange(count + 1))
    step = fine
    while lines[-1] < far:
        step *= growth
        lines.append(lines[-1] + step)
    return np.array(lines)


def held(mesh: Hexahedra, faces: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    """Return which degrees of freedom are fixed, (3 N,), bool, from the fixed axes of each face."""
    columns, rows, deep = mesh.counts
    mask = np.zeros((deep + 1, rows + 1, columns + 1, 3), dtype=bool)
    for face, axes in faces.items():
        for axis in axes:
            mask[(*FACES[face], axis)] = True
    return mask.ravel()


def solve_block(
    mesh: Hexahedra, fixed: np.ndarray, forces: np.ndarray, stiffness: sp.csc_matrix | None = None
) -> np.ndarray:
    """Return the nodal displacements (3 N, L), m, under nodal forces (3 N, L), N.

    Args:
        mesh: the elements.
        fixed: (3 N,), bool, which degrees of freedom are fixed.
        forces: N.
        stiffness: (3 N, 3 N), N/m; None: that of the mesh.
    """
    whole = mesh.stiffness() if stiffness is None else stiffness
    free = np.flatnonzero(~fixed)
    factors = factorised(whole[free][:, free].tocsc())
    moves = np.zeros_like(forces)
    moves[free] = factors.solve(np.ascontiguousarray(forces[free]))
    return moves


def row_means(values: np.ndarray) -> np.ndarray:
    """Return the middles between neighbours, (n - 1,)."""
    return (values[1:] + values[:-1]) / 2
