"""Checks of any elastic body: patch test, confined compression, equilibrium, reciprocity."""

from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.validation.blocks import WALLS, block, held, solve_block
from experiments.validation.finding import CheckResult, Finding, relative_finding
from experiments.validation.layered import Slab
from skin.body.arm import Arm
from skin.body.base import AbstractBody
from skin.body.sheet import Sheet
from skin.sensors import Sensors
from skin.simulator._elastic import Elastic
from skin.simulator._hexahedra import Hexahedra
from skin.simulator.solid import hexahedra, reading_rows

# The default skin, from the surface down.
SLABS = (Slab(0.005, 170e3, 0.499), Slab(0.010, 560e3, 0.49))
_LAYERS: Any = tuple(
    {"material": {"name": f"layer {number}", "young": slab.young, "poisson": slab.poisson},
     "thickness": slab.thickness}
    for number, slab in reversed(list(enumerate(SLABS)))
)  # fmt: skip


def skin(cells: int = 16, size: float = 0.16) -> Sheet:
    """Return a square sheet of the default layers."""
    return Sheet((size, size), (cells, cells), _LAYERS)


def stack(divisions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the default layers' lines of depth, m, and E and nu of each row of elements."""
    tops = np.cumsum([0.0, *(slab.thickness for slab in SLABS)])
    lines = [
        top + slab.thickness * np.arange(divisions) / divisions
        for top, slab in zip(tops, SLABS, strict=False)
    ]
    young, ratio = (
        np.repeat([getattr(slab, name) for slab in SLABS], divisions) for name in ("young", "poisson")
    )
    return np.concatenate([*lines, tops[-1:]]), young, ratio


def patch_test(quick: bool) -> CheckResult:
    """Check that a uniform strain on the surface of distorted elements gives the same strain inside."""
    findings = []
    for ratio in (0.3, 0.499):
        x, y, z = (np.sort(np.random.default_rng(seed).random(4 if quick else 6)) for seed in range(3))
        count = len(z) - 1
        mesh = Hexahedra((x, y, z), np.full((count,) * 3, 2e5), np.full(count, ratio), _bent, _axes)
        strain = np.array([[1.0, 0.3, -0.2], [0.3, -0.4, 0.5], [-0.2, 0.5, 0.7]]) * 1e-3
        exact = (mesh.nodes @ strain).ravel()
        faces = dict.fromkeys(("left", "right", "near", "far", "base", "top"), (0, 1, 2))
        fixed = held(mesh, faces)
        given = np.where(fixed, exact, 0)
        moved = given + solve_block(mesh, fixed, -(mesh.stiffness() @ given)[:, None])[:, 0]
        error = np.abs(moved - exact).max() / np.abs(exact).max()
        findings.append(Finding(f"motion inside, nu = {ratio}", error, 0, error, 1e-10))
        error = _stress_error(mesh, moved, strain)
        findings.append(Finding(f"stress, nu = {ratio}", error, 0, error, 1e-10))
    return CheckResult(findings)


def confined_compression(quick: bool) -> CheckResult:
    """Check that between smooth walls a uniform pressure p compresses each layer by p h / (lambda + 2 G)."""
    line = np.linspace(0, 0.02, 3 if quick else 5)
    depth, young, ratio = stack(2)
    mesh = block((line, line, depth), young, ratio)
    load = mesh.loads(2).sum(axis=1)
    moved = solve_block(mesh, held(mesh, WALLS), np.asarray(load).reshape(-1, 1))[:, 0]
    top = -moved.reshape(-1, 3)[0, 2]
    exact = sum(slab.thickness / slab.confined for slab in SLABS)
    points = np.array([[0.011, 0.007, z] for z in (0.0, 0.002, 0.005, 0.012)])
    down = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    stress = mesh.stress(points, down) @ moved
    worst = stress[np.abs(stress + 1).argmax()]
    return CheckResult(
        [
            relative_finding("motion of the surface, m/Pa", top, exact, 1e-8),
            relative_finding("sigma_zz / p", worst, -1, 1e-8),
        ]
    )


def even_pressure(quick: bool) -> CheckResult:
    """Check that far from free edges a uniform pressure p gives sigma_zz = -p at every depth."""
    body = skin(16 if quick else 24, 0.24)
    depths = (0.0025, 0.005, 0.012)
    sensors = Sensors(np.array([[0.12, 0.12, depth] for depth in depths]), (0.01, 0.01))
    mesh = hexahedra(body, 2, {})
    felt = Elastic(mesh).transfer(reading_rows(mesh, sensors), (2,))[0].sum(axis=1) / 1e-4
    return CheckResult(
        [
            relative_finding(f"reading / p A, {1e3 * depth:g} mm deep", one, 1, 2e-3)
            for depth, one in zip(depths, felt, strict=True)
        ]
    )


def global_balance(quick: bool) -> CheckResult:
    """Check that the reactions of the support balance the applied force and moment."""
    findings = []
    for name, body in _bodies(quick):
        mesh = hexahedra(body, 2, {})
        cells = np.random.default_rng(0).random(body.cells[0] * body.cells[1])
        load = sum(share * (mesh.loads(axis) @ cells) for axis, share in enumerate((0.4, -0.3, 1.0)))
        moved = Elastic(mesh).solve(load[:, None])[:, 0]
        table = np.where(mesh.held, mesh.stiffness() @ moved, 0)
        for kind, of in (("force", _force), ("moment", _moment)):
            applied, answered = of(mesh, load), of(mesh, table)
            error = np.abs(applied + answered).max() / np.abs(applied).max()
            ours, reference = (float(np.linalg.norm(value)) for value in (answered, applied))
            findings.append(Finding(f"{kind}, {name}", ours, reference, float(error), 1e-8))
    return CheckResult(findings)


def reciprocity(quick: bool) -> CheckResult:
    """Check reciprocity (Maxwell and Betti): two loads do the same work on each other's displacements."""
    findings = []
    for name, body in _bodies(quick):
        mesh = hexahedra(body, 2, {})
        random = np.random.default_rng(1).random((3, 2, body.cells[0] * body.cells[1]))
        loads = sum(mesh.loads(axis) @ random[axis].T for axis in range(3))
        moves = Elastic(mesh).solve(loads)
        there, back = loads[:, 0] @ moves[:, 1], loads[:, 1] @ moves[:, 0]
        findings.append(relative_finding(f"work, J, {name}", there, back, 1e-8))
    return CheckResult(findings)


def wide_arm(quick: bool) -> CheckResult:
    """Check that a sleeve approaches a sheet as its radius grows."""
    sheet = skin(8 if quick else 16)
    place = np.array([[0.07, 0.09, 0.005], [0.03, 0.12, 0.003], [0.11, 0.05, 0.005]])
    lean = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
    sensors = Sensors(place, (0.02, 0.02), lean)
    flat = _rows(sheet, sensors)
    findings = []
    for radius, tolerance in ((1e2, 1e-3), (1e4, 1e-5)):
        rows = _rows(_sleeve(radius, sheet), sensors)
        error = np.abs(rows - flat).max() / np.abs(flat).max()
        case = f"readings of every cell and direction, radius {radius:g} m"
        findings.append(Finding(case, np.abs(rows).max(), np.abs(flat).max(), error, tolerance))
    return CheckResult(findings)


def sleeve(quick: bool) -> CheckResult:
    """Compare a sleeve on a rigid core under uniform pressure with Lame's tube (u = A r + B / r)."""
    core, middle, outer = 0.035, 0.045, 0.05
    soft, hard = SLABS
    inner, upper = (_tube(slab) for slab in (hard, soft))
    system = np.zeros((4, 4))
    system[0, :2] = inner(core)[0]
    system[1, :2], system[1, 2:] = inner(middle)[0], -upper(middle)[0]
    system[2, :2], system[2, 2:] = inner(middle)[1], -upper(middle)[1]
    system[3, 2:] = upper(outer)[1]
    amounts = np.linalg.solve(system / np.abs(system).max(axis=1, keepdims=True),
                              [0, 0, 0, -1 / np.abs(system[3]).max()])  # fmt: skip
    surface, between = upper(outer)[0] @ amounts[2:], upper(middle)[1] @ amounts[2:]
    around = 32 if quick else 96
    body = Arm(cells=(around, 2), layers=_LAYERS, radius=outer, length=0.01, angle=np.pi)
    mesh = hexahedra(body, 2 if quick else 4, {})
    # Symmetry planes close the half tube: no vertical motion there, and no motion along the arm anywhere.
    walls = {"left": (2,), "right": (2,), "near": (1,), "far": (1,), "base": (0, 1, 2)}
    load = np.asarray(mesh.loads(2).sum(axis=1)).reshape(-1, 1)
    moved = solve_block(mesh, held(mesh, walls), load)[:, 0]
    top = np.array([[body.size[0] / 2, 0.005, 0.0]])
    down = np.array([[0.0, 0.0, 1.0]])
    sensor = Sensors(top + np.array([0, 0, 0.005]), (0.01, 0.01))
    return CheckResult(
        [
            relative_finding(
                "motion of the surface, m/Pa", (mesh.motion(top, down) @ moved)[0], -surface, 0.02
            ),
            relative_finding(
                "reading at the interface / p A",
                (reading_rows(mesh, sensor) @ moved)[0] / 1e-4,
                -between,
                0.01,
            ),
        ]
    )


def _tube(slab: Slab) -> Callable[[float], np.ndarray]:
    """Return a map from a radius to radial displacement and stress per A and B of u = A r + B / r, (2, 2)."""
    lam = slab.confined - 2 * slab.shear
    return lambda r: np.array([[r, 1 / r], [2 * (lam + slab.shear), -2 * slab.shear / r**2]])


def _sleeve(radius: float, sheet: Sheet) -> Arm:
    angle = sheet.size[0] / radius
    return Arm(cells=sheet.cells, layers=sheet.layers, radius=radius, length=sheet.size[1], angle=angle)


def _rows(body: AbstractBody, sensors: Sensors) -> np.ndarray:
    mesh = hexahedra(body, 2, {})
    return Elastic(mesh).transfer(reading_rows(mesh, sensors))


def _bodies(quick: bool) -> list[tuple[str, AbstractBody]]:
    sheet = skin(8 if quick else 16)
    return [("sheet", sheet), ("arm", _sleeve(0.05, sheet))]


def _force(mesh: Hexahedra, load: np.ndarray) -> np.ndarray:
    return load.reshape(-1, 3).sum(axis=0)


def _moment(mesh: Hexahedra, load: np.ndarray) -> np.ndarray:
    return np.cross(mesh.nodes, load.reshape(-1, 3)).sum(axis=0)


def _bent(points: np.ndarray) -> np.ndarray:
    """Map points by a smooth, non-linear function, so that no element stays a box."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x + 0.2 * y * x, y + 0.1 * x * x - 0.1 * z, -z + 0.3 * x * z], axis=-1)


def _axes(points: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))


def _stress_error(mesh: Hexahedra, moved: np.ndarray, strain: np.ndarray) -> float:
    """Return the largest error of the stress at random places, relative to the largest component."""
    lam, mu = mesh.lame[0][0], mesh.lame[1][0]
    exact = lam * np.trace(strain) * np.eye(3) + 2 * mu * strain
    rng = np.random.default_rng(3)
    ends = np.array([[line[0], line[-1]] for line in mesh.lines])
    places = rng.uniform(ends[:, 0], ends[:, 1], (20, 3))
    n, m = rng.normal(size=(2, 20, 3))
    expected = np.einsum("pi,ij,pj->p", n, exact, m)
    return float(np.abs(mesh.stress(places, n, m) @ moved - expected).max() / np.abs(expected).max())
