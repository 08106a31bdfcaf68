"""Three-dimensional elasticity of a layered body, as one linear operator."""

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np
import scipy.sparse as sp
import torch
from pydantic import PositiveInt
from scipy.linalg import cholesky
from scipy.linalg.blas import dsyrk, dtrsm
from threadpoolctl import threadpool_limits
from torch import Tensor

from skin.body.base import AbstractBody, Sensors, require_memory
from skin.core.settings import checked
from skin.mechanics import array_cache
from skin.mechanics.geometry import fit_nodes, reading_rows, strain_rows, warn_of_cut
from skin.mechanics.simulator._mesh import Hexahedra, build_meshes
from skin.mechanics.simulator.base import AbstractSimulator, Response, flatten, largest_strain
from skin.touch.shapes import cell_moments

# Cholesky factors of a grid's stiffness: nested dissection of its plan, with dense fronts.
#
# The grid is thin: its plan has many more nodes along each side than lie above each other. All unknowns
# above a place of the plan are therefore eliminated together. The plan is halved by lines of positions until
# its parts have a few positions a side; a part is eliminated before the lines around it (George, 1973). What
# remains of a part is a dense matrix over the positions next to it, its front (Duff and Reid, 1983).


Part = tuple[slice, slice]  # of the plan: rows, columns

# Fronts are small: with a second thread factors take a tenth less time, and a solve 6 to 16 times as long.
_ONE_THREAD = threadpool_limits.wrap(limits=1, user_api="blas")


class Cholesky:
    """The factors of a symmetric and positive definite matrix over the positions of a plan.

    Args:
        stiffness: (layers * places * 3, the same); unknowns are layer by layer, each row by row, three to a
            place. A place touches its eight neighbours only.
        plan: rows and columns of positions.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """

    @_ONE_THREAD
    def __init__(self, stiffness: sp.csr_array, plan: tuple[int, int]) -> None:
        grid = np.arange(plan[0] * plan[1]).reshape(plan)
        parts = list(_dissected((slice(0, plan[0]), slice(0, plan[1]))))
        order = np.concatenate([grid[own].ravel() for own, _ in parts])
        rank = np.argsort(order).reshape(plan)
        unknowns = np.arange(stiffness.shape[0]).reshape(-1, grid.size, 3).swapaxes(0, 1)
        self._order = unknowns[order].reshape(grid.size, -1)
        self._fronts = list(self._eliminated(stiffness, parts, rank))

    def _eliminated(
        self, stiffness: sp.csr_array, parts: list[tuple[Part, Part]], rank: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield what each step eliminates: its unknowns, those that they touch, and the factors of both.

        Unknowns are numbered as they are eliminated. The factors are a lower triangle (own, own), and what is
        below it, (touched, own).
        """
        deep = self._order.shape[1]
        local = np.full(stiffness.shape[0], -1)  # where an unknown is in the front at hand
        waiting: list[tuple[np.ndarray, np.ndarray]] = []  # what is left of parts, and the ranks of positions
        for own, part in parts:
            grown = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in part)
            ranks = np.concatenate([rank[own].ravel(), np.setdiff1d(rank[grown], rank[part])])
            unknowns, inner = self._order[ranks].ravel(), rank[own].size * deep
            front = np.zeros((len(unknowns), len(unknowns)), order="F")
            local[unknowns] = np.arange(len(unknowns))
            rows = stiffness[unknowns[:inner]]
            into, column = local[rows.indices], np.repeat(np.arange(inner), np.diff(rows.indptr))
            front[into[into >= 0], column[into >= 0]] = rows.data[into >= 0]
            local[unknowns] = -1
            for child, positions in [waiting.pop() for _ in range(2 * (own != part))]:
                _add(front, child, np.searchsorted(ranks, positions), deep)
            diagonal = cholesky(front[:inner, :inner], lower=True, check_finite=False)
            below, rest = (
                np.asfortranarray(front[inner:, part]) for part in (slice(inner), slice(inner, None))
            )
            if len(below):  # nothing is left of the last line
                below = dtrsm(1.0, diagonal, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                waiting.append(
                    (dsyrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1), ranks[inner // deep :])
                )
            first, *_ = numbers = (ranks[:, None] * deep + np.arange(deep)).ravel()
            yield slice(first, first + inner), numbers[inner:], diagonal, below

    @_ONE_THREAD
    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Return the solutions (n, L) of right-hand sides (n, L)."""
        order = self._order.ravel()
        values = np.ascontiguousarray(forces[order])
        for own, border, diagonal, below in self._fronts:
            values[own] = dtrsm(1.0, diagonal, values[own].T, side=1, lower=1, trans_a=1).T
            values[border] -= below @ values[own]
        for own, border, diagonal, below in reversed(self._fronts):
            values[own] -= below.T @ values[border]
            values[own] = dtrsm(1.0, diagonal, values[own].T, side=1, lower=1).T
        solved = np.empty_like(values)
        solved[order] = values
        return solved


def _dissected(part: Part, leaf: int = 4) -> Iterator[tuple[Part, Part]]:
    """Yield what is eliminated at once, a line or a small part, and the part that is then done with.

    A part of ``leaf`` places along its longer side is not halved; 3 to 8 take the same time within 10 %.
    """
    sides = [side.stop - side.start for side in part]
    axis = int(sides[1] >= sides[0])
    if sides[axis] <= leaf:
        yield part, part
        return
    middle = (part[axis].start + part[axis].stop) // 2
    line, *pieces = (
        (part[0], slice(*ends)) if axis else (slice(*ends), part[1])
        for ends in ((middle, middle + 1), (part[axis].start, middle), (middle + 1, part[axis].stop))
    )
    for piece in pieces:
        yield from _dissected(piece)
    yield line, part


def _add(front: np.ndarray, child: np.ndarray, positions: np.ndarray, deep: int) -> None:
    """Add the lower triangle of a matrix over some positions of a front, ascending, to it, run by run."""
    starts = np.flatnonzero(np.diff(positions, prepend=-2) != 1)
    runs = [
        (slice(deep * start, deep * stop), slice(deep * positions[start], deep * (positions[stop - 1] + 1)))
        for start, stop in zip(starts, [*starts[1:], len(positions)], strict=True)
    ]
    for number, (rows, into) in enumerate(runs):
        for columns, across in runs[: number + 1]:
            front[into, across] += child[rows, columns]


# A solid body, factorised once: rows over its surface cells, and how all of it moves under each of them.


_AT_ONCE = 32  # right-hand sides; more take no less time, and 2 MB each on the default sheet


class Elastic:
    """Hexahedra glued to a table, under moments of a surface pressure (:mod:`skin.touch.shapes`).

    Args:
        mesh: the elements.
        refinement: elements along each side of a cell.

    Raises:
        InputError: more elements than memory allows.
    """

    def __init__(self, mesh: Hexahedra, refinement: int = 1) -> None:
        self.mesh = mesh
        columns, rows, _ = mesh.counts
        self.cells = columns // refinement, rows // refinement
        # A moment acts on the nodes as the splines fit what the nodes know of an influence.
        self._fits = [
            fit_nodes(count, nodes + 1) for count, nodes in zip(self.cells, (columns, rows), strict=True)
        ]
        self._area = mesh.lines[0][-1] * mesh.lines[1][-1] / (self.cells[0] * self.cells[1])

    @cached_property
    def key(self) -> str:
        """A hash of all that its motions depend on."""
        mesh = self.mesh
        arrays = (*mesh.lines, mesh.young, mesh.poisson, mesh.nodes, mesh.frame(np.zeros((1, 3))))
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()

    @cached_property
    def _factors(self) -> Cholesky:
        columns, rows, deep = self.mesh.counts
        require_memory(
            _bytes(columns, rows, deep),
            f"the stiffness of {columns} x {rows} x {deep} solid elements",
            "give fewer, such as body.cells=[32,32], simulator.refinement=1 or simulator.divisions=2",
        )
        free = self._plane * deep
        return Cholesky(self.mesh.stiffness()[:free, :free], (rows + 1, columns + 1))

    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Return how far nodes move (3 N, L), m, under nodal forces (3 N, L), N."""
        moves, free = np.zeros_like(forces), len(forces) - self._plane
        moves[:free] = self._factors.solve(forces[:free])
        return moves

    def loads(self, axis: int, part: slice = slice(None)) -> np.ndarray:
        """Return the nodal forces (3 N, L), N, of a moment of 1 Pa of cells, along an axis of the chart."""
        row, column = np.divmod(np.arange(self.cells[0] * self.cells[1])[part], self.cells[0])
        along_x, along_y = self._fits
        force = np.einsum("ly,lx,yxk->yxkl", along_y[row], along_x[column], self._directions(axis))
        nodal = np.zeros((len(self.mesh.held), len(row)))
        nodal[: self._plane] = self._area * force.reshape(self._plane, -1)
        return nodal

    def work(self, axis: int, moves: np.ndarray) -> np.ndarray:
        """Return the work (cells, L) of each cell's load on motions (3 N, L): ``loads(axis).T @ moves``."""
        directions = self._directions(axis)
        top = moves[: self._plane].reshape(*directions.shape, -1)
        along = np.einsum("yxkl,yxk->yxl", top, directions)
        work = np.einsum("ay,yxl,bx->abl", self._fits[1], along, self._fits[0], optimize=True)
        return self._area * work.reshape(-1, moves.shape[1])

    @property
    def _plane(self) -> int:
        """Unknowns on the surface."""
        columns, rows, _ = self.mesh.counts
        return 3 * (columns + 1) * (rows + 1)

    def _directions(self, axis: int) -> np.ndarray:
        """Return an axis of the chart at the nodes of the surface, (rows + 1, columns + 1, 3), in space."""
        x, y, _ = self.mesh.lines
        positions = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1)
        return self.mesh.frame(positions.reshape(-1, 3))[:, axis].reshape(len(y), len(x), 3)

    def transfer(self, rows: sp.csr_matrix, axes: Sequence[int] = (0, 1, 2)) -> np.ndarray:
        """Return what rows (R, 3 N) read of a moment of 1 Pa of each cell along each axis: (axes, R, cells).

        One solve per row, of the transposed problem (K is symmetric), whatever the number of cells.
        """
        influence = np.empty((len(axes), rows.shape[0], self.cells[0] * self.cells[1]))
        for first in range(0, rows.shape[0], _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            adjoint = self.solve(rows[part].T.toarray())
            for axis, out in zip(axes, influence, strict=True):
                out[part] = self.work(axis, adjoint).T
        return influence

    def of_cells(self, axis: int) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield parts of the cells, and how nodes move under a moment of 1 Pa of each, (3 N, part), m/Pa."""
        for first in range(0, self.cells[0] * self.cells[1], _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            yield part, self.solve(self.loads(axis, part))


def _bytes(columns: int, rows: int, deep: int) -> float:
    """Estimate the memory that assembly and factors take, bytes.

    The factors have 3 log2(places) entries per place and squared unknown of a column, within 7 % from 17 to
    257 places a side; the last fronts have 4 times the squared unknowns of a side. The stiffness has 81
    entries per unknown, which the assembly holds four times at 12 bytes.
    """
    positions, unknowns = float((columns + 1) * (rows + 1)), 3 * deep
    return 8 * positions * unknowns**2 * (3 * np.log2(positions) + 4) + 4 * 12 * 81 * positions * unknowns


_HERE = Path(__file__).parent
_SOURCES = [
    *sorted((_HERE.parents[1] / "body").glob("*.py")),
    *(_HERE / f"{name}.py" for name in ("_mesh", "base", "solid")),
    _HERE.parent / "geometry.py",
    _HERE.parents[1] / "touch" / "shapes.py",
]
_INWARDS = 2
_BODIES = WeakValueDictionary[tuple[str, int], Elastic]()


@checked("simulator")
class Solid(AbstractSimulator):
    """Layers of nearly incompressible elastic solid on a rigid base.

    A sensor reads the force d . sigma . n on its footprint along its direction d, by default n. One that is
    tilted or has three axes responds to shear, and each sensor responds to its neighbourhood. The model is
    linear: strains must be small (see the summary of each data set).

    Readings under a disc of 5 mm radius and more on the default sheet have an error of up to 2 %, those under
    uniform pressure of 0.2 %; ``make physics`` and tests/mechanics/simulator/test_solid.py check other cases.

    Loads are moments of the pressure (:mod:`skin.touch.shapes`), which small contacts need.
    :meth:`forward` takes pressures of cells.

    Args:
        body: sheet or arm.
        sensors: positions, normals and directions of the sensors.
        divisions: rows of elements in each layer.
        refinement: elements along each side of a cell.
        poisson: name of a material -> nu that replaces a value >= 0.5.
        cache: folder for computed operators; None: the environment variable SKIN_CACHE, else the user's
            cache.

    Raises:
        InputError: a material with nu >= 0.5, an unknown material, no row of elements, or a mesh that does
            not fit into memory.
    """

    feels_shear: ClassVar[bool] = True
    smooth: ClassVar[bool] = True
    transfer: Tensor
    spread_x: Tensor
    spread_y: Tensor

    def __init__(
        self,
        body: AbstractBody,
        sensors: Sensors,
        divisions: PositiveInt | None = None,
        poisson: Mapping[str, float] | None = None,
        cache: str | Path | None = None,
        refinement: PositiveInt = 2,
    ) -> None:
        super().__init__()
        self.shape, self._area = body.shape, float(np.prod(body.cell))
        self._body, self._settings = body, (divisions, poisson or {}, refinement)
        self._folder = array_cache.folder(cache)
        warn_of_cut(sensors, (*body.size, body.thickness))
        self._parts, self._strained = self._elastic(sensors), dict[int, list[Tensor]]()
        self._sensors, self.axes = sensors, sensors.axes
        self.register_buffer("transfer", self._operator(reading_rows, len(sensors)))
        for name, count in zip(("spread_x", "spread_y"), body.cells, strict=True):
            self.register_buffer(name, torch.from_numpy(cell_moments(count).copy()).float())

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the readings under pressure (..., H, W), Pa, and shear (..., 2)."""
        return self.press(self.loads(pressure), shear)

    def loads(self, pressure: Tensor) -> Tensor:
        """Return the moments (..., H, W), Pa, of pressures on the cells (..., H, W), Pa."""
        flatten(pressure, self.shape, self.spread_x.dtype)  # refuses what is no pressure
        return self.spread_y @ pressure.to(self.spread_x.dtype) @ self.spread_x.T

    def press(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Response:
        """Return the response to moments (..., H, W), Pa, and shear (..., 2), also with D_s and D_t."""
        return self.read(self.linear(loads, shear, displacement))

    def linear(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Tensor:
        """Return the readings (..., S), or with D_s and D_t (..., 3 S)."""
        readings = self._rows(self.transfer, loads, shear)
        if not displacement:
            return readings
        moves = self._rows(self._moves[..., : 2 * len(self._sensors)], loads, shear)
        return torch.cat([readings, moves], dim=-1)

    def _rows(self, operator: Tensor, loads: Tensor, shear: Tensor | None) -> Tensor:
        """Return the rows of an operator times the loads along each axis."""
        cells, operator = flatten(loads, self.shape, operator.dtype), operator.to(loads.device)
        felt = cells @ operator[_INWARDS]
        if shear is not None:
            for axis in (0, 1):
                part = cells @ operator[axis]
                felt = felt + shear[..., axis, None].to(part) * part
        return felt

    def read(self, linear: Tensor) -> Response:
        """Return the response for readings (..., S), or with D_s and D_t (..., 3 S)."""
        readings, *moves = linear.split(len(self._sensors), dim=-1)
        return Response(readings, torch.stack(moves, dim=-1) if moves else None)

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the displacement of each sensor along x, along y and into the skin, (..., S, 3), m."""
        inwards, _, x, y = self._rows(self._moves, self.loads(pressure), shear).chunk(4, dim=-1)
        return torch.stack([x, y, inwards], dim=-1)

    def compliance(self) -> Tensor:
        """Return C (cells, cells), m/Pa: mean inward displacement of each cell under 1 Pa on each cell.

        Symmetric and positive definite, because it is that of the fine mesh alone: the difference of two
        meshes need not be. Computed once, then cached on disk.
        """
        moved = self._surface["cells"] / self._area
        spread = np.kron(cell_moments(self.shape[0]), cell_moments(self.shape[1]))
        compliance = spread.T @ moved @ spread
        return torch.from_numpy((compliance + compliance.T) / 2).float()

    def surface(self, loads: Tensor) -> Tensor:
        """Return how far the corners of the cells move into the skin, (F, H + 1, W + 1), m.

        Args:
            loads: (F, H, W), the moments, Pa.
        """
        cells = flatten(loads, self.shape, torch.float32).cpu()
        moved = cells @ torch.from_numpy(self._surface["corners"].T).float()
        return moved.unflatten(1, (self.shape[0] + 1, self.shape[1] + 1))

    @cached_property
    def _surface(self) -> dict[str, np.ndarray]:
        """How the surface moves under a moment of 1 Pa of each cell: the cells' work, J, and corners, m."""
        elastic, cells = self._fine, math.prod(self.shape)
        shapes = {"cells": (cells, cells), "corners": (math.prod(side + 1 for side in self.shape), cells)}
        key = self._key([(1.0, elastic)], "surface")

        def build() -> dict[str, np.ndarray]:
            rows, moved = _corners(elastic), {name: np.empty(shape) for name, shape in shapes.items()}
            for part, moves in elastic.of_cells(_INWARDS):
                moved["cells"][:, part] = elastic.work(_INWARDS, moves)
                moved["corners"][:, part] = rows @ moves
            return moved

        return array_cache.kept(self._folder / f"surface-{key}.npz", key, shapes, build)

    @property
    def _fine(self) -> Elastic:
        return self._parts[0][1]

    def strain(self, loads: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the largest principal strain of the top layer, (U,), including that from shear.

        On the fine mesh alone: the means over the rows of elements of two meshes are at different depths.
        """
        cells = flatten(loads, self.shape, self.transfer.dtype)
        axes, parts = [_INWARDS], [cells]
        if shear is not None:
            axes += [0, 1]
            parts += [cells * shear[:, axis, None].to(cells) for axis in (0, 1)]
        load = torch.cat(parts, dim=1)
        halves = zip(*(self._strains(axis) for axis in axes), strict=True)
        return torch.stack([largest_strain(load, torch.cat(half, dim=2).to(load)) for half in halves]).amax(0)

    def _strains(self, axis: int) -> list[Tensor]:
        """Return strains in halves of the top layer, (6, cells, cells), under 1 Pa of moment of each cell."""
        if axis in self._strained:
            return self._strained[axis]
        top, cells = self._body.layers[-1].thickness, math.prod(self.shape)
        rows = strain_rows(self._fine.mesh, top, self._settings[2])
        shapes = {f"half {number}": (6, cells, cells) for number in range(len(rows))}
        key = self._key([(1.0, self._fine)], ["strain", axis])

        def build() -> dict[str, np.ndarray]:
            strains = {half: np.empty(shape) for half, shape in shapes.items()}
            for part, moves in self._fine.of_cells(axis):
                for strain, read in zip(strains.values(), rows, strict=True):
                    strain[:, :, part] = (read @ moves).reshape(6, cells, -1)
            return strains

        needed = 8 * sum(math.prod(shape) for shape in shapes.values())
        require_memory(needed, f"the strains of {cells} cells", "give fewer, such as body.cells=[32,32]")
        stored = array_cache.kept(self._folder / f"strain-{key}.npz", key, shapes, build)
        self._strained[axis] = [torch.from_numpy(strain).float() for strain in stored.values()]
        return self._strained[axis]

    def of(self, sensors: Sensors, axes: Sequence[int] = (0, 1, 2)) -> np.ndarray:
        """Return the readings of other sensors under a moment of 1 Pa of each cell, (axes, S, cells), N/Pa.

        Args:
            sensors: S sensors; one solve each, on meshes of their own depths.
            axes: of the loads: along x (0), y (1) and inwards (2).
        """
        parts = [
            weight * elastic.transfer(reading_rows(elastic.mesh, sensors), axes)
            for weight, elastic in self._elastic(sensors)
        ]
        return np.sum(parts, axis=0)

    def pressure_rows(self, sensors: Sensors) -> np.ndarray:
        """Return the readings of other sensors under a moment of 1 Pa of each cell, (S, cells), N/Pa."""
        return self.of(sensors, [_INWARDS])[0]

    def _elastic(self, sensors: Sensors) -> list[tuple[float, Elastic]]:
        """Return bodies for some sensors, whose weighted sum is the solution.

        Their factors take seconds: one body for all living simulators of it.
        """
        bodies = []
        for weight, mesh, refinement in build_meshes(self._body, sensors, *self._settings):
            elastic = Elastic(mesh, refinement)
            bodies.append((weight, _BODIES.setdefault((elastic.key, refinement), elastic)))
        return bodies

    def _key(self, parts: Sequence[tuple[float, Elastic]], about: Any) -> str:
        """Return the name of what is computed from bodies."""
        bodies = [[weight, *elastic.cells, elastic.key] for weight, elastic in parts]
        return array_cache.hashed({"bodies": bodies, "about": about}, _SOURCES)

    @cached_property
    def _moves(self) -> Tensor:
        """How D_s, D_t and the sensors along x and y move, (3, cells, 4 S), m/Pa; solved when first used."""
        return self._operator(_motions, 4 * len(self._sensors))

    def _operator(self, read: Callable[[Hexahedra, Sensors], sp.csr_matrix], count: int) -> Tensor:
        """Return what rows of a mesh read: moments times this (3, cells, rows), for each axis of the load."""
        sensors = self._sensors
        about = {
            "rows": read.__name__,
            "positions": sensors.positions.tolist(),
            "normals": sensors.normals.tolist(),
            "directions": sensors.measured.tolist(),
            "footprint": sensors.footprint,
        }
        key = self._key(self._parts, about)
        shape = (3, count, math.prod(self.shape))

        def build() -> dict[str, np.ndarray]:
            parts = [weight * body.transfer(read(body.mesh, sensors)) for weight, body in self._parts]
            return {"rows": np.sum(parts, axis=0)}

        rows = array_cache.kept(self._folder / f"solid-{key}.npz", key, {"rows": shape}, build)["rows"]
        return torch.from_numpy(rows.transpose(0, 2, 1).copy()).float()


def _motions(mesh: Hexahedra, sensors: Sensors) -> sp.csr_matrix:
    """Return rows (4 S, 3 N) that give D_s, D_t and the displacements of each sensor along x and y, m."""
    positions = sensors.positions
    above = positions * np.array([1.0, 1.0, 0.0])
    x, y, inwards = (np.tile(axis, (len(positions), 1)) for axis in np.eye(3))
    axes = ((positions, inwards), (above, inwards), (positions, x), (positions, y))
    return sp.vstack([mesh.motion(*motion_axes) for motion_axes in axes]).tocsr()


def _corners(elastic: Elastic) -> sp.csr_matrix:
    """Return rows that read how far the corners of the cells move into the skin, m."""
    lines = zip(elastic.mesh.lines, elastic.cells, strict=False)
    x, y = (np.linspace(0, line[-1], count + 1) for line, count in lines)
    positions = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
    return elastic.mesh.motion(positions, np.tile(np.eye(3)[_INWARDS], (len(positions), 1)))
