"""The report's finite-element skin: plates and beams (report, 2.1.2), as one linear operator.

Nodes lie on a grid of (ny + 1) x (nx + 1) per interface above the table, numbered by interface from the
table up, then by row, then by column. The table holds the lowest beams' feet, so its nodes have no unknowns.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from skin.body.base import AbstractBody, Sensors, overlaps, require_memory
from skin.body.material import Material
from skin.core.settings import checked, option_name
from skin.errors import InputError
from skin.mechanics import array_cache
from skin.mechanics.simulator.base import AbstractSimulator, Response, factorised, flatten, largest_strain

# An upright Euler-Bernoulli beam of rectangular section, from the lower node to the upper one, each with the
# degrees of freedom (u, v, w, rx, ry, rz), w upwards.

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
    which moves it along x, and Ix = h w^3 / 12 bends it about its local z. They are exchanged: bending along
    x needs h w^3 / 12. On square cells they are equal but at the rim, where readings differ by up to 1 %.
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


# A rectangular plate: Adini-Clough-Melosh bending and a bilinear membrane. Nodes run (0, 0), (a, 0), (a, b),
# (0, b), with the beam's degrees of freedom, rx = dw/dy, ry = -dw/dx; supports hold rz.

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
        fraction_x, fraction_y = (x if corner_x else 1 - x), (y if corner_y else 1 - y)
        slope_x, slope_y = (2 * corner_x - 1) / a, (2 * corner_y - 1) / b
        matrix[0, 2 * node] = matrix[2, 2 * node + 1] = slope_x * fraction_y
        matrix[1, 2 * node + 1] = matrix[2, 2 * node] = slope_y * fraction_x
    return matrix


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
            name = option_name(self.body)
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
        upper = self.nodes[level].reshape(-1, 1)
        if level == 0:
            ends, columns = upper, _dofs([1], self.free)
        else:
            ends, columns = np.hstack([self.nodes[level - 1].reshape(-1, 1), upper]), _dofs([0, 1], self.free)
        corners, corner_kept = self._unknowns(self._corners(level)), _dofs(range(4), self.free)
        kept_plate = plate[np.ix_(corner_kept, corner_kept)]
        plates = np.broadcast_to(kept_plate, (len(corners), *kept_plate.shape))
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


def _dofs(ends: Iterable[int], free: tuple[int, ...]) -> list[int]:
    """Return where the free ones of six degrees of freedom stand at some ends of an element."""
    return [6 * end + dof for end in ends for dof in free]


def _scatter(unknowns: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of element matrices (n, k, k) with unknowns (n, k)."""
    size = unknowns.shape[1]
    rows = np.repeat(unknowns, size, axis=1)
    columns = np.tile(unknowns, (1, size))
    return rows.ravel(), columns.ravel(), matrices.reshape(len(unknowns), -1).ravel()


# Readings as matrices, solved once and kept on disk: the sheet is linear, so a functional s of its motion is
# a fixed row over the cells, s' K^-1 P p = (K^-1 s)' P p. One solve per functional replaces one per frame.

# Raise it when the meaning of a stored file changes.
_FORMAT = 2
_HERE = Path(__file__).parent
_SOURCES = [
    _HERE.parents[1] / "body" / "base.py",
    *(_HERE / name for name in ("base.py", "fem.py")),
]


@dataclass(frozen=True)
class Operator:
    """Rows over the cells (S, H*W), float64, to be multiplied by a pressure (H*W,) in Pa.

    Attributes:
        sensor: D_s, how far the sensor moves into the skin, m/Pa.
        surface: D_t, how far the surface above it does, m/Pa.
        applied: F_in, the force on the footprint at the surface, N/Pa.
        carried: the force that the layer below the sensor carries under the footprint, N/Pa.
        along_x: how far the sensor moves along x, m/Pa; 0 where supports hold it.
        along_y: how far it moves along y, m/Pa.
    """

    sensor: np.ndarray
    surface: np.ndarray
    applied: np.ndarray
    carried: np.ndarray
    along_x: np.ndarray
    along_y: np.ndarray


def build(structure: Structure, sensors: Sensors) -> Operator:
    """Assemble, factorise and solve for every functional of every sensor.

    Raises:
        InputError: a sensor lies at no interface, or the mesh is finer than memory allows.
    """
    body = structure.body
    levels = structure.levels(sensors)
    require_memory(
        _bytes(structure, len(sensors)),
        f"the stiffness of body.cells=[{body.cells[0]},{body.cells[1]}] with {len(body.layers)} layers",
        "give fewer cells, such as body.cells=[32,32]",
    )
    top = np.full_like(levels, len(body.layers) - 1)
    functionals = [
        structure.deflection(sensors, levels),
        structure.deflection(sensors, top),
        structure.carried(sensors, levels),
        *(structure.shift(sensors, levels, axis) for axis in (0, 1) if axis in structure.free),
    ]
    factors = factorised(structure.stiffness())
    load = structure.load()
    deflection, surface, carried, *along = (
        np.ascontiguousarray((load.T @ factors.solve(rows.T.toarray())).T) for rows in functionals
    )
    along_x, along_y = along or (np.zeros_like(deflection), np.zeros_like(deflection))
    return Operator(deflection, surface, body.footprint_areas(sensors), carried, along_x, along_y)


def cached(structure: Structure, sensors: Sensors, folder: Path) -> Operator:
    """Return the operator from its file in ``folder``, or build it and write the file."""
    body = structure.body
    content = {
        "format": _FORMAT,
        "size": body.size,
        "cells": body.cells,
        "layers": [(layer.material.young, layer.material.poisson, layer.thickness) for layer in body.layers],
        "constraint": structure.constraint,
        "positions": sensors.positions.tolist(),
        "footprint": sensors.footprint,
    }
    key = array_cache.hashed(content, _SOURCES)
    shape = (len(sensors), body.cells[0] * body.cells[1])
    shapes = {field.name: shape for field in fields(Operator)}
    arrays = array_cache.kept(
        folder / f"operator-{key}.npz", key, shapes, lambda: vars(build(structure, sensors))
    )
    return Operator(**arrays)


def _bytes(structure: Structure, sensors: int) -> float:
    """Estimate the memory that ``build`` takes, bytes.

    The factors' filling was measured on sheets of 16 to 128 cells a side and 6 to 15 unknowns per place: L
    has about (7.5 log2(side) - 17) entries per unknown and unknown of the position. The sum came out 1.1 to
    1.4 times the memory then measured.
    """
    free_dofs = len(structure.free)
    layers, rows, columns = structure.grid
    positions = float(rows * columns)
    per_position = free_dofs * layers
    filling = max(7.5 * np.log2(positions**0.5) - 17, 7.0)
    factors = 16 * positions * per_position**2 * filling
    elements = 32 * positions * layers * ((4 * free_dofs) ** 2 + (2 * free_dofs) ** 2)
    return factors + elements + 16 * 5 * sensors * (positions * per_position + positions)


Reading = Literal["equation10", "interface"]


@checked("simulator")
class PlatesAndBeams(AbstractSimulator):
    """Layers of Kirchhoff plates on vertical Euler-Bernoulli beams, on a rigid base.

    Each layer consists of beams, one per node, whose section is the part of the sheet nearest to the node,
    and of plates on top of them. Linear: no contact, small strains.

    Convergence is slow. Under a Gaussian touch of 15 mm standard deviation the default 32 x 32 cells give a
    D_s 16 %, a D_t 11 % and a ratio D_s / D_t 5 % smaller than 128 x 128 cells; 64 x 64 are within 5 %. Under
    uniform pressure the edges of the surface deviate from its middle by -11 to +3 % (128 x 128: -1.4 to
    +0.3 %).

    Args:
        body: the sheet.
        sensors: each at an interface between layers, or on the surface.
        reading: ``equation10``, as in the report: the force on the footprint at the surface times D_s / D_t,
            the ratio of the displacements at the sensor and at the surface; zero beside the contact.
            ``interface``: the force that the layer below carries under the footprint; linear, and not zero
            beside the contact.
        constraint: ``vertical``, as in the report: nodes move vertically and rotate. ``free``: nodes move
            along the sheet too, and :meth:`motion` gives the displacements of the sensors.
        cache: folder for computed operators; None: the environment variable SKIN_CACHE, else the user's
            cache.

    Raises:
        InputError: an unknown reading or constraint, a body that is not flat, a sensor at no interface or
            tilted, or a mesh finer than memory allows.

    Attributes:
        operator: the rows D_s, D_t, F_in, the carried force and the motion along x and y in float64, as
            computed. The buffers that pressures are multiplied by are float32 copies of them.
    """

    transfer: Tensor
    along: Tensor

    def __init__(
        self,
        body: AbstractBody,
        sensors: Sensors,
        reading: Reading = "equation10",
        constraint: Constraint = "vertical",
        cache: str | Path | None = None,
    ) -> None:
        super().__init__()
        self.refuse_tilted(sensors)
        self.reading, self.constraint = reading, constraint
        self.shape = body.shape
        self._structure = Structure(body, constraint)
        self.operator: Operator = cached(self._structure, sensors, array_cache.folder(cache))
        force = self.operator.applied if reading == "equation10" else self.operator.carried
        rows = np.concatenate([self.operator.sensor, self.operator.surface, force])
        self.register_buffer("transfer", torch.from_numpy(rows.T.copy()).float())
        moves = np.concatenate([self.operator.along_x, self.operator.along_y, self.operator.sensor])
        self.register_buffer("along", torch.from_numpy(moves.T.copy()).float())

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa, with D_s and D_t as its displacement.

        Raises:
            InputError: shear; only normal forces are supported.
        """
        return self.read(self.linear(pressure, shear))

    def linear(self, loads: Tensor, shear: Tensor | None = None, displacement: bool = False) -> Tensor:
        """Return D_s, D_t and the force that the reading is made of, (..., 3 S)."""
        if shear is not None:
            self.refuse_shear()
        return flatten(loads, self.shape, self.transfer.dtype) @ self.transfer

    def read(self, linear: Tensor) -> Response:
        """Return the response that has these linear parts (..., 3 S)."""
        sensor, surface, force = linear.chunk(3, dim=-1)
        displacement = torch.stack([sensor, surface], dim=-1)
        if self.reading == "interface":
            return Response(force, displacement)
        # Where nothing moves the fraction is 0; dividing by 1 there keeps the gradient finite too. Subnormal
        # motion counts as none: its quotient could overflow.
        moves = surface.abs() > torch.finfo(surface.dtype).tiny
        fraction = torch.where(moves, sensor / torch.where(moves, surface, 1), 0)
        return Response(fraction * force, displacement)

    def strain(self, loads: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the largest compressive strain of the top layer, (U,)."""
        cells = flatten(loads, self.shape, self.transfer.dtype)
        return largest_strain(cells, self._squeeze.to(cells.device))

    @cached_property
    def _squeeze(self) -> Tensor:
        """The compressive strain of the top layer, (1, nodes, cells), 1/Pa."""
        structure = self._structure
        moved = factorised(structure.stiffness()).solve(structure.load().toarray())
        layers, rows, columns = structure.grid
        down = -moved.reshape(layers, rows * columns, len(structure.free), -1)[:, :, structure.free.index(2)]
        below = down[-2] if layers > 1 else 0.0
        return torch.from_numpy((down[-1] - below) / structure.body.layers[-1].thickness)[None].float()

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return the displacement of each sensor along x, along y and into the skin, (..., S, 3), m.

        Raises:
            InputError: nodes are fixed along x and y; or shear.
        """
        if shear is not None:
            self.refuse_shear()
        if self.constraint != "free":
            raise InputError(
                "displacements of sensors along the sheet are fixed at 0 by simulator.constraint="
                f"{self.constraint}: set simulator.constraint=free"
            )
        cells = flatten(pressure, self.shape, self.along.dtype)
        return (cells @ self.along).unflatten(-1, (3, -1)).transpose(-1, -2)
