"""Pressure under rigid objects, against Hertz, Boussinesq, and a general solver of quadratic programs."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from skin.mechanics.contact.rigid import solve_contact

from .halfspace import love

MODULUS = 200e3
EXTENT = 0.03


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


def test_a_general_solver_finds_the_same():
    compliance, gaps, totals = (values.numpy() for values in problems(count=4, size=5))
    state = solve_contact(*problems(count=4, size=5), tolerance=1e-9)
    for gap, total, pressure in zip(gaps, totals, state.pressure.numpy(), strict=True):
        free = np.isfinite(gap)
        small, own = compliance[np.ix_(free, free)], gap[free]
        unit = total * small.max()  # energies of order 1: the solver's tolerances are absolute
        found = minimize(
            lambda x, c=small, g=own, t=total, u=unit: (t * x @ c @ x / 2 + g @ x) / u,
            np.full(free.sum(), 1 / free.sum()),
            jac=lambda x, c=small, g=own, t=total, u=unit: (t * c @ x + g) / u,
            bounds=[(0, None)] * int(free.sum()),
            constraints={"type": "eq", "fun": lambda x: x.sum() - 1, "jac": np.ones_like},
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 2000},
        )
        np.testing.assert_allclose(pressure[free] / total, found.x, atol=2e-5)


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
