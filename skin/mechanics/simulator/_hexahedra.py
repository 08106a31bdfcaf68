"""Structured hexahedra of a layered body: stiffness, surface loads, and rows that read stress and motion.

Three-dimensional linear elasticity with trilinear elements whose dilatation is its mean over the element
(Nagtegaal, Parks and Rice, 1974), so that a nearly incompressible silicone does not lock. scikit-fem
assembles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from skfem import BilinearForm, CellBasis, ElementHex0, ElementHex1, ElementVector, MeshHex
from skfem.helpers import ddot, div, grad, transpose
from skfem.refdom import RefHex

_CORNERS = RefHex.p.T.astype(int)  # (8, 3): scikit-fem's order of an element's nodes


@BilinearForm
def _shearing(u, v, w):
    # 2 mu sym_grad(u) : sym_grad(v), but the symmetric parts take most of the time of an assembly.
    return w.mu * (ddot(grad(u), grad(v)) + ddot(grad(u), transpose(grad(v))))


@BilinearForm
def _growth(u, q, _):
    return div(u) * q


@dataclass(frozen=True)
class Hexahedra:
    """A block of hexahedra over lines of a chart, its lower face held.

    Unknowns are the nodes' motions along the axes of space, three to a node; nodes lie in planes from the
    surface down, each row by row as cells do.

    Args:
        lines: where the elements' faces are along the chart's x, y and depth, m, each ascending from 0.
        young: (K, H, W), Pa, of each element, K rows of elements from the surface down.
        poisson: (K,), of each row.
        place: chart points (..., 3) to space (..., 3), m.
        frame: chart points (..., 3) to unit vectors (..., 3, 3) along x, along y and into the body.
    """

    lines: tuple[np.ndarray, np.ndarray, np.ndarray]
    young: np.ndarray
    poisson: np.ndarray
    place: Callable[[np.ndarray], np.ndarray]
    frame: Callable[[np.ndarray], np.ndarray]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Elements along x, along y and down."""
        x, y, z = self.lines
        return len(x) - 1, len(y) - 1, len(z) - 1

    @cached_property
    def corners(self) -> np.ndarray:
        """The nodes of each element, (E, 8), elements in the order of ``young``."""
        columns, rows, deep = self.counts
        z, y, x = np.meshgrid(*(np.arange(n) for n in (deep, rows, columns)), indexing="ij")
        first = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        i, j, k = (first[:, None] + _CORNERS).transpose(2, 0, 1)
        return (k * (rows + 1) + j) * (columns + 1) + i

    @cached_property
    def nodes(self) -> np.ndarray:
        """Where the nodes are in space, (N, 3), m."""
        x, y, z = self.lines
        k, j, i = np.meshgrid(z, y, x, indexing="ij")
        return self.place(np.stack([i, j, k], axis=-1).reshape(-1, 3))

    @cached_property
    def held(self) -> np.ndarray:
        """Which unknowns the table holds, (3 N,), bool."""
        columns, rows, deep = self.counts
        plane = 3 * (columns + 1) * (rows + 1)
        return np.arange((deep + 1) * plane) >= deep * plane

    @cached_property
    def lame(self) -> tuple[np.ndarray, np.ndarray]:
        """Lame's constants lambda and mu of each element, (E,) each, Pa."""
        ratio = self.poisson[:, None, None]
        mu = self.young / (2 * (1 + ratio))
        return (2 * mu * ratio / (1 - 2 * ratio)).ravel(), mu.ravel()

    @cached_property
    def _basis(self) -> CellBasis:
        mesh = MeshHex(self.nodes.T.copy(), self.corners.T.copy(), sort_t=False, validate=False)
        return CellBasis(mesh, ElementVector(ElementHex1()), intorder=2)

    @cached_property
    def _growth(self) -> tuple[sp.csr_matrix, np.ndarray]:
        """How much each element's volume grows as nodes move, (E, 3 N), m^2, and the volumes (E,), m^3."""
        rows = _growth.assemble(self._basis, self._basis.with_element(ElementHex0()))
        return rows.tocsr(), self._basis.dx.sum(axis=1)

    def stiffness(self) -> sp.csc_matrix:
        """Return K (3 N, 3 N), N/m, before anything is held."""
        lam, mu = self.lame
        growth, volume = self._growth
        shearing = _shearing.assemble(self._basis, mu=np.repeat(mu[:, None], self._basis.X.shape[-1], axis=1))
        return (shearing + growth.T @ sp.diags_array(lam / volume) @ growth).tocsc()

    def loads(self, axis: int) -> sp.csc_matrix:
        """Return the nodal forces (3 N, cells), N, of 1 Pa on each surface cell, along x, along y or inwards.

        A cell's area is that of the chart; a quarter of its force goes to each of its corners.
        """
        x, y, _ = self.lines
        columns, rows, _ = self.counts
        middle = np.stack(np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2), axis=-1).reshape(-1, 2)
        direction = self.frame(np.column_stack([middle, np.zeros(len(middle))]))[:, axis]
        force = np.outer(np.diff(y), np.diff(x)).reshape(-1, 1) / 4 * direction
        top = self.corners[: rows * columns][:, _CORNERS[:, 2] == 0]
        unknown = 3 * top[:, :, None] + np.arange(3)
        values = np.broadcast_to(force[:, None], unknown.shape)
        cell = np.broadcast_to(np.arange(len(force))[:, None, None], unknown.shape)
        shape = (3 * len(self.nodes), len(force))
        return sp.csc_matrix((values.ravel(), (unknown.ravel(), cell.ravel())), shape=shape)

    def motion(self, points: np.ndarray, directions: np.ndarray) -> sp.csr_matrix:
        """Return rows (P, 3 N) that read how far points move along directions.

        Args:
            points: (P, 3), chart, m.
            directions: (P, 3), in the chart's frame.
        """
        element, local = self._locate(points)
        along = np.einsum("pi,pij->pj", directions, self.frame(points))
        return self._rows(element, _shapes(local)[:, :, None] * along[:, None])

    def stress(
        self, points: np.ndarray, normals: np.ndarray, others: np.ndarray | None = None
    ) -> sp.csr_matrix:
        """Return rows (P, 3 N) that read n . sigma . m at points, Pa.

        An element knows its stress best in its middle, so a point takes what :meth:`between` makes of them.

        Args:
            points: (P, 3), chart, m.
            normals: n, (P, 3), in the chart's frame.
            others: m; None: n.
        """
        return self.mean_stress(self.between(points), normals, others)

    def between(self, points: np.ndarray) -> sp.csr_matrix:
        """Return weights (P, E) that interpolate what is known in the middles of elements.

        Along x and y a point takes the cubic through the four nearest middles, in depth the line between the
        nearest two; in depth it does not extrapolate.
        """
        stencils = []
        for axis, (line, most) in enumerate(zip(self.lines, (4, 4, 2), strict=True)):
            middles = (line[1:] + line[:-1]) / 2
            at = points[:, axis] if axis < 2 else np.clip(points[:, axis], middles[0], middles[-1])
            stencils.append(_lagrange(middles, at, min(most, len(middles))))
        (x, u), (y, v), (z, w) = stencils
        columns, rows, _ = self.counts
        element = (z[:, :, None, None] * rows + y[:, None, :, None]) * columns + x[:, None, None]
        weight = w[:, :, None, None] * v[:, None, :, None] * u[:, None, None]
        point = np.broadcast_to(np.arange(len(points))[:, None, None, None], element.shape)
        shape = (len(points), len(self.corners))
        return sp.csr_matrix((weight.ravel(), (point.ravel(), element.ravel())), shape=shape)

    def mean_stress(
        self, weights: sp.csr_matrix, normals: np.ndarray, others: np.ndarray | None = None
    ) -> sp.csr_matrix:
        """Return rows (R, 3 N) that read sums of n . sigma . m in the middles of elements, Pa.

        Args:
            weights: (R, E), of each element.
            normals: n, (R, 3), in the chart's frame.
            others: m; None: n.
        """
        sums = weights.tocoo()
        middles = [(line[1:] + line[:-1]) / 2 for line in self.lines]
        depth, row, column = np.unravel_index(sums.col, self.counts[::-1])
        frame = self.frame(np.column_stack([middles[0][column], middles[1][row], middles[2][depth]]))
        n, m = (
            np.einsum("pi,pij->pj", sides[sums.row], frame)
            for sides in (normals, normals if others is None else others)
        )
        tractions = self._traction(sums.col, np.full((sums.nnz, 3), 0.5), n, m)
        total = sp.csr_matrix((sums.data, (sums.row, np.arange(sums.nnz))), shape=(sums.shape[0], sums.nnz))
        return (total @ tractions).tocsr()

    def strain(self, points: np.ndarray) -> list[sp.csr_matrix]:
        """Return rows (P, 3 N) for each of the strains xx, yy, zz, yz, xz, xy at points, along axes of space.

        Args:
            points: (P, 3), chart, m.
        """
        element, local = self._locate(points)
        gradient = self._gradients(element, local)
        rows = []
        for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
            values = np.zeros_like(gradient)
            values[:, :, i] += gradient[:, :, j] / 2
            values[:, :, j] += gradient[:, :, i] / 2
            rows.append(self._rows(element, values))
        return rows

    def _traction(
        self, element: np.ndarray, local: np.ndarray, n: np.ndarray, m: np.ndarray
    ) -> sp.csr_matrix:
        """Return rows (P, 3 N) that read n . sigma . m at local coordinates of elements, Pa/m."""
        growth, volume = self._growth
        gradient = self._gradients(element, local)
        along_n, along_m = (gradient @ vector[:, :, None] for vector in (n, m))
        lam, mu = (constant[element] for constant in self.lame)
        shearing = mu[:, None, None] * (along_n * m[:, None] + along_m * n[:, None])
        grown = sp.diags_array(lam * (n * m).sum(axis=1) / volume[element]) @ growth[element]
        return self._rows(element, shearing) + grown

    def _gradients(self, element: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the gradients of the shape functions in space, (P, 8, 3), 1/m."""
        inner = _slopes(local)
        jacobian = np.einsum("pai,paj->pij", inner, self.nodes[self.corners[element]])
        return np.einsum("pij,paj->pai", np.linalg.inv(jacobian), inner)

    def _locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the elements (P,) that hold points, and the local coordinates there, (P, 3), 0 to 1."""
        place, local = [], np.empty(points.shape)
        for axis, (line, count) in enumerate(zip(self.lines, self.counts, strict=True)):
            at = np.clip(np.searchsorted(line, points[:, axis], side="right") - 1, 0, count - 1)
            local[:, axis] = np.clip((points[:, axis] - line[at]) / (line[at + 1] - line[at]), 0, 1)
            place.append(at)
        columns, rows, _ = self.counts
        return (place[2] * rows + place[1]) * columns + place[0], local

    def _rows(self, element: np.ndarray, values: np.ndarray) -> sp.csr_matrix:
        """Return rows (P, 3 N) with values (P, 8, 3) at the elements' corners."""
        unknown = 3 * self.corners[element][:, :, None] + np.arange(3)
        row = np.broadcast_to(np.arange(len(element))[:, None, None], unknown.shape)
        shape = (len(element), 3 * len(self.nodes))
        return sp.csr_matrix((values.ravel(), (row.ravel(), unknown.ravel())), shape=shape)


def _lagrange(knots: np.ndarray, places: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``count`` knots nearest to places (P,), (P, count), and their weights in a polynomial."""
    first = np.clip(np.searchsorted(knots, places) - count // 2, 0, len(knots) - count)
    near = first[:, None] + np.arange(count)
    weights = np.ones(near.shape)
    for number, other in np.argwhere(~np.eye(count, dtype=bool)):
        apart = knots[near[:, number]] - knots[near[:, other]]
        weights[:, number] *= (places - knots[near[:, other]]) / apart
    return near, weights


def _shapes(local: np.ndarray) -> np.ndarray:
    """Return the trilinear shape functions, (P, 8)."""
    return np.where(_CORNERS, local[:, None], 1 - local[:, None]).prod(axis=2)


def _slopes(local: np.ndarray) -> np.ndarray:
    """Return their derivatives by the local coordinates, (P, 8, 3)."""
    factors = np.where(_CORNERS, local[:, None], 1 - local[:, None])
    signs = np.where(_CORNERS, 1.0, -1.0)
    others = np.stack([factors[..., [1, 2]], factors[..., [0, 2]], factors[..., [0, 1]]], axis=2).prod(axis=3)
    return signs * others
