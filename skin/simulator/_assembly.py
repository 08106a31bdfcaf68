"""The plates and beams of a sheet, assembled on its structured grid.

Nodes lie on a grid of (ny + 1) x (nx + 1) per interface above the table, numbered by interface from the
table up, then by row, then by column. The table holds the lowest beams' feet, so its nodes have no unknowns.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import sparse

from skin.body.base import AbstractBody, overlaps
from skin.errors import InputError
from skin.sensors import Sensors
from skin.simulator._beam import beam_stiffness
from skin.simulator._plate import plate_stiffness, pressure_load

Constraint = Literal["vertical", "free"]

# The degrees of freedom (u, v, w, rx, ry, rz) that supports leave free above the table.
_FREE = {"vertical": (2, 3, 4), "free": (0, 1, 2, 3, 4)}
# Interfaces higher or lower than this from a sensor are not the sensor's, m.
_SAME_DEPTH = 1e-6


@dataclass(frozen=True)
class Structure:
    """The equations of a sheet, and where its nodes stand in them.

    Attributes:
        body: the sheet.
        constraint: ``vertical`` leaves w and the rotations about x and y free above the table; ``free``
            leaves motion along x and y free too. Rotation about z is held.

    Raises:
        InputError: a body that is not flat.
    """

    body: AbstractBody
    constraint: Constraint = "vertical"

    def __post_init__(self) -> None:
        if not self.body.flat:
            name = type(self.body).__module__.rpartition(".")[2]
            raise InputError(
                f"plates and beams are flat, body={name} is not: set simulator=solid or "
                "simulator=naive, or body=sheet"
            )

    @property
    def free(self) -> tuple[int, ...]:
        """Which of a node's (u, v, w, rx, ry, rz) are unknowns, in this order."""
        return _FREE[self.constraint]

    @property
    def grid(self) -> tuple[int, int, int]:
        """Number of nodes: (layers, ny + 1, nx + 1)."""
        return len(self.body.layers), self.body.cells[1] + 1, self.body.cells[0] + 1

    @property
    def nodes(self) -> np.ndarray:
        """Numbers of the nodes, (layers, ny + 1, nx + 1)."""
        return np.arange(math.prod(self.grid)).reshape(self.grid)

    @property
    def unknowns(self) -> int:
        """Number of equations."""
        return math.prod(self.grid) * len(self.free)

    def stiffness(self) -> sparse.csc_matrix:
        """Return K, (N, N): forces in N and moments in N m per m and rad."""
        blocks = [block for level in range(len(self.body.layers)) for block in self._layer(level)]
        rows, columns, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
        return sparse.coo_matrix((values, (rows, columns)), (self.unknowns, self.unknowns)).tocsc()

    def load(self) -> sparse.csc_matrix:
        """Return P, (N, H*W): ``P @ pressure`` is the load of a pressure (H*W,), Pa, on the surface."""
        corners = self._unknowns(self._corners(-1))
        unit = pressure_load(*self.body.cell).reshape(4, 6)[:, self.free].ravel()
        cells = np.repeat(np.arange(len(corners)), corners.shape[1])
        shape = (self.unknowns, len(corners))
        return sparse.coo_matrix((np.tile(unit, len(corners)), (corners.ravel(), cells)), shape).tocsc()

    def levels(self, sensors: Sensors) -> np.ndarray:
        """Return the interface of each sensor, counted from the table's first layer, (S,).

        Raises:
            InputError: a sensor lies at no interface.
        """
        away = np.abs(sensors.positions[:, 2:] - np.array(self.body.interfaces))
        if (lost := away.min(axis=1) > _SAME_DEPTH).any():
            number = int(lost.argmax())
            depths = ", ".join(f"{depth:g}" for depth in self.body.interfaces)
            raise InputError(
                f"sensor {number + 1} lies {sensors.positions[number, 2]:g} m deep, but plates and beams "
                f"have a displacement only at the interfaces between layers, {depths} m: give one of them as "
                "depth_m, split a layer in body.layers, or use simulator=solid"
            )
        return away.argmin(axis=1)

    def deflection(self, sensors: Sensors, levels: np.ndarray) -> sparse.csr_matrix:
        """Return rows (S, N) that read the motion into the skin at each sensor's x, y on an interface, m."""
        return -self.shift(sensors, levels, axis=2)

    def shift(self, sensors: Sensors, levels: np.ndarray, axis: int) -> sparse.csr_matrix:
        """Return rows (S, N) that read the motion along x (axis 0), y (1) or up (2) at each sensor, m."""
        steps = sensors.positions[:, :2, None] / np.array(self.body.cell)[:, None]
        # Linear between the nearest two lines of nodes: a hat around each.
        x, y = (
            np.clip(1 - np.abs(steps[:, axis] - np.arange(count + 1)), 0, None)
            for axis, count in enumerate(self.body.cells)
        )
        return self._read(y[:, :, None] * x[:, None, :], levels, dof=axis)

    def carried(self, sensors: Sensors, levels: np.ndarray) -> sparse.csr_matrix:
        """Return rows (S, N) that read the force in the beams below each sensor's footprint, N.

        Each beam counts with the part of its section that lies under the footprint.
        """
        along_x, along_y = (
            overlaps(_section_edges(self.body, axis), sensors.positions[:, axis], sensors.footprint[axis])
            for axis in (0, 1)
        )
        per_metre = np.array([layer.material.young / layer.thickness for layer in self.body.layers])
        weights = per_metre[levels][:, None, None] * np.einsum("sh,sw->shw", along_y, along_x)
        weights = weights * _beam_moduli(self.body)[levels]
        above_table = levels > 0
        below = self._read(weights * above_table[:, None, None], np.maximum(levels - 1, 0), dof=2)
        return below - self._read(weights, levels, dof=2)

    def _read(self, weights: np.ndarray, levels: np.ndarray, dof: int) -> sparse.csr_matrix:
        """Return rows (S, N) that weigh a motion (u, v, w: 0, 1, 2) of an interface by (S, ny+1, nx+1)."""
        sensor, row, column = np.nonzero(weights)
        unknown = self.nodes[levels[sensor], row, column] * len(self.free) + self.free.index(dof)
        values = weights[sensor, row, column]
        return sparse.coo_matrix((values, (sensor, unknown)), (len(weights), self.unknowns)).tocsr()

    def _layer(self, level: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return rows, columns and values of one layer's plates and of its beams."""
        layer = self.body.layers[level]
        plate = plate_stiffness(*self.body.cell, layer.thickness, layer.material)
        width, height = (np.diff(_section_edges(self.body, axis)) for axis in (0, 1))
        beams = beam_stiffness(
            np.tile(width, len(height)), np.repeat(height, len(width)), layer.thickness, layer.material
        )
        beams = beams * _beam_moduli(self.body)[level].reshape(-1, 1, 1)
        upper = self.nodes[level].reshape(-1, 1)
        if level == 0:
            ends, columns = upper, _dofs([1], self.free)
        else:
            ends, columns = np.hstack([self.nodes[level - 1].reshape(-1, 1), upper]), _dofs([0, 1], self.free)
        corners, corner_kept = self._unknowns(self._corners(level)), _dofs(range(4), self.free)
        plates = plate[None, corner_kept][:, :, corner_kept] * self.body.moduli[level].reshape(-1, 1, 1)
        return [_scatter(corners, plates), _scatter(self._unknowns(ends), beams[:, columns][:, :, columns])]

    def _corners(self, level: int) -> np.ndarray:
        """Return the four nodes of every cell of an interface, (H*W, 4), in the order of a plate's nodes."""
        grid = self.nodes[level]
        return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1).reshape(-1, 4)

    def _unknowns(self, nodes: np.ndarray) -> np.ndarray:
        """Return the unknowns of elements' nodes (n, k), as (n, k * unknowns per node)."""
        free_dofs = len(self.free)
        return (nodes[:, :, None] * free_dofs + np.arange(free_dofs)).reshape(len(nodes), -1)


def _section_edges(body: AbstractBody, axis: int) -> np.ndarray:
    """Return the borders between nodes' parts of the sheet, m: halfway between them, and the edges."""
    nodes = np.linspace(0, body.size[axis], body.cells[axis] + 1)
    return np.concatenate([nodes[:1], (nodes[1:] + nodes[:-1]) / 2, nodes[-1:]])


def _beam_moduli(body: AbstractBody) -> np.ndarray:
    """Return each beam's modulus over its layer's, (layers, ny+1, nx+1): the mean of the cells it touches.

    A beam's section takes an equal part of each of them.
    """
    cells = body.moduli
    total, count = np.zeros((2, len(cells), cells.shape[1] + 1, cells.shape[2] + 1))
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        part = np.s_[:, row : row + cells.shape[1], column : column + cells.shape[2]]
        total[part] += cells
        count[part] += 1
    return total / count


def _dofs(ends: Iterable[int], free: tuple[int, ...]) -> list[int]:
    """Return where the free ones of six degrees of freedom stand at some ends of an element."""
    return [6 * end + dof for end in ends for dof in free]


def _scatter(unknowns: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of element matrices (n, k, k) with unknowns (n, k)."""
    size = unknowns.shape[1]
    rows = np.repeat(unknowns, size, axis=1)
    columns = np.tile(unknowns, (1, size))
    return rows.ravel(), columns.ravel(), matrices.reshape(len(unknowns), -1).ravel()
