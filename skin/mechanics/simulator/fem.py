"""The report's finite-element skin: plates and beams (report, 2.1.2), as one linear operator."""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody, Sensors, require_memory
from skin.core.settings import checked
from skin.errors import InputError
from skin.mechanics import array_cache
from skin.mechanics.simulator.base import AbstractSimulator, Response, factorised, flatten, largest_strain
from skin.mechanics.simulator.plates import Constraint, Structure

# Readings as matrices, solved once and kept on disk: the sheet is linear, so a functional s of its motion is
# a fixed row over the cells, s' K^-1 P p = (K^-1 s)' P p. One solve per functional replaces one per frame.

# Raise it when the meaning of a stored file changes.
_FORMAT = 2
_HERE = Path(__file__).parent
_SOURCES = [
    _HERE.parents[1] / "body" / "base.py",
    *(_HERE / name for name in ("base.py", "fem.py", "plates.py")),
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

    def linear(self, loads: Tensor, shear: Tensor | None = None) -> Tensor:
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
