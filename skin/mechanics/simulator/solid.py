"""Three-dimensional elasticity of a layered body, as one linear operator."""

import os
import sys
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np
import scipy.sparse as sp
import torch
from pydantic import PositiveInt
from rich.console import Console
from rich.progress import track
from scipy.sparse.linalg import SuperLU
from torch import Tensor

from skin.body.base import AbstractBody, Sensors, require_memory
from skin.body.material import MATERIALS
from skin.core import array_cache
from skin.core.files import whole
from skin.core.settings import checked
from skin.errors import InputError
from skin.mechanics.simulator._hexahedra import Hexahedra
from skin.mechanics.simulator._strain import largest, solid_rows
from skin.mechanics.simulator.base import AbstractSimulator, Response, factorised, flatten
from skin.touch import splines

# What a sensor feels: points and weights over its footprint, wherever it faces.


_GAUSS = np.array([-1.0, 1.0]) / np.sqrt(3)


def quadrature(
    sensors: Sensors, lines: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points over every sensor's footprint, what they weigh, and whose they are.

    A footprint is a rectangle about the sensor, across its normal. Two Gauss points stand along each side of
    each piece into which the lines cut it, so that a stress that is a cubic between lines is integrated
    exactly where the sensor faces the surface. What passes the edge of the body is cut off.

    Args:
        sensors: S of them.
        lines: along x, y and depth, m, from one edge of the body to the other.

    Returns:
        points (P, 3) in the chart, m; areas (P,), m^2; sensor (P,), its index.
    """
    points, areas, owners = [], [], []
    for number, (place, normal) in enumerate(zip(sensors.positions, sensors.normals, strict=True)):
        turned = _turn(normal)
        along = [
            _pieces(
                extent / 2,
                *(_crossings(lines[across] - place[across], turned[axis, across]) for across in (axis, 2)),
            )
            for axis, extent in enumerate(sensors.footprint)
        ]
        (s, ds), (t, dt) = along
        grid = s[:, None, None] * turned[0] + t[None, :, None] * turned[1]
        points.append(place + grid.reshape(-1, 3))
        areas.append(np.outer(ds, dt).ravel())
        owners.append(np.full(areas[-1].size, number))
    places, weights, owner = np.concatenate(points), np.concatenate(areas), np.concatenate(owners)
    last = np.array([line[-1] for line in lines])
    inside = ((places >= 0) & (places <= last)).all(axis=1)
    return places[inside], weights[inside], owner[inside]


def _turn(normal: np.ndarray) -> np.ndarray:
    """Return the chart's axes turned the shortest way until the third is the normal, (3, 3), rows."""
    x, y, z = normal if normal[2] >= 0 else -normal
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )


def _crossings(distances: np.ndarray, slope: float) -> np.ndarray:
    """Return where a line of some slope has gone some distances; nowhere if it stands still."""
    return distances / slope if abs(slope) > 1e-9 else np.empty(0)


def _pieces(half: float, *crossings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points between -half and half, by pieces between cuts, and their weights."""
    cuts = np.concatenate(crossings)
    edges = np.unique(np.concatenate([[-half, half], cuts[np.abs(cuts) < half]]))
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    return (middle[:, None] + np.outer(width / 2, _GAUSS)).ravel(), np.repeat(width / 2, 2)


# A solid body, factorised once: rows over its surface cells, and how all of it moves under each of them.


_AT_ONCE = 32  # right-hand sides


class Elastic:
    """Hexahedra glued to a table, under moments of a surface pressure (:mod:`skin.touch.splines`).

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
            splines.fit_nodes(count, nodes + 1)
            for count, nodes in zip(self.cells, (columns, rows), strict=True)
        ]
        self._area = mesh.lines[0][-1] * mesh.lines[1][-1] / (self.cells[0] * self.cells[1])

    @cached_property
    def _factors(self) -> SuperLU:
        columns, rows, deep = self.mesh.counts
        require_memory(
            _bytes(columns, rows, deep),
            f"the stiffness of {columns} x {rows} x {deep} solid elements",
            "give fewer, such as body.cells=[32,32] or simulator.refinement=1",
        )
        return factorised(self.mesh.stiffness()[self._free][:, self._free].tocsc())

    @cached_property
    def _free(self) -> np.ndarray:
        return np.flatnonzero(~self.mesh.held)

    def solve(self, forces: np.ndarray) -> np.ndarray:
        """Return how far nodes move (3 N, L), m, under nodal forces (3 N, L), N."""
        moves = np.zeros_like(forces)
        moves[self._free] = self._factors.solve(np.ascontiguousarray(forces[self._free]))
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
        places = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1)
        return self.mesh.frame(places.reshape(-1, 3))[:, axis].reshape(len(y), len(x), 3)

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

    def influence(self, axis: int, deep: int, path: Path) -> np.ndarray:
        """Return how upper nodes move under a moment of 1 Pa of each cell, (n, cells) float32, m/Pa.

        Args:
            axis: along which the cells are loaded.
            deep: rows of elements, from the surface down, whose nodes are kept: the first n unknowns.
            path: of the file from which it is read, x.npy; it is written if it is not there.
        """
        shape = ((deep + 1) * self._plane, self.cells[0] * self.cells[1])
        influence = _stored(path, shape)
        if influence is None:
            self._write_influence(axis, path, shape)
            influence = _stored(path, shape)
        assert influence is not None
        return influence

    def _write_influence(self, axis: int, path: Path, shape: tuple[int, int]) -> None:
        parts = range(0, shape[1], _AT_ONCE)
        with whole(path, "SKIN_CACHE=FOLDER") as partial:
            influence = np.lib.format.open_memmap(partial, mode="w+", dtype=np.float32, shape=shape)
            _reserve(partial)
            console = Console(stderr=True)
            terminal = sys.stderr.isatty()
            for first in track(parts, "solving for each surface cell", console=console, disable=not terminal):
                part = slice(first, first + _AT_ONCE)
                influence[:, part] = self.solve(self.loads(axis, part))[: shape[0]]
            influence.flush()
            del influence  # Windows does not rename a file that is mapped


def _stored(path: Path, shape: tuple[int, int]) -> np.ndarray | None:
    """Return the float32 array in a file, or None if there is none of this shape."""
    try:
        influence = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, EOFError, ValueError):
        return None
    return influence if influence.shape == shape and influence.dtype == np.float32 else None


def _reserve(path: Path) -> None:
    """Claim the disk space of a file that is mapped: to write to a map of a full disk kills the process."""
    if hasattr(os, "posix_fallocate"):
        with open(path, "rb+") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def _bytes(columns: int, rows: int, deep: int) -> float:
    """Estimate the memory that assembly and factors take, bytes.

    Measured on 16 to 48 cells a side and 4 to 6 rows: both factors have about (21.8 log2(side) - 59) entries
    per place and squared unknown of a column, at 18 bytes with what the solver holds besides; the assembly
    holds 24 x 24 numbers per element, five times over. The sum came within 10 % of the memory then measured.
    """
    places = float((columns + 1) * (rows + 1))
    filling = max(21.8 * np.log2(places**0.5) - 59, 12.0)
    return 18 * places * (3 * deep) ** 2 * filling + 40 * 24 * 24 * columns * rows * deep


_HERE = Path(__file__).parent
_SOURCES = [
    *sorted((_HERE.parents[1] / "body").glob("*.py")),
    *(_HERE / f"{name}.py" for name in ("_hexahedra", "base", "solid")),
    Path(splines.__file__),
]
_INWARDS = 2
_BODIES = WeakValueDictionary[tuple[str, int], Elastic]()


@checked("simulator")
class Solid(AbstractSimulator):
    """Layers of nearly incompressible elastic solid on a rigid base.

    A sensor reads the normal force n . sigma . n on its footprint. A tilted sensor therefore responds to
    shear, and each sensor responds to its neighbourhood. The model is linear: strains must be small (see the
    summary of each data set).

    Readings under a disc of 5 mm radius and more on the default sheet have an error of up to 2 %, those under
    uniform pressure of 0.2 %; ``make physics`` and tests/mechanics/simulator/test_solid.py check other cases.

    Loads are moments of the pressure (:mod:`skin.touch.splines`), which small contacts need.
    :meth:`forward` takes pressures of cells.

    Args:
        body: sheet or arm.
        sensors: positions and normals of the sensors.
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
        divisions: PositiveInt = 2,
        poisson: Mapping[str, float] | None = None,
        cache: str | Path | None = None,
        refinement: PositiveInt = 2,
    ) -> None:
        super().__init__()
        self.shape, self._area = body.shape, float(np.prod(body.cell))
        self._mesh = build_mesh(body, divisions, poisson or {}, refinement)
        self._divisions, self._refinement = divisions, refinement
        self._folder = array_cache.folder(cache)
        self._key = array_cache.hashed(_content(body, self._mesh), _SOURCES)
        rows = self._operator(sensors)
        # (3, rows, cells) -> the moments of a pressure times this give all rows for each axis of the load.
        self.register_buffer("transfer", torch.from_numpy(rows.transpose(0, 2, 1).copy()).float())
        for name, count in zip(("spread_x", "spread_y"), body.cells, strict=True):
            self.register_buffer(name, torch.from_numpy(splines.of_cells(count).copy()).float())
        self._sensors = len(sensors)

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa, and shear (..., 2), with D_s and D_t."""
        return self.press(self.loads(pressure), shear)

    def loads(self, pressure: Tensor) -> Tensor:
        """Return the moments (..., H, W), Pa, of pressures on the cells (..., H, W), Pa."""
        flatten(pressure, self.shape, self.spread_x.dtype)  # refuses what is no pressure
        return self.spread_y @ pressure.to(self.spread_x.dtype) @ self.spread_x.T

    def press(self, loads: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to moments (..., H, W), Pa, and shear (..., 2), with D_s and D_t."""
        return self.read(self.linear(loads, shear))

    def linear(self, loads: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return readings, D_s and D_t, (..., 3 S)."""
        return self._rows(loads, shear, slice(3 * self._sensors))

    def _rows(self, loads: Tensor, shear: Tensor | None, chosen: slice) -> Tensor:
        """Return some rows of the operator times the loads along each axis."""
        cells = flatten(loads, self.shape, self.transfer.dtype)
        felt = cells @ self.transfer[_INWARDS, :, chosen]
        if shear is not None:
            for axis in (0, 1):
                part = cells @ self.transfer[axis, :, chosen]
                felt = felt + shear[..., axis, None].to(part) * part
        return felt

    def read(self, linear: Tensor) -> Response:
        """Return the response for readings, D_s and D_t (..., 3 S)."""
        readings, sensor, surface = linear.chunk(3, dim=-1)
        return Response(readings, torch.stack([sensor, surface], dim=-1))

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the displacement of each sensor along x, along y and into the skin, (..., S, 3), m."""
        count = self._sensors
        loads = self.loads(pressure)
        inwards, _, x, y = self._rows(loads, shear, slice(count, 5 * count)).chunk(4, dim=-1)
        return torch.stack([x, y, inwards], dim=-1)

    def compliance(self) -> Tensor:
        """Return C (cells, cells), m/Pa: mean inward displacement of each cell under 1 Pa on each cell.

        Symmetric. Computed once, then cached on disk.
        """
        moved = self._elastic.work(_INWARDS, self.influence(_INWARDS)) / self._area
        spread = np.kron(splines.of_cells(self.shape[0]), splines.of_cells(self.shape[1]))
        compliance = spread.T @ moved @ spread
        return torch.from_numpy((compliance + compliance.T) / 2).float()

    def surface(self, loads: Tensor) -> Tensor:
        """Return how far the corners of the cells move into the skin, (F, H + 1, W + 1), m.

        Args:
            loads: (F, H, W), the moments, Pa.
        """
        cells = flatten(loads, self.shape, torch.float32).cpu()
        moved = cells @ torch.from_numpy(_read(self._corners, self.influence(_INWARDS)).T).float()
        return moved.unflatten(1, (self.shape[0] + 1, self.shape[1] + 1))

    @cached_property
    def _corners(self) -> sp.csr_matrix:
        """Rows that read how far the corners of the cells move into the skin, m."""
        x, y = (line[:: self._refinement] for line in self._mesh.lines[:2])
        places = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
        return self._mesh.motion(places, np.tile(np.eye(3)[_INWARDS], (len(places), 1)))

    def strain(self, loads: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the largest principal strain of the top layer, (U,), including that from shear."""
        cells = flatten(loads, self.shape, self.transfer.dtype)
        axes, parts = [_INWARDS], [cells]
        if shear is not None:
            axes += [0, 1]
            parts += [cells * shear[:, axis, None].to(cells) for axis in (0, 1)]
        load, fields = torch.cat(parts, dim=1), [self.influence(axis) for axis in axes]

        def read(rows: sp.csr_matrix) -> np.ndarray:
            return np.hstack([_read(rows, field) for field in fields])

        strains = solid_rows(self._mesh, self._divisions, self._refinement, read)
        return torch.stack([largest(load, torch.from_numpy(rows).to(load)) for rows in strains]).amax(0)

    def influence(self, axis: int) -> np.ndarray:
        """Return how nodes of the top layer move under a moment of 1 Pa of each cell, (n, cells), m/Pa."""
        path = self._folder / f"influence-{self._key}-{axis}.npy"
        return self._elastic.influence(axis, self._divisions, path)

    def of(self, sensors: Sensors, axes: Sequence[int] = (0, 1, 2)) -> np.ndarray:
        """Return the readings of other sensors under a moment of 1 Pa of each cell, (axes, S, cells), N/Pa.

        Args:
            sensors: S sensors; one solve each.
            axes: of the loads: along x (0), y (1) and inwards (2).
        """
        return self._elastic.transfer(reading_rows(self._mesh, sensors), axes)

    def pressure_rows(self, sensors: Sensors) -> np.ndarray:
        """Return the readings of other sensors under a moment of 1 Pa of each cell, (S, cells), N/Pa."""
        return self.of(sensors, [_INWARDS])[0]

    @cached_property
    def _elastic(self) -> Elastic:
        """The body, whose factors take seconds: one for all living simulators of it."""
        return _BODIES.setdefault((self._key, self._refinement), Elastic(self._mesh, self._refinement))

    def _operator(self, sensors: Sensors) -> np.ndarray:
        """Return the rows of readings, D_s, D_t and displacements along x and y, (3, 5 S, cells)."""
        about = {
            "body": self._key,
            "positions": sensors.positions.tolist(),
            "normals": sensors.normals.tolist(),
            "footprint": sensors.footprint,
        }
        key = array_cache.hashed(about, _SOURCES)
        shape = (3, 5 * len(sensors), self.shape[0] * self.shape[1])

        def build() -> dict[str, np.ndarray]:
            rows = sp.vstack([reading_rows(self._mesh, sensors), *_motions(self._mesh, sensors)]).tocsr()
            return {"rows": self._elastic.transfer(rows)}

        return array_cache.kept(self._folder / f"solid-{key}.npz", key, {"rows": shape}, build)["rows"]


def build_mesh(
    body: AbstractBody, divisions: int, poisson: Mapping[str, float], refinement: int = 1
) -> Hexahedra:
    """Return a body's elements: its cells cut in equal parts, ``divisions`` rows to each layer.

    Args:
        body: sheet or arm.
        divisions: of each layer.
        poisson: name of a material -> nu in place of its own.
        refinement: elements along each side of a cell.

    Raises:
        InputError: as of :class:`Solid`.
    """
    ratios = _ratios(body, poisson)
    depths, young, ratio = [0.0], [], []
    for number in reversed(range(len(body.layers))):
        layer = body.layers[number]
        depths += list(depths[-1] + layer.thickness * np.arange(1, divisions + 1) / divisions)
        young += [np.full([refinement * count for count in body.shape], layer.material.young)] * divisions
        ratio += [ratios[number]] * divisions
    x, y = (np.linspace(0, body.size[axis], refinement * body.cells[axis] + 1) for axis in (0, 1))
    return Hexahedra((x, y, np.array(depths)), np.stack(young), np.array(ratio), body.place, body.frame)


def reading_rows(mesh: Hexahedra, sensors: Sensors) -> sp.csr_matrix:
    """Return rows (S, 3 N) that give the normal force on each sensor, N, from nodal displacements."""
    # The stress is interpolated between the middles of elements, so its polynomials change there.
    cuts = tuple(np.unique([*line, *(line[1:] + line[:-1]) / 2]) for line in mesh.lines)
    points, areas, owner = quadrature(sensors, cuts)  # type: ignore[arg-type]
    sums = sp.csr_matrix((-areas, (owner, np.arange(len(owner)))), shape=(len(sensors), len(points)))
    return mesh.mean_stress((sums @ mesh.between(points)).tocsr(), sensors.normals)


def _motions(mesh: Hexahedra, sensors: Sensors) -> list[sp.csr_matrix]:
    """Return rows (S, 3 N) that give D_s, D_t and the displacements of each sensor along x and y, m."""
    places = sensors.positions
    above = places * np.array([1.0, 1.0, 0.0])
    x, y, inwards = (np.tile(axis, (len(places), 1)) for axis in np.eye(3))
    return [
        mesh.motion(*motion_axes)
        for motion_axes in ((places, inwards), (above, inwards), (places, x), (places, y))
    ]


def _read(rows: sp.csr_matrix, influence: np.ndarray) -> np.ndarray:
    """Return rows @ influence; only the lines with non-zero columns in rows are read from disk."""
    used = np.unique(rows.indices)
    return np.asarray(rows[:, used] @ influence[used])


def _ratios(body: AbstractBody, poisson: Mapping[str, float]) -> list[float]:
    names = {layer.material.name for layer in body.layers}
    if unknown := sorted(set(poisson) - names - {material.name for material in MATERIALS}):
        raise InputError(
            f"poisson (simulator.poisson) names {unknown[0]}, but the body is made of "
            f"{', '.join(sorted(names))}"
        )
    ratios = [float(poisson.get(layer.material.name, layer.material.poisson)) for layer in body.layers]
    for layer, ratio in zip(body.layers, ratios, strict=True):
        if not -1 < ratio < 0.5:
            name = layer.material.name
            raise InputError(
                f"{name} has Poisson's ratio {ratio:g}, but no isotropic solid is beyond -1 < nu < 0.5: "
                f"in Python give poisson={{{name!r}: 0.49}} to Solid or use PlatesAndBeams; "
                f"on the command line give 'simulator.poisson={{{name}: 0.49}}' or simulator=fem"
            )
    return ratios


def _content(body: AbstractBody, mesh: Hexahedra) -> dict[str, Any]:
    """Return all that the body's operators depend on."""
    space = np.concatenate([mesh.nodes, *mesh.frame(np.zeros((1, 3)))])
    return {
        "lines": [line.tolist() for line in mesh.lines],
        "young": mesh.young.tolist(),
        "poisson": mesh.poisson.tolist(),
        "nodes": space.tolist(),
    }
