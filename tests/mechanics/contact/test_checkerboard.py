"""The dent of a single cell, against half-spaces averaged over finer cells."""

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.mechanics.contact.rigid import stabilise_checkerboard

from .halfspace import love

BODY = Sheet([0.06, 0.05], [12, 10], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
MATERIAL = BODY.layers[-1].material
MODULUS = MATERIAL.young / (1 - MATERIAL.poisson**2)
BOARD = (np.indices(BODY.shape).sum(axis=0) % 2 * 2.0 - 1).ravel()


def cells(matrix: np.ndarray, fine: int) -> np.ndarray:
    """Return means over BODY's cells of a matrix over cells that are ``fine`` times as small."""
    height, width = BODY.shape
    return matrix.reshape(height, fine, width, fine, height, fine, width, fine).mean((1, 3)).sum((3, 5))


def half_space(fine: int) -> np.ndarray:
    """Return how far cells sink in the mean on a half-space of BODY's top layer."""
    height, width = BODY.shape
    side = BODY.cell[0] / fine
    matrix = cells(love((height * fine, width * fine), (side, side), MODULUS), fine)
    return matrix.reshape(height * width, height * width)


def seen_at_corners(fine: int = 4) -> np.ndarray:
    """Return the half-space as a mesh with nodes at the cells' corners sees it.

    Nodes press and sink over squares about them; a cell presses on its four corners, and moves as they do.
    """
    height, width = BODY.shape
    side = BODY.cell[0] / fine
    nodes = love(((height + 1) * fine, (width + 1) * fine), (side, side), MODULUS)
    shape = height + 1, fine, width + 1, fine
    nodes = nodes.reshape(*shape, *shape).mean((1, 3)).sum((3, 5)).reshape((height + 1) * (width + 1), -1)
    along = [(np.eye(count + 1)[1:] + np.eye(count + 1)[:-1]) / 2 for count in BODY.shape]
    corners = np.kron(*along)
    return corners @ nodes @ corners.T


def test_the_dent_of_a_chessboard_is_that_of_a_half_space():
    """From the spectrum of the half-space, 2 / (E* |k|), over all waves that look so to cells."""
    side, odd = BODY.cell[0], np.arange(-299, 300, 2) * np.pi
    waves = np.hypot(odd, odd[:, None]) / side
    means = np.sinc(odd / (2 * np.pi)) ** 2
    dent = (2 / (MODULUS * waves) * means * means[:, None]).sum()
    added = stabilise_checkerboard(torch.zeros(120, 120, dtype=torch.float64), BODY).numpy()
    middle = 5 * 12 + 6
    assert (added @ BOARD)[middle] * BOARD[middle] == pytest.approx(dent, rel=0.005)
    # The same by brute force: the mean over a cell of 6 x 6 cells in closed form, still a little too deep.
    assert (half_space(6) @ BOARD)[middle] * BOARD[middle] == pytest.approx(dent, rel=0.06)


def test_what_the_mesh_hides_is_put_back():
    """A single cell is too stiff by half; so are short waves. Both come much nearer to the half-space."""
    exact, seen = half_space(4), seen_at_corners()
    grained = stabilise_checkerboard(torch.from_numpy(seen), BODY).numpy()
    assert BOARD @ seen @ BOARD < 0.05 * BOARD @ exact @ BOARD
    short = np.linalg.eigh(exact)[1][:, : len(exact) // 2]
    for part in (short, np.eye(120)[:, 60:61], np.eye(120)):
        before, after = (np.linalg.norm(part.T @ (matrix - exact) @ part) for matrix in (seen, grained))
        assert after < 0.6 * before
