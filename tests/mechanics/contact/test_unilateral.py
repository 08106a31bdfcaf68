"""Pressure under rigid objects, against Hertz, Boussinesq, and a general solver of quadratic programs."""

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.mechanics.contact.rigid import solve_contact, stabilise_checkerboard

MODULUS = 200e3
EXTENT = 0.03


def love(shape: tuple[int, int], cell: tuple[float, float], modulus: float) -> np.ndarray:
    """Return how far the middle of each cell sinks under 1 Pa on each cell, (H * W, H * W), m/Pa.

    Love (1929): a rectangle of even pressure on a half-space; ``modulus`` is E / (1 - nu^2), Pa.
    """
    height, width = shape
    x = np.arange(1 - width, width) * cell[0]
    y = np.arange(1 - height, height)[:, None] * cell[1]

    def corner(east: float, south: float) -> np.ndarray:
        u, v = x + east * cell[0] / 2, y + south * cell[1] / 2
        distance = np.hypot(u, v)
        return u * np.log(v + distance) + v * np.log(u + distance)

    kernel = (corner(1, 1) - corner(1, -1) - corner(-1, 1) + corner(-1, -1)) / (np.pi * modulus)
    row, column = (positions.ravel() for positions in np.indices(shape))
    return kernel[row[:, None] - row[None] + height - 1, column[:, None] - column[None] + width - 1]


def pressed(cells: int, gap, force: float):
    """Press an object of the given gap(r) on a half-space, seen through cells x cells over EXTENT.

    Returns the distance of the cells from the axis, the pressure, and how far the object sinks in.
    """
    side = EXTENT / cells
    compliance = torch.from_numpy(love((cells, cells), (side, side), MODULUS))
    middle = (np.arange(cells) + 0.5) * side - EXTENT / 2
    radius = np.hypot(middle, middle[:, None]).ravel()
    gaps = torch.from_numpy(gap(radius))[None]
    state = solve_contact(compliance, gaps, torch.tensor([force / side**2]), tolerance=1e-7)
    assert state.residual <= 1e-7
    pressure = state.pressure[0]
    touched = pressure > 0
    sunk = (compliance @ pressure + gaps[0])[touched].mean().item()
    return radius, pressure.numpy(), sunk


def hertz_errors(cells: int) -> dict[str, float]:
    """Return the relative errors of radius, depth and peak under a ball."""
    ball, force = 0.03, 1.2
    radius = (3 * force * ball / (4 * MODULUS)) ** (1 / 3)
    depth, peak = radius**2 / ball, 3 * force / (2 * np.pi * radius**2)
    assert radius < EXTENT / 2
    _, pressure, sunk = pressed(cells, lambda r: r**2 / (2 * ball), force)
    area = (pressure > 0).sum() * (EXTENT / cells) ** 2
    found = {"radius": np.sqrt(area / np.pi), "depth": sunk, "peak": pressure.max()}
    exact = {"radius": radius, "depth": depth, "peak": peak}
    return {name: abs(found[name] / exact[name] - 1) for name in exact}


def test_a_ball_is_that_of_hertz():
    coarse, fine = hertz_errors(16), hertz_errors(48)
    assert max(coarse.values()) < 0.05
    assert max(fine.values()) < 0.02
    assert fine["depth"] < coarse["depth"]


def problems(count: int = 40, size: int = 12, seed: int = 0):
    """Return a half-space, random gaps, some of them infinite, and totals."""
    rng = np.random.default_rng(seed)
    compliance = love((size, size), (0.005, 0.005), MODULUS)
    gaps = 0.004 * rng.random((count, size**2))
    gaps[rng.random(gaps.shape) < 0.4] = np.inf
    totals = 10 ** rng.uniform(3, 7, count)
    return tuple(torch.from_numpy(values) for values in (compliance, gaps, totals))


def test_the_conditions_of_contact_hold():
    compliance, gaps, totals = problems()
    state = solve_contact(compliance, gaps, totals, tolerance=1e-6)
    assert (state.residual <= 1e-6).all()
    for gap, pressure, total in zip(gaps, state.pressure, totals, strict=True):
        deflection = compliance @ pressure
        touched = pressure > 0
        height = deflection + gap
        approach = height[touched].mean()
        allowed = 1e-6 * deflection.max()
        assert (pressure >= 0).all()
        assert pressure.sum().item() == pytest.approx(total.item(), rel=1e-9)
        assert (pressure[gap.isinf()] == 0).all()
        assert (height[touched] - approach).abs().max() <= allowed
        assert (height[~touched] >= approach - allowed).all()


@pytest.mark.parametrize("touching", [[0], [0, 4], [0, 2, 4, 6]])
def test_cells_that_are_exactly_at_rest_let_others_join(touching):
    """A ring of cells in whole numbers: the errors of the cells in contact are 0, without any rounding."""
    row = torch.tensor([16.0, 6, 2, 1, 0, 1, 2, 6], dtype=torch.float64)
    compliance = torch.stack([row.roll(turn) for turn in range(8)])
    assert torch.linalg.eigvalsh(compliance).min() > 1
    gap = torch.full((1, 8), 4.0, dtype=torch.float64)
    gap[0, touching] = 0
    start = (gap == 0).double()
    for total in (1.0, 4.0, 32.0):
        state = solve_contact(compliance, gap, torch.tensor([total]), start, tolerance=1e-8)
        assert state.residual <= 1e-8
        height = compliance @ state.pressure[0] + gap[0]
        touched = state.pressure[0] > 0
        assert np.ptp(height[touched].numpy()) < 1e-6
        assert height.min() > height[touched].mean() - 1e-6
    assert touched.all()


def test_what_is_not_found_is_told():
    compliance, gaps, totals = problems()
    state = solve_contact(compliance, gaps, totals, tolerance=1e-8, iterations=2)
    assert (state.residual > 1e-8).any()
    assert (state.iterations <= 2).all()
    torch.testing.assert_close(state.pressure.sum(1), totals)


BODY = Sheet([0.06, 0.05], [12, 10], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
MATERIAL = BODY.layers[-1].material
TOP_MODULUS = MATERIAL.young / (1 - MATERIAL.poisson**2)
BOARD = (np.indices(BODY.shape).sum(axis=0) % 2 * 2.0 - 1).ravel()


def cells(matrix: np.ndarray, fine: int) -> np.ndarray:
    """Return means over BODY's cells of a matrix over cells that are ``fine`` times as small."""
    height, width = BODY.shape
    return matrix.reshape(height, fine, width, fine, height, fine, width, fine).mean((1, 3)).sum((3, 5))


def half_space(fine: int) -> np.ndarray:
    """Return how far cells sink in the mean on a half-space of BODY's top layer."""
    height, width = BODY.shape
    side = BODY.cell[0] / fine
    matrix = cells(love((height * fine, width * fine), (side, side), TOP_MODULUS), fine)
    return matrix.reshape(height * width, height * width)


def seen_at_corners(fine: int = 4) -> np.ndarray:
    """Return the half-space as a mesh with nodes at the cells' corners sees it.

    Nodes press and sink over squares about them; a cell presses on its four corners, and moves as they do.
    """
    height, width = BODY.shape
    side = BODY.cell[0] / fine
    nodes = love(((height + 1) * fine, (width + 1) * fine), (side, side), TOP_MODULUS)
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
    dent = (2 / (TOP_MODULUS * waves) * means * means[:, None]).sum()
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
