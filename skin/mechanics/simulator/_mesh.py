"""The elements of a body: as few rows as readings under a fingertip need."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product

import numpy as np
import scipy.sparse as sp

from skin.body.base import AbstractBody, Sensors
from skin.body.material import MATERIALS
from skin.errors import InputError

# Structured hexahedra of a layered body: stiffness, surface loads, and rows that read stress and motion.
# Three-dimensional linear elasticity with trilinear elements whose dilatation is its mean over the element
# (Nagtegaal, Parks and Rice, 1974), so that a nearly incompressible silicone does not lock.


# (8, 3): an element's nodes, in the order of scikit-fem, which the tests compare with.
_CORNERS = np.array([[1, 1, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])
# (8, 3): the points at which an element is integrated, in its local coordinates, each of weight 1/8.
_POINTS = (1 + (2 * _CORNERS - 1) / np.sqrt(3)) / 2


@dataclass(frozen=True)
class Hexahedra:
    """A block of hexahedra over lines of a chart, its lower face held.

    Unknowns are the nodes' motions along the axes of space, three to a node; nodes lie in planes from the
    surface down, each row by row as cells do.

    Args:
        lines: where the elements' faces are along the chart's x, y and depth, m, each ascending from 0.
        young: (K,), Pa, of each row of elements from the surface down.
        poisson: (K,), of each row.
        position: chart points (..., 3) to space (..., 3), m.
        frame: chart points (..., 3) to unit vectors (..., 3, 3) along x, along y and into the body.
    """

    lines: tuple[np.ndarray, np.ndarray, np.ndarray]
    young: np.ndarray
    poisson: np.ndarray
    position: Callable[[np.ndarray], np.ndarray]
    frame: Callable[[np.ndarray], np.ndarray]

    @property
    def counts(self) -> tuple[int, int, int]:
        """Elements along x, along y and down."""
        x, y, z = self.lines
        return len(x) - 1, len(y) - 1, len(z) - 1

    @cached_property
    def corners(self) -> np.ndarray:
        """The nodes of each element, (E, 8), row by row of elements from the surface down."""
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
        return self.position(np.stack([i, j, k], axis=-1).reshape(-1, 3))

    @cached_property
    def held(self) -> np.ndarray:
        """Which unknowns the table holds, (3 N,), bool."""
        columns, rows, deep = self.counts
        plane = 3 * (columns + 1) * (rows + 1)
        return np.arange((deep + 1) * plane) >= deep * plane

    @cached_property
    def lame(self) -> tuple[np.ndarray, np.ndarray]:
        """Lame's constants lambda and mu of each row of elements, (K,) each, Pa."""
        mu = self.young / (2 * (1 + self.poisson))
        return 2 * mu * self.poisson / (1 - 2 * self.poisson), mu

    def stiffness(self) -> sp.csr_array:
        """Return K (3 N, 3 N), N/m, before anything is held."""
        columns, rows, layers = self.counts
        # Of each node, what it feels of the 27 nodes around it.
        blocks = np.zeros((layers + 1, rows + 1, columns + 1, 3, 3, 3, 3, 3))
        for layer in range(layers):
            unit = self._element_stiffness(layer)
            for (a, (i, j, k)), (b, second) in product(enumerate(_CORNERS), repeat=2):
                there = blocks[layer + k, j : j + rows, i : i + columns, *(1 + second - (i, j, k))[::-1]]
                there += unit[..., a, :, b, :]
        z, y, x = (np.arange(count + 1)[:, None] + [-1, 0, 1] for count in (layers, rows, columns))
        near = np.einsum("ai,bj,ck->abcijk", *((at >= 0) & (at < len(at)) for at in (z, y, x)))
        plane = z[:, None, None, :, None, None] * (rows + 1) + y[:, None, None, :, None]
        node = plane * (columns + 1) + x[:, None, None, :]
        ends = np.concatenate([[0], near.sum(axis=(3, 4, 5)).ravel().cumsum()])
        return sp.bsr_array((blocks[near], node[near], ends), shape=(3 * len(self.nodes),) * 2).tocsr()

    def _element_stiffness(self, layer: int) -> np.ndarray:
        """Return the stiffness of a row's elements, (rows, columns, 8, 3, 8, 3), N/m.

        Elements that are copies of each other along x or y, as in a sheet, stand for each other: 1 instead of
        rows or columns.
        """
        columns, rows, _ = self.counts
        element = np.arange(layer * rows * columns, (layer + 1) * rows * columns).reshape(rows, columns)
        for axis in (0, 1):
            sides = np.diff(self.nodes[self.corners[element]], axis=2)
            first = sides.take([0], axis)
            if np.allclose(sides, first, rtol=0, atol=1e-12 * np.abs(first).max()):
                element = element.take([0], axis)
        gradient, weight = self._integration(element.ravel())
        slopes = gradient.reshape(element.size, 8, 24)
        products = (slopes * weight[:, :, None]).transpose(0, 2, 1) @ slopes
        products = products.reshape(element.size, 8, 3, 8, 3)
        growth = np.einsum("eg,egx->ex", weight, slopes)
        lam, mu = (constant[layer] for constant in self.lame)
        # 2 mu sym_grad(u) : sym_grad(v), and the volume's growth as its mean.
        unit = mu * (
            np.einsum("eakbk,ij->eaibj", products, np.eye(3)) + products.transpose(0, 1, 4, 3, 2)
        ) + np.einsum("e,ex,ey->exy", lam / weight.sum(axis=1), growth, growth).reshape(products.shape)
        return unit.reshape(*element.shape, 8, 3, 8, 3)

    def _integration(self, element: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients of the shape functions of elements (P,) at 8 points, and the points' volumes.

        Returns:
            (P, 8, 8, 3), points before corners, 1/m; (P, 8), m^3.
        """
        corners = self.nodes[self.corners[element]]
        inner = _slopes(_POINTS)
        jacobian = np.einsum("gai,paj->pgij", inner, corners)
        gradient = np.linalg.inv(jacobian) @ inner.transpose(0, 2, 1)
        return gradient.swapaxes(2, 3), np.abs(np.linalg.det(jacobian)) / 8

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

    def pushes(self, plane: int, axis: int) -> sp.csr_array:
        """Return rows (nodes of a plane, 3 N) that read the force that pushes each node along an axis, N.

        By the row of elements above the plane; on the surface, by the load.
        """
        layer, (x, y, z) = max(plane - 1, 0), self.lines
        row = replace(
            self,
            lines=(x, y, z[layer : layer + 2]),
            young=self.young[layer : layer + 1],
            poisson=self.poisson[layer : layer + 1],
        )
        count = len(x) * len(y)
        forces = -row.stiffness()[3 * count :] if plane else row.stiffness()[: 3 * count]
        positions = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z[plane])], axis=-1).reshape(
            -1, 3
        )
        ends = 3 * np.arange(count + 1)
        felt = sp.csr_array((self.frame(positions)[:, axis].ravel(), np.arange(3 * count), ends)) @ forces
        return sp.csr_array(
            (felt.data, felt.indices + 3 * layer * count, felt.indptr), shape=(count, 3 * len(self.nodes))
        )

    def plane_areas(self, plane: int) -> sp.csc_array:
        """Return integrals of two nodes' shape functions over a plane of nodes, (n, n), m^2."""
        columns, rows, _ = self.counts
        node = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
        corner = np.stack([node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]], axis=-1)
        corner = corner.reshape(-1, 4)
        a, b, c, d = self.nodes[corner + plane * node.size].swapaxes(0, 1)
        area = np.linalg.norm(np.cross(d - a, c - b), axis=1) / 2
        values = area[:, None, None] * np.kron([[2, 1], [1, 2]], [[2, 1], [1, 2]]) / 36
        first = np.broadcast_to(corner[:, :, None], values.shape)
        return sp.csc_array((values.ravel(), (first.ravel(), first.swapaxes(1, 2).ravel())))

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
        for axis, (line, maximum) in enumerate(zip(self.lines, (4, 4, 2), strict=True)):
            middles = (line[1:] + line[:-1]) / 2
            at = points[:, axis] if axis < 2 else np.clip(points[:, axis], middles[0], middles[-1])
            stencils.append(lagrange(middles, at, min(maximum, len(middles))))
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
        inside, weight = self._integration(element)
        gradient = self._gradients(element, local)
        along_n, along_m = (gradient @ vector[:, :, None] for vector in (n, m))
        columns, rows, _ = self.counts
        lam, mu = (constant[element // (rows * columns)] for constant in self.lame)
        shearing = mu[:, None, None] * (along_n * m[:, None] + along_m * n[:, None])
        grown = np.einsum("pg,pgai->pai", weight, inside) / weight.sum(axis=1)[:, None, None]
        return self._rows(element, shearing + (lam * (n * m).sum(axis=1))[:, None, None] * grown)

    def _gradients(self, element: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return the gradients of the shape functions in space, (P, 8, 3), 1/m."""
        inner = _slopes(local)
        jacobian = np.einsum("pai,paj->pij", inner, self.nodes[self.corners[element]])
        return np.einsum("pij,paj->pai", np.linalg.inv(jacobian), inner)

    def _locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the elements (P,) that hold points, and the local coordinates there, (P, 3), 0 to 1."""
        position, local = [], np.empty(points.shape)
        for axis, (line, count) in enumerate(zip(self.lines, self.counts, strict=True)):
            at = np.clip(np.searchsorted(line, points[:, axis], side="right") - 1, 0, count - 1)
            local[:, axis] = np.clip((points[:, axis] - line[at]) / (line[at + 1] - line[at]), 0, 1)
            position.append(at)
        columns, rows, _ = self.counts
        return (position[2] * rows + position[1]) * columns + position[0], local

    def _rows(self, element: np.ndarray, values: np.ndarray) -> sp.csr_matrix:
        """Return rows (P, 3 N) with values (P, 8, 3) at the elements' corners."""
        unknown = 3 * self.corners[element][:, :, None] + np.arange(3)
        row = np.broadcast_to(np.arange(len(element))[:, None, None], unknown.shape)
        shape = (len(element), 3 * len(self.nodes))
        return sp.csr_matrix((values.ravel(), (row.ravel(), unknown.ravel())), shape=shape)


def lagrange(knots: np.ndarray, positions: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``count`` knots nearest to places (P,), (P, count), and their weights in a polynomial."""
    first = np.clip(np.searchsorted(knots, positions) - count // 2, 0, len(knots) - count)
    near = first[:, None] + np.arange(count)
    weights = np.ones(near.shape)
    for number, other in np.argwhere(~np.eye(count, dtype=bool)):
        apart = knots[near[:, number]] - knots[near[:, other]]
        weights[:, number] *= (positions - knots[near[:, other]]) / apart
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


# The elements of a body.


POISSON = {"Dragon Skin 10 Medium": 0.49}
"""In place of the measured 0.54 (report, table 2), which is impossible: an isotropic solid needs nu < 0.5."""

_FINEST = 2.5e-3  # m; under discs of 5 mm radius and more, rows for narrower elements improve nothing
_SLIVER = 0.4  # of an element's width: a piece this thin is one row
_SAME = 1e-7  # m, between depths that are the same

Pieces = list[tuple[float, tuple[int, int]]]
"""Parts of a layer from its top down: thickness, m, and rows of elements in the fine and the coarse mesh."""


def build_meshes(
    body: AbstractBody,
    sensors: Sensors,
    divisions: int | None,
    poisson: Mapping[str, float],
    refinement: int,
) -> list[tuple[float, Hexahedra, int]]:
    """Return meshes, their weights in a solution, and the elements along a side of a cell in each.

    Errors fall with the square of the elements' size. A mesh with half the rows and half the elements a side
    therefore gives most of the error of the fine one: (4 fine - coarse) / 3. An odd ``refinement`` cannot be
    halved, and leaves the fine mesh alone.

    Against endless layers (``make physics``), with cells of 5 mm and two elements a cell: at most 1.5 % of
    the reading over the sensor, there and up to 16 mm beside, under discs of 5 mm radius and more, with
    layers from 3 to 40 mm, sensors from 5 mm below the surface to 0.5 mm above the base, moduli in ratios up
    to 20 and nu from .45 to .499. Less deep sensors err by up to 5 % (2 mm), because the moments of cells do
    not know the edge of a disc; under a disc of 2.5 mm by 15 % (2 mm), 5 % (5 mm), 2 % (6 mm and more).

    Args:
        body: sheet or arm.
        sensors: whose depths get planes of nodes.
        divisions: rows of elements in each layer of the fine mesh; None: as few as the above needs.
        poisson: name of a material -> nu in place of its own.
        refinement: elements along each side of a cell in the fine mesh.

    Raises:
        InputError: as of :class:`skin.mechanics.simulator.solid.Solid`.
    """
    _check_layers(body)
    width = max(_FINEST, float(np.sqrt(np.prod(body.cell))) / refinement)
    layers = list(_pieces(body, sensors, width))
    if divisions is not None:
        _warn_of_rows(body, sensors, divisions, sum(rows[0] for layer in layers for _, rows in layer))
        coarse = divisions if divisions % 2 else divisions // 2
        layers = [[(sum(height for height, _ in layer), (divisions, coarse))] for layer in layers]
    meshes = []
    parts = ((1.0, refinement),) if refinement % 2 else ((4 / 3, refinement), (-1 / 3, refinement // 2))
    for part, (weight, elements) in enumerate(parts):
        heights = [
            np.concatenate([np.full(rows[part], height / rows[part]) for height, rows in layer])
            for layer in layers
        ]
        meshes.append((weight, build_mesh(body, heights, poisson, elements), elements))
    return meshes


def build_mesh(
    body: AbstractBody,
    divisions: int | Sequence[np.ndarray],
    poisson: Mapping[str, float],
    refinement: int = 1,
) -> Hexahedra:
    """Return a body's elements: its cells cut in equal parts, and rows of elements in each layer.

    Args:
        body: sheet or arm.
        divisions: rows of each layer, or their heights in each layer from the surface down, m.
        poisson: name of a material -> nu in place of its own.
        refinement: elements along each side of a cell.

    Raises:
        InputError: as of :class:`skin.mechanics.simulator.solid.Solid`.
    """
    ratios = _ratios(body, poisson)
    rows, young, ratio = [], [], []
    for above, number in enumerate(reversed(range(len(body.layers)))):
        layer = body.layers[number]
        rows.append(
            np.full(divisions, layer.thickness / divisions)
            if isinstance(divisions, int)
            else divisions[above]
        )
        young += [layer.material.young] * len(rows[-1])
        ratio += [ratios[number]] * len(rows[-1])
    x, y = (np.linspace(0, body.size[axis], refinement * body.cells[axis] + 1) for axis in (0, 1))
    depths = np.concatenate([[0.0], *rows]).cumsum()
    return Hexahedra((x, y, depths), np.array(young), np.array(ratio), body.locate, body.frame)


def _pieces(body: AbstractBody, sensors: Sensors, width: float) -> Iterator[Pieces]:
    """Yield the pieces of each layer from the surface down, cut at the depths of sensors.

    Above the deepest sensor, and where a layer bends over a softer one, the coarse mesh has a row more than
    one for three elements' widths, and three at least; a piece thinner than two needs fewer. Below, a row is
    up to four high.

    Args:
        body: with the layers.
        sensors: a tilted one needs all layers.
        width: of the elements, m.
    """
    flat = np.unique(sensors.positions[~sensors.tilted, 2].round(9))
    planes = flat if len(flat) <= 4 else flat[:0]  # for more depths, the planes are even
    # Close to the base of a body thicker than this, interpolation errs by less than 1 %.
    if body.thickness > 7.5 * width:
        planes = planes[planes < body.thickness - _SLIVER * width - _SAME]
    deepest = body.thickness if sensors.tilted.any() else flat.max(initial=0)
    top, moduli = 0.0, [layer.material.young for layer in body.layers]
    for number in reversed(range(len(body.layers))):
        bottom, pieces = body.thickness - sum(layer.thickness for layer in body.layers[:number]), []
        cuts = planes[(planes > top + _SAME) & (planes < bottom - _SAME)]
        bends = any(
            moduli[upper] > 1.5 * moduli[upper - 1]
            for upper in (number, number + 1)
            if 0 < upper < len(moduli)
        )
        for start, end in pairwise([top, *cuts, bottom]):
            height = (end - start) / width
            if start < deepest - _SAME or bends:
                rows = max(3, math.ceil(1 + height / 3 - _SAME))
            else:
                rows = max(1 + (len(cuts) > 0), math.ceil(height / 4 - _SAME))
            if height <= 2 + _SAME:
                rows = 1 + bends
            kept = height <= 1 + _SAME  # of a thin piece both meshes have the same rows
            if kept:
                rows = 1 if height <= _SLIVER + _SAME else 2
            pieces.append((end - start, (rows if kept else 2 * rows, rows)))
        yield pieces
        top = bottom


def _check_layers(body: AbstractBody) -> None:
    thinnest, widest = 1e-3, min(body.size)  # elements of a usual width are flat in thinner layers
    for number, layer in enumerate(body.layers, start=1):
        if not thinnest <= layer.thickness <= widest:
            raise InputError(
                f"layer {number} of the body is {layer.thickness:g} m thick; simulator=solid takes layers "
                f"from {thinnest:g} m to the width of the skin, {widest:g} m: change its thickness, or take "
                "simulator=fem"
            )


def _warn_of_rows(body: AbstractBody, sensors: Sensors, divisions: int, needed: int) -> None:
    """Warn where a given number of rows is too small for the layers above the deepest sensor."""
    tops = np.cumsum([0.0, *(layer.thickness for layer in reversed(body.layers))])
    deepest = body.thickness if sensors.tilted.any() else sensors.positions[:, 2].max()
    tallest = max(np.diff(tops)[tops[:-1] <= deepest - _SAME], default=0.0) / divisions
    # Measured on layers of 5 to 30 mm with 2 to 10 rows, within a factor of 1.5.
    error = min(1.0, (tallest / 12e-3) ** 3)
    if error > 0.02:
        warnings.warn(
            f"simulator.divisions={divisions} makes rows of elements {1e3 * tallest:.3g} mm high above the "
            f"sensors: readings under a fingertip may err by {100 * error:.0f} %; simulator.divisions=null "
            f"takes {needed} rows and errs by 2 %",
            UserWarning,
            stacklevel=4,
        )


def _ratios(body: AbstractBody, poisson: Mapping[str, float]) -> list[float]:
    names = {layer.material.name for layer in body.layers}
    if unknown := sorted(set(poisson) - names - {material.name for material in MATERIALS}):
        raise InputError(
            f"poisson (simulator.poisson) names {unknown[0]}, but the body is made of "
            f"{', '.join(sorted(names))}"
        )
    ratios = []
    for layer in body.layers:
        measured = layer.material.poisson
        possible = measured if measured < 0.5 else POISSON.get(layer.material.name, measured)
        ratios.append(float(poisson.get(layer.material.name, possible)))
    for layer, ratio in zip(body.layers, ratios, strict=True):
        if not -1 < ratio < 0.5:
            name = layer.material.name
            raise InputError(
                f"{name} has Poisson's ratio {ratio:g}, but no isotropic solid is beyond -1 < nu < 0.5: "
                f"in Python give poisson={{{name!r}: 0.49}} to Solid or use PlatesAndBeams; "
                f"on the command line give 'simulator.poisson={{{name}: 0.49}}' or simulator=fem"
            )
    return ratios
