"""What a sheet's sensors see of a pressure on it, as matrices: solved once, then kept on disk.

The sheet is linear, so every functional s of its motion is a fixed row over the cells: s' K^-1 P p = (K^-1
s)' P p. One factorisation and one solve per functional replace one solve per frame.
"""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from skin import array_cache
from skin.body._memory import require_memory
from skin.sensors import Sensors
from skin.simulator._assembly import Structure
from skin.simulator._factors import factorised

# Raise it when the meaning of a stored file changes.
_FORMAT = 2
_HERE = Path(__file__).parent
_SOURCES = [
    _HERE.parent / "body" / "base.py",
    *(_HERE / name for name in ("_assembly.py", "_beam.py", "_factors.py", "_operator.py", "_plate.py")),
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
        "moduli": hashlib.sha256(body.moduli.tobytes()).hexdigest(),
        "constraint": structure.constraint,
        "positions": sensors.positions.tolist(),
        "footprint": sensors.footprint,
    }
    key = array_cache.hashed(content, _SOURCES)
    shape = (len(sensors), body.cells[0] * body.cells[1])
    shapes = {field.name: shape for field in fields(Operator)}
    path = folder / f"operator-{key}.npz"
    return Operator(**array_cache.kept(path, key, shapes, lambda: vars(build(structure, sensors))))


def _bytes(structure: Structure, sensors: int) -> float:
    """Estimate the memory that ``build`` takes, bytes.

    The factors' filling was measured on sheets of 16 to 128 cells a side and 6 to 15 unknowns per place: L
    has about (7.5 log2(side) - 17) entries per unknown and unknown of the place. The sum came out 1.1 to 1.4
    times the memory then measured.
    """
    free_dofs = len(structure.free)
    layers, rows, columns = structure.grid
    places = float(rows * columns)
    per_place = free_dofs * layers
    filling = max(7.5 * np.log2(places**0.5) - 17, 7.0)
    factors = 16 * places * per_place**2 * filling
    elements = 32 * places * layers * ((4 * free_dofs) ** 2 + (2 * free_dofs) ** 2)
    return factors + elements + 16 * 5 * sensors * (places * per_place + places)
