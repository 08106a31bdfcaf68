"""A rigid sphere on a bonded layer, as scikit-fem solves it in cylindrical coordinates."""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import brentq
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad1, ElementQuad2, ElementVector, LinearForm, MeshQuad
from skfem.helpers import grad

from skin import Grid, Sheet, Solid
from skin.robot.mujoco_skin import Press, Pressing

THICKNESS, YOUNG, POISSON, EXTENT = 0.03, 170e3, 0.499, 0.0339
LAYER = [{"material": "EcoFlex 00-30", "thickness": THICKNESS}]
CELLS = 24  # of 2.5 mm; the reference is a cylinder of the same area


class Indentation(NamedTuple):
    """A contact: radii of surface nodes and the pressure there (n,), m and Pa, force, N, and edge, m."""

    radii: np.ndarray
    pressure: np.ndarray
    force: float
    edge: float


def indent(sphere: float, approach: float) -> Indentation:
    """Press a sphere into a layer without friction: Taylor-Hood elements, an active set of surface nodes."""
    r = np.concatenate([np.linspace(0, 0.024, 49), np.geomspace(0.0248, EXTENT, 24)])
    z = -THICKNESS * (1 - np.linspace(1, 0, 25) ** 1.5)
    mesh = MeshQuad.init_tensor(r, np.sort(z))
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=4)
    squeeze = basis.with_element(ElementQuad1())
    shear, bulk = YOUNG / 2 / (1 + POISSON), YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON)

    def strains(u, w):
        g = grad(u)
        return g[0, 0], g[1, 1], u[0] / w.x[0], (g[0, 1] + g[1, 0]) / np.sqrt(2)

    def work(u, v, w):
        return 2 * shear * sum(a * b for a, b in zip(strains(u, w), strains(v, w), strict=True)) * w.x[0]

    elastic = BilinearForm(work).assemble(basis)
    grown = BilinearForm(lambda u, q, w: sum(strains(u, w)[:3]) * q * w.x[0]).assemble(basis, squeeze)
    squeezed = BilinearForm(lambda p, q, w: p * q / bulk * w.x[0]).assemble(squeeze)
    whole = (2 * np.pi * sp.block_array([[elastic, grown.T], [grown, -squeezed]])).tocsc()

    fixed = np.concatenate([
        basis.get_dofs(lambda x: np.abs(x[1] + THICKNESS) < 1e-9).all(),
        basis.get_dofs(lambda x: x[0] < 1e-9).all(["u^1"]),
    ])  # fmt: skip
    top = basis.get_dofs(lambda x: np.abs(x[1]) < 1e-9).all(["u^2"])
    radii = basis.doflocs[0, top]
    top, radii = top[np.argsort(radii)], np.sort(radii)
    wanted = sphere - np.sqrt(np.maximum(sphere**2 - radii**2, 0)) - approach  # u_z under the sphere
    facets = basis.mesh.facets_satisfying(lambda x: np.abs(x[1]) < 1e-9)
    share = LinearForm(lambda v, w: 2 * np.pi * v[1] * w.x[0]).assemble(basis.boundary(facets))[top]
    active = (wanted < 0) & (radii < 0.7 * np.sqrt(2 * sphere * approach))
    for _ in range(40):
        solution = np.zeros(whole.shape[0])
        solution[top[active]] = wanted[active]
        held = np.union1d(fixed, top[active])
        free = np.setdiff1d(np.arange(len(solution)), held)
        factors, right = splu(whole[free][:, free]), -(whole @ solution)[free]
        solution[free] = factors.solve(right)
        solution[free] += factors.solve(right - whole[free][:, free] @ solution[free])
        reaction = -(whole @ solution)[top]
        after = np.where(active, reaction > 0, solution[top] > wanted)
        if (after == active).all():
            break
        active = after
    pressure = np.where(active, reaction / share, 0)
    return Indentation(radii, pressure, float(reaction[active].sum()), float(radii[active].max()))


@pytest.fixture(scope="module")
def pressing() -> Pressing:
    body = Sheet((0.06, 0.06), (CELLS, CELLS), LAYER)
    return Pressing(Solid(body, Grid(2, 2, depth=0.0295).sensors(body)), body)


@pytest.mark.slow("the compliance of 576 cells, and contacts that are solved by finite elements")
@pytest.mark.parametrize(
    ("sphere", "approach", "off"), [(0.04, 0.003, 0.0), (0.02, 0.002, 0.0), (0.02, 0.004, 0.00125)]
)
def test_a_sphere_sinks_in_as_scikit_fem_says(pressing, sphere, approach, off):
    """Force at equal approach within 5 %, radius and pressure over 5 mm within 10 % (of its peak)."""
    reference, side = indent(sphere, approach), 0.0025
    x = (np.arange(CELLS) + 0.5) * side - 0.03 - off
    squares = np.add.outer(x**2, x**2).ravel()
    gap = np.where(squares < sphere**2, sphere - np.sqrt(np.maximum(sphere**2 - squares, 0)), np.inf)
    compliance = pressing.compliance.double().numpy()

    def press(force: float) -> tuple[float, np.ndarray]:
        """Return how far the sphere sinks in, m, and the pressure, Pa."""
        found = pressing.pressures([Press(gap - gap.min(), np.array([0, 0, force]))])[0]
        pressure = found.flatten().double().numpy()
        return float((compliance @ pressure + gap)[pressure > 0].mean()), pressure

    bracket = 0.5 * reference.force, 2 * reference.force
    force = brentq(lambda newtons: press(newtons)[0] - approach, *bracket, rtol=1e-3)
    pressure = press(force)[1]
    assert force == pytest.approx(reference.force, rel=0.05)
    # As of Hertz' pressure, whose mean r^2 is 2 a^2 / 5.
    assert np.sqrt(2.5 * (pressure @ squares) / pressure.sum()) == pytest.approx(reference.edge, rel=0.1)

    inside = (np.arange(20) + 0.5) / 20 * side - side / 2
    radii = np.hypot.outer(np.add.outer(x, inside).ravel(), np.add.outer(x, inside).ravel())
    exact = np.interp(radii, reference.radii[1:], reference.pressure[1:], right=0)
    ours, theirs = over_5_mm(pressure.reshape(CELLS, CELLS)), over_5_mm(exact)
    assert np.abs(ours - theirs).max() < 0.1 * theirs.max()


def over_5_mm(pressure: np.ndarray) -> np.ndarray:
    """Return the mean pressure over squares of 5 mm, (12, 12)."""
    step = len(pressure) // 12
    return pressure.reshape(12, step, 12, step).mean(axis=(1, 3))
