"""Checkerboard stabilisation of the compliance of a mesh that is as coarse as the loaded cells."""

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody

# Smallest eigenvalue of square cells on a half-space, times E / (1 - nu^2) h; its mode is the checkerboard.
_CHECKERBOARD = 0.34


def stabilise_checkerboard(compliance: Tensor, body: AbstractBody) -> Tensor:
    """Return a compliance (N, N), m/Pa, with the stiffness of the top layer under a checkerboard of pressure.

    Where the mesh has nodes at the corners of the loaded cells only, the pressure of a cell acts on its
    corners, and its displacement is their mean. The mesh then filters pressures by S (1/4, 1/2, 1/4 along
    both axes), and a checkerboard of pressure gives no displacement: contact pressures would not be unique.
    This function adds (I - S) times the compliance of a half-space of the top layer's material for the
    checkerboard, less the compliance that the mesh has. Uniform pressure is not affected. A compliance that
    already resolves the checkerboard is returned unchanged.
    """
    height, width = body.shape
    material = body.layers[-1].material
    whole = _CHECKERBOARD * (1 - material.poisson**2) * float(np.sqrt(np.prod(body.cell))) / material.young
    board = torch.from_numpy((np.indices((height, width)).sum(axis=0) % 2 * 2.0 - 1).ravel()).to(compliance)
    lacking = max(0.0, whole - float(board @ compliance @ board) / len(board))
    smooth = torch.kron(_filter(height), _filter(width)).to(compliance)
    return compliance + lacking * (torch.eye(len(board)).to(compliance) - smooth)


def _filter(count: int) -> Tensor:
    """Return the filter (1/4, 1/2, 1/4), (count, count), reflected at both ends; rows sum to 1."""
    rows = torch.eye(count, dtype=torch.float64)
    corners = torch.cat([rows[:1], (rows[1:] + rows[:-1]) / 2, rows[-1:]])
    return (corners[1:] + corners[:-1]) / 2
