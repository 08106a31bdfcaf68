"""Largest strains of the top layer, which show whether the linear solution is valid."""

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from skin.mechanics.simulator._hexahedra import Hexahedra
from skin.mechanics.simulator.base import factorised
from skin.mechanics.simulator.plates import Structure

# Components xx, yy, zz, yz, xz, xy, and how often each stands in the tensor.
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
_TIMES = torch.tensor([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
_NUMBERS_AT_ONCE = 2**24


def squeeze(structure: Structure) -> np.ndarray:
    """Return the compressive strain of the top layer of plates and beams, (nodes, cells), 1/Pa."""
    moved = factorised(structure.stiffness()).solve(structure.load().toarray())
    layers, rows, columns = structure.grid
    down = -moved.reshape(layers, rows * columns, len(structure.free), -1)[:, :, structure.free.index(2)]
    below = down[-2] if layers > 1 else 0.0
    return (down[-1] - below) / structure.body.layers[-1].thickness


def solid_rows(mesh: Hexahedra, top: float, refinement: int) -> list[sp.csr_matrix]:
    """Return rows (6 cells, 3 N) of the mean strain of each cell in the upper and the lower half of a layer.

    Args:
        mesh: of the body.
        top: thickness of the uppermost layer, m; a single row of elements has no halves.
        refinement: elements along each side of a cell.
    """
    x, y, z = ((line[1:] + line[:-1]) / 2 for line in mesh.lines)
    along = [
        sp.kron(sp.eye_array(len(line) // refinement), np.full((1, refinement), 1 / refinement))
        for line in (x, y)
    ]
    mean, positions = sp.kron(along[1], along[0]).tocsr(), np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    halves = [half for half in np.array_split(z[z < top], 2) if len(half)]
    return [
        sp.vstack(
            [
                sum(mean @ part for part in parts) / len(half)
                for parts in zip(
                    *(
                        mesh.strain(np.column_stack([positions, np.full(len(positions), depth)]))
                        for depth in half
                    ),
                    strict=True,
                )
            ]
        ).tocsr()
        for half in halves
    ]


def largest(cells: Tensor, rows: Tensor) -> Tensor:
    """Return the largest principal strain by size, (F,), under pressures on the cells (F, cells), Pa.

    Where the strain tensor is largest by its norm; a single component is its own principal strain.

    Args:
        cells: (F, cells), Pa.
        rows: (C, places, cells), 1/Pa, with C = 1, or 6 for xx, yy, zz, yz, xz, xy.
    """
    components, positions, _ = rows.shape
    strains = []
    for part in cells.split(max(1, _NUMBERS_AT_ONCE // (components * positions))):
        strain = (part @ rows.flatten(0, 1).T).unflatten(-1, (components, positions))
        if components == 1:
            strains.append(strain.abs().amax((1, 2)))
            continue
        at = (strain.square() * _TIMES[:, None]).sum(1).argmax(1)
        worst = strain[torch.arange(len(part)), :, at]
        tensor = worst.new_zeros(len(part), 3, 3)
        for value, (i, j) in zip(worst.T, _PAIRS, strict=True):
            tensor[:, i, j] = tensor[:, j, i] = value
        strains.append(torch.linalg.eigvalsh(tensor).abs().amax(1))
    return torch.cat(strains)
