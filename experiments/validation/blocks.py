"""Solutions without the simulator's own solver: by the solid's elements, and by scikit-fem alone."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from skfem import (
    BilinearForm,
    CellBasis,
    ElementHex0,
    ElementHex1,
    ElementVector,
    FacetBasis,
    Functional,
    LinearForm,
    MeshHex,
    condense,
)
from skfem.helpers import ddot, div, sym_grad, trace

from skin.body.sheet import Sheet
from skin.mechanics.simulator._hexahedra import Hexahedra
from skin.mechanics.simulator.base import factorised

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


_GAUSS = (np.array([-1, 1]) / np.sqrt(3) + 1) / 2


@dataclass(frozen=True)
class FrameSolution:
    """The solution of one frame.

    Attributes:
        reading: normal force on a rectangle of whole cells, N.
        sensor: displacement into the skin of the node in its middle, m.
        surface: the same of the node above, m.
    """

    reading: float
    sensor: float
    surface: float


def solve_frame(
    mesh: Hexahedra, pressure: np.ndarray, shear: float, place: np.ndarray, extent: float
) -> FrameSolution:
    """Solve a flat skin under one frame in the mixed form, with one pressure unknown per element.

    Args:
        mesh: gives points, cells and materials.
        pressure: (H, W), Pa.
        shear: tangential traction along x divided by the pressure.
        place: (3,), m: a node between two rows of elements.
        extent: side of the sensor's footprint, m: whole cells about the node.
    """
    points = MeshHex(mesh.nodes.T.copy(), mesh.corners.T.copy())
    basis = CellBasis(points, ElementVector(ElementHex1()), intorder=2)
    inner = basis.with_element(ElementHex0())
    lam, mu = mesh.lame
    shape = basis.dx.shape
    fields = {"mu": np.broadcast_to(mu[:, None], shape), "lam": np.broadcast_to(lam[:, None], shape)}
    elastic = BilinearForm(lambda u, v, w: 2 * w.mu * ddot(sym_grad(u), sym_grad(v))).assemble(
        basis, **fields
    )
    grown = BilinearForm(lambda u, q, w: div(u) * q).assemble(basis, inner)
    squeezed = BilinearForm(lambda p, q, w: p * q / w.lam).assemble(inner, **fields)
    whole = sp.block_array([[elastic, grown.T], [grown, -squeezed]]).tocsr()

    top = FacetBasis(points, basis.elem, facets=points.facets_satisfying(lambda x: np.abs(x[2]) < 1e-12))
    columns, rows = (np.diff(line[:2])[0] for line in mesh.lines[:2])

    def traction(v, w):
        here = pressure[(w.x[1] // rows).astype(int), (w.x[0] // columns).astype(int)]
        return here * (shear * v[0] - v[2])

    load = np.concatenate([LinearForm(traction).assemble(top), np.zeros(inner.N)])
    table = basis.get_dofs(lambda x: np.abs(x[2] + mesh.lines[2][-1]) < 1e-12).all()
    found = _solve(*condense(whole, load, D=table))
    moved, squeeze = found[: basis.N], found[basis.N :]
    below = np.array([place[0], place[1], -place[2]])
    above = np.array([place[0], place[1], 0.0])
    sensor, surface = (-_at(points, basis, moved, spot)[2] for spot in (below, above))
    return FrameSolution(
        _reading(points, basis, moved, squeeze, fields["mu"], mesh, place, extent), sensor, surface
    )


def locking(mesh: Hexahedra) -> sp.csc_matrix:
    """Return the stiffness of fully integrated trilinear elements, which lock when nu approaches 1/2."""
    points = MeshHex(mesh.nodes.T.copy(), mesh.corners.T.copy())
    basis = CellBasis(points, ElementVector(ElementHex1()), intorder=2)
    lam, mu = (np.broadcast_to(value[:, None], basis.dx.shape) for value in mesh.lame)

    def energy(u, v, w):
        strain = sym_grad(u)
        return 2 * w.mu * ddot(strain, sym_grad(v)) + w.lam * trace(strain) * div(v)

    return BilinearForm(energy).assemble(basis, mu=mu, lam=lam).tocsc()


def _solve(matrix, right, whole, free) -> np.ndarray:
    """Solve with one step of iterative refinement, because the mixed form is ill-conditioned."""
    factors = splu(matrix.tocsc())
    found = factors.solve(right)
    answer = whole.copy()
    answer[free] = found + factors.solve(right - matrix @ found)
    return answer


def _at(points: MeshHex, basis: CellBasis, moved: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """Return the displacement (3,) of the node at a place."""
    node = np.linalg.norm(points.p - spot[:, None], axis=0).argmin()
    return moved[basis.nodal_dofs[:, node]]


def _reading(points, basis, moved, squeeze, mu, mesh: Hexahedra, place, extent: float) -> float:
    """Integrate -sigma_zz over the footprint in the rows above and below, and interpolate linearly."""
    x, y, z = points.p[:, points.t].mean(axis=1)
    within = (np.abs(x - place[0]) < extent / 2) & (np.abs(y - place[1]) < extent / 2)
    lines = mesh.lines[2]
    row = int(np.searchsorted(lines, place[2] - 1e-9))
    upper, lower = (lines[row - 1] + lines[row]) / 2, (lines[row] + lines[row + 1]) / 2
    s, t = np.meshgrid(_GAUSS, _GAUSS)
    half_way = np.stack([s.ravel(), t.ravel(), np.full(4, 0.5)])
    felt = []
    for middle in (upper, lower):
        elements = np.flatnonzero(within & (np.abs(z + middle) < 1e-9))
        plane = CellBasis(points, basis.elem, quadrature=(half_way, np.full(4, 0.25)), elements=elements)
        push = Functional(lambda w: -(2 * w.mu * w["u"].grad[2][2] + w.q) / w.high)
        shape = plane.dx.shape
        felt.append(
            push.assemble(
                plane, u=plane.interpolate(moved), mu=np.broadcast_to(mu[elements, :1], shape),
                q=np.broadcast_to(squeeze[elements][:, None], shape),
                high=np.full(shape, 2 * abs(lines[row] - middle)),
            )
        )  # fmt: skip
    share = (place[2] - upper) / (lower - upper)
    return float((1 - share) * felt[0] + share * felt[1])
