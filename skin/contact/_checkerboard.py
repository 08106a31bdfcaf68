"""The local dent under a single loaded cell, which a mesh as coarse as the cells cannot resolve."""

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody

# Lowest eigenvalue of square cells on a half-space (that of the chessboard pattern), times E / (1 - nu^2) h.
_CHESSBOARD = 0.34


def stabilise_checkerboard(compliance: Tensor, body: AbstractBody) -> Tensor:
    """Return a compliance (N, N), m/Pa, that answers a chessboard of pressure as the top layer would.

    Where the surface is interpolated between the corners of the very cells that are loaded, each cell's
    pressure acts on the corners and its motion is their mean. So the mesh sees pressures through a filter S
    (1/4, 1/2, 1/4 along both axes), and a chessboard makes it no dent at all: pressures under an object would
    be undetermined. What the filter hides is put back as (I - S) times the chessboard's compliance on a
    half-space of the top layer's material, less what the mesh does show. Even pressure gets nothing added,
    and a compliance that lacks nothing is returned unchanged.
    """
    height, width = body.shape
    material = body.layers[-1].material
    whole = _CHESSBOARD * (1 - material.poisson**2) * float(np.sqrt(np.prod(body.cell))) / material.young
    board = torch.from_numpy((np.indices((height, width)).sum(axis=0) % 2 * 2.0 - 1).ravel()).to(compliance)
    lacking = max(0.0, whole - float(board @ compliance @ board) / len(board))
    smooth = torch.kron(_filter(height), _filter(width)).to(compliance)
    return compliance + lacking * (torch.eye(len(board)).to(compliance) - smooth)


def _filter(count: int) -> Tensor:
    """Return the mean of means of neighbours, (count, count), reflected at both ends: rows sum to 1."""
    rows = torch.eye(count, dtype=torch.float64)
    corners = torch.cat([rows[:1], (rows[1:] + rows[:-1]) / 2, rows[-1:]])
    return (corners[1:] + corners[:-1]) / 2
