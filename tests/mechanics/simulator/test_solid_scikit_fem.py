"""scikit-fem alone, in the mixed form, reads single frames as the precomputed operator does."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
import skfem as fem
from scipy.sparse.linalg import splu
from skfem import MeshHex
from skfem.helpers import ddot, div, sym_grad

from skin.body.base import Sheet
from skin.mechanics.simulator._mesh import Hexahedra, build_mesh
from skin.mechanics.simulator.solid import Elastic

LAYERS = [
    {"material": {"name": "muscle", "young": 560e3, "poisson": 0.49}, "thickness": 0.010},
    {"material": {"name": "skin", "young": 170e3, "poisson": 0.499}, "thickness": 0.005},
]
_GAUSS = (np.array([-1, 1]) / np.sqrt(3) + 1) / 2


@pytest.mark.parametrize(("seed", "shear"), [(0, 0.0), (1, 0.5)])
def test_the_operator_agrees_with_scikit_fem_on_single_frames(seed, shear):
    body = Sheet((0.12, 0.12), (8, 8), LAYERS)
    position = np.array([3 * body.cell[0], 4 * body.cell[1], 0.005])
    mesh, extent = build_mesh(body, 2, {}), 2 * body.cell[0]
    down, above = np.array([[0.0, 0, 1]]), position * [1, 1, 0]
    # Stress in the middles of the 2 x 2 elements under the footprint, between the rows next to the place.
    weights = np.zeros((4, 8, 8))
    weights[1:3, 3:5, 2:4] = -np.prod(body.cell) * np.array([2 / 3, 1 / 3])[:, None, None]
    stress = mesh.mean_stress(sp.csr_matrix(weights.reshape(1, -1)), down)
    rows = sp.vstack([stress, mesh.motion(position[None], down), mesh.motion(above[None], down)])
    adjoint = Elastic(mesh).solve(rows.T.toarray())
    along, inwards = ((mesh.loads(axis).T @ adjoint).T for axis in (0, 2))
    pressure = 1e4 * np.random.default_rng(seed).random(body.shape)
    theirs = solve_frame(mesh, pressure, shear, position, extent)
    ours = (inwards + shear * along) @ pressure.ravel()
    assert ours == pytest.approx([theirs.reading, theirs.sensor, theirs.surface], rel=1e-8)


@dataclass(frozen=True)
class FrameSolution:
    reading: float  # normal force on a rectangle of whole cells, N
    sensor: float  # displacement into the skin of the node in its middle, m
    surface: float  # the same of the node above, m


def solve_frame(
    mesh: Hexahedra, pressure: np.ndarray, shear: float, position: np.ndarray, extent: float
) -> FrameSolution:
    """Solve a flat skin under a pressure (H, W), Pa, in the mixed form: one pressure unknown per element.

    ``shear`` is the traction along x by the pressure; ``position`` (3,), m, is a node between two rows of
    elements, and ``extent`` the side of the sensor's footprint, m, of whole cells about the node.
    """
    points = MeshHex(mesh.nodes.T.copy(), mesh.corners.T.copy())
    basis = fem.CellBasis(points, fem.ElementVector(fem.ElementHex1()), intorder=2)
    inner = basis.with_element(fem.ElementHex0())
    columns, rows, _ = mesh.counts
    lam, mu = (constant.repeat(columns * rows) for constant in mesh.lame)
    shape = basis.dx.shape
    fields = {"mu": np.broadcast_to(mu[:, None], shape), "lam": np.broadcast_to(lam[:, None], shape)}
    stiff = fem.BilinearForm(lambda u, v, w: 2 * w.mu * ddot(sym_grad(u), sym_grad(v)))
    elastic = stiff.assemble(basis, **fields)
    grown = fem.BilinearForm(lambda u, q, w: div(u) * q).assemble(basis, inner)
    squeezed = fem.BilinearForm(lambda p, q, w: p * q / w.lam).assemble(inner, **fields)
    whole = sp.block_array([[elastic, grown.T], [grown, -squeezed]]).tocsr()

    top = fem.FacetBasis(points, basis.elem, facets=points.facets_satisfying(lambda x: np.abs(x[2]) < 1e-12))
    columns, rows = (np.diff(line[:2])[0] for line in mesh.lines[:2])

    def traction(v, w):
        push = pressure[(w.x[1] // rows).astype(int), (w.x[0] // columns).astype(int)]
        return push * (shear * v[0] - v[2])

    load = np.concatenate([fem.LinearForm(traction).assemble(top), np.zeros(inner.N)])
    table = basis.get_dofs(lambda x: np.abs(x[2] + mesh.lines[2][-1]) < 1e-12).all()
    solution = _solve(*fem.condense(whole, load, D=table))
    moved, squeeze = solution[: basis.N], solution[basis.N :]
    below = np.array([position[0], position[1], -position[2]])
    above = np.array([position[0], position[1], 0.0])
    sensor, surface = (-_at(points, basis, moved, spot)[2] for spot in (below, above))
    reading = _reading(points, basis, moved, squeeze, fields["mu"], mesh, position, extent)
    return FrameSolution(reading, sensor, surface)


def _solve(matrix, right, whole, free) -> np.ndarray:
    """Solve with one step of iterative refinement, because the mixed form is ill-conditioned."""
    factors = splu(matrix.tocsc())
    first = factors.solve(right)
    answer = whole.copy()
    answer[free] = first + factors.solve(right - matrix @ first)
    return answer


def _at(points: MeshHex, basis: fem.CellBasis, moved: np.ndarray, spot: np.ndarray) -> np.ndarray:
    node = np.linalg.norm(points.p - spot[:, None], axis=0).argmin()
    return moved[basis.nodal_dofs[:, node]]


def _reading(points, basis, moved, squeeze, mu, mesh: Hexahedra, position, extent: float) -> float:
    """Integrate -sigma_zz over the footprint in the rows above and below, and interpolate linearly."""
    x, y, z = points.p[:, points.t].mean(axis=1)
    within = (np.abs(x - position[0]) < extent / 2) & (np.abs(y - position[1]) < extent / 2)
    lines = mesh.lines[2]
    row = int(np.searchsorted(lines, position[2] - 1e-9))
    upper, lower = (lines[row - 1] + lines[row]) / 2, (lines[row] + lines[row + 1]) / 2
    s, t = np.meshgrid(_GAUSS, _GAUSS)
    half_way = np.stack([s.ravel(), t.ravel(), np.full(4, 0.5)])
    felt = []
    for middle in (upper, lower):
        elements = np.flatnonzero(within & (np.abs(z + middle) < 1e-9))
        plane = fem.CellBasis(points, basis.elem, quadrature=(half_way, np.full(4, 0.25)), elements=elements)
        push = fem.Functional(lambda w: -(2 * w.mu * w["u"].grad[2][2] + w.q) / w.high)
        shape = plane.dx.shape
        felt.append(
            push.assemble(
                plane, u=plane.interpolate(moved), mu=np.broadcast_to(mu[elements, :1], shape),
                q=np.broadcast_to(squeeze[elements][:, None], shape),
                high=np.full(shape, 2 * abs(lines[row] - middle)),
            )
        )  # fmt: skip
    fraction = (position[2] - upper) / (lower - upper)
    return float((1 - fraction) * felt[0] + fraction * felt[1])
