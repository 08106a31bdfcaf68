"""Laws of the solid: any elastic body, layers bonded to a rigid base, and a thick soft block."""

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from experiments.laws.conftest import Law
from experiments.laws.references import (
    ALL,
    SQUARE_PUNCH,
    WALLS,
    Discs,
    HalfSpace,
    Slab,
    block,
    bonded_layer,
    graded,
    held,
    solve_block,
)
from skin.body.arm import Arm
from skin.body.base import AbstractBody, Sensors
from skin.body.sheet import Sheet
from skin.mechanics.contact.rigid import solve_contact as press
from skin.mechanics.contact.rigid import stabilise_checkerboard
from skin.mechanics.geometry import reading_rows
from skin.mechanics.simulator._mesh import Hexahedra, build_mesh, build_meshes
from skin.mechanics.simulator.solid import Elastic
from skin.touch.shapes import Shapes

# The default skin, from the surface down.
SLABS = (Slab(0.005, 170e3, 0.499), Slab(0.010, 560e3, 0.49))


def layers_of(slabs: Sequence[Slab]) -> Any:
    """Return slabs as the layers of a body."""
    return tuple(
        {"material": {"name": f"layer {number}", "young": slab.young, "poisson": slab.poisson},
         "thickness": slab.thickness}
        for number, slab in reversed(list(enumerate(slabs)))
    )  # fmt: skip


def default_sheet(cells: int, size: float = 0.16) -> Sheet:
    """Return a square sheet of the default layers."""
    return Sheet((size, size), (cells, cells), layers_of(SLABS))


def test_patch(law: Law) -> None:
    """A uniform strain prescribed on the surface of distorted elements gives the same strain inside.

    Reference: linear algebra.
    """
    for ratio in (0.3, 0.499):
        x, y, z = (np.sort(np.random.default_rng(seed).random(6 if law.full else 4)) for seed in range(3))
        count = len(z) - 1
        mesh = Hexahedra((x, y, z), np.full(count, 2e5), np.full(count, ratio), _distort, _axes)
        strain = np.array([[1.0, 0.3, -0.2], [0.3, -0.4, 0.5], [-0.2, 0.5, 0.7]]) * 1e-3
        exact = (mesh.nodes @ strain).ravel()
        fixed = held(mesh, dict.fromkeys(("left", "right", "near", "far", "base", "top"), ALL))
        prescribed = np.where(fixed, exact, 0)
        moved = prescribed + solve_block(mesh, fixed, -(mesh.stiffness() @ prescribed)[:, None])[:, 0]
        error = np.abs(moved - exact).max() / np.abs(exact).max()
        law.compare(f"motion inside, nu = {ratio}", error, 0, 1e-10)
        law.compare(f"stress, nu = {ratio}", _stress_error(mesh, moved, strain), 0, 1e-10)


def _distort(points: np.ndarray) -> np.ndarray:
    """Map points by a smooth, non-linear function, so that no element stays a box."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x + 0.2 * y * x, y + 0.1 * x * x - 0.1 * z, -z + 0.3 * x * z], axis=-1)


def _axes(points: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))


def _stress_error(mesh: Hexahedra, moved: np.ndarray, strain: np.ndarray) -> float:
    """Return the largest error of the stress at random points, relative to the largest component."""
    lam, mu = mesh.lame[0][0], mesh.lame[1][0]
    exact = lam * np.trace(strain) * np.eye(3) + 2 * mu * strain
    rng = np.random.default_rng(3)
    ends = np.array([[line[0], line[-1]] for line in mesh.lines])
    points = rng.uniform(ends[:, 0], ends[:, 1], (20, 3))
    n, m = rng.normal(size=(2, 20, 3))
    expected = np.einsum("pi,ij,pj->p", n, exact, m)
    return float(np.abs(mesh.stress(points, n, m) @ moved - expected).max() / np.abs(expected).max())


def test_confined(law: Law) -> None:
    """Between smooth walls a uniform pressure p compresses each layer by p h / (lambda + 2 G).

    Reference: closed form.
    """
    line = np.linspace(0, 0.02, 5 if law.full else 3)
    # Two rows of elements in each layer.
    depth = np.array([0.0, 0.0025, 0.005, 0.01, 0.015])
    young, ratio = (np.repeat([getattr(slab, name) for slab in SLABS], 2) for name in ("young", "poisson"))
    mesh = block((line, line, depth), young, ratio)
    load = mesh.loads(2).sum(axis=1)
    moved = solve_block(mesh, held(mesh, WALLS), np.asarray(load).reshape(-1, 1))[:, 0]
    exact = sum(slab.thickness / slab.confined for slab in SLABS)
    points = np.array([[0.011, 0.007, z] for z in (0.0, 0.002, 0.005, 0.012)])
    stress = mesh.stress(points, np.tile([0.0, 0.0, 1.0], (len(points), 1))) @ moved
    law.compare("motion of the surface, m/Pa", -moved.reshape(-1, 3)[0, 2], exact, 1e-8)
    law.compare("sigma_zz / p", stress[np.abs(stress + 1).argmax()], -1, 1e-8)


def test_even(law: Law) -> None:
    """In the middle of a wide sheet a uniform pressure p gives sigma_zz = -p at every depth.

    Reference: equilibrium.
    """
    depths = (0.0025, 0.005, 0.012)
    sensors = Sensors(np.array([[0.12, 0.12, depth] for depth in depths]), (0.01, 0.01))
    mesh = build_mesh(default_sheet(24 if law.full else 16, 0.24), 2, {}, 2)
    readings = Elastic(mesh, 2).transfer(reading_rows(mesh, sensors), (2,))[0].sum(axis=1) / 1e-4
    for depth, reading in zip(depths, readings, strict=True):
        law.compare(f"reading / p A, {1e3 * depth:g} mm deep", reading, 1, 2e-3)


def test_convergence(law: Law) -> None:
    """Halving the element size divides the displacement error by four.

    Reference: closed form of the bonded layer.
    """
    counts = (4, 8, 16, 32) if law.full else (4, 8, 16)
    for ratio in (0.3, 0.499):
        slab = Slab(0.01, 170e3, ratio)
        exact = bonded_layer(100.0, slab)
        errors = [abs(_wave(100.0, slab, count, count) / exact - 1) for count in counts]
        order = float(np.log2(errors[-2] / errors[-1]))
        law.compare(f"order, nu = {ratio}", order, 2, 0.2, abs(order - 2))


def test_layer(law: Law) -> None:
    """The compliance of a thin, nearly incompressible bonded layer is correct for all wavelengths.

    Reference: closed form (Aleksandrov and Vorovich).
    """
    slab = Slab(0.005, 170e3, 0.499)
    for length in [1.0, 2.0, 4.0, 8.0, 16.0, 32.0] if law.full else [2.0, 8.0]:
        number = 2 * np.pi / (length * slab.thickness)
        case = f"compliance, m/Pa, wave of {length:g} thicknesses"
        law.compare(case, _wave(number, slab, 16, 8), bonded_layer(number, slab), 0.02)


def test_locking(law: Law) -> None:
    """The error does not grow when nu rises from 0.45 to 0.4999.

    Reference: the same closed form.
    """
    ratios = 0.45, 0.49, 0.499, 0.4999
    for rows in (4, 8) if law.full else (4,):
        errors = []
        for ratio in ratios:
            slab = Slab(0.01, 170e3, ratio)
            ours, exact = _wave(100.0, slab, 2 * rows, rows), bonded_layer(100.0, slab)
            errors.append(ours / exact - 1)
            law.compare(f"compliance, m/Pa, nu = {ratio}, {rows} rows", ours, exact, 0.01)
        case = f"change of the error from nu = {ratios[-2]} to {ratios[-1]}, {rows} rows"
        law.compare(case, errors[-1], errors[-2], 1e-3, abs(errors[-1] - errors[-2]))


def _wave(number: float, slab: Slab, columns: int, rows: int) -> float:
    """Return the elements' surface motion per pressure under half a wave between smooth walls, m/Pa."""
    x = np.linspace(0, np.pi / number, columns + 1)
    mesh = block((x, x[:2].copy(), np.linspace(0, slab.thickness, rows + 1)), slab.young, slab.poisson)
    pressure = np.diff(np.sin(number * x)) / (number * np.diff(x))  # a cell's mean
    moved = solve_block(mesh, held(mesh, WALLS), (mesh.loads(2) @ pressure)[:, None])[:, 0]
    top = -moved.reshape(rows + 1, 2, columns + 1, 3)[0, 0, :, 2]
    return float(2 * number / np.pi * np.trapezoid(top * np.cos(number * x), x))


FOOTPRINT = (0.01, 0.01)  # m, of the default sensors
_RADII = (0.005, 0.008, 0.02)  # m, of discs: smaller, as large and larger than a fingertip
_BESIDE = np.array([[0.0, 0.0], [0.0025, 0.0], [0.008, 0.0], [0.016, 0.0]])  # m, from the sensor to the disc


def test_layered(law: Law) -> None:
    """The default skin, and skins of one and two layers up to 40 mm thick, read discs as small as a \
    fingertip wherever these press and wherever the sensors are.

    Reference: Hankel integral of exact waves of all layers.
    """
    random = np.random.default_rng(0)
    for number in range(30 if law.full else 3):
        slabs, depth = _draw_slabs(random, 0.04 if law.full else 0.01) if number else (SLABS, 0.005)
        thickness = sum(slab.thickness for slab in slabs)
        # Of 5 mm, and so many that the rim does not change the readings in the middle.
        cells = 2 * math.ceil(max(0.06 if law.full else 0.04, 2 * thickness) / 0.005)
        body = Sheet((0.005 * cells,) * 2, (cells, cells), layers_of(slabs))
        # The sensors have different positions within a cell.
        inside = np.array([[0, 0], [2.5, 2.5], [2.5, 0], [1.2, -1.3], [-0.8, 1.9]]) * 1e-3
        positions = np.column_stack([body.size[0] / 2 + inside, np.full(len(inside), depth)])
        exact = exact_readings(slabs, depth)
        ours = disc_readings_of(body, Sensors(positions, FOOTPRINT))
        errors = np.abs(ours - exact[:, None]) / exact[:, None, :1]
        radius, sensor, beside = map(int, np.unravel_index(errors.argmax(), errors.shape))
        layers = " on ".join(f"{1e3 * slab.thickness:.1f} mm of {slab.young / 1e3:.0f} kPa" for slab in slabs)
        case = f"{layers}, {1e3 * depth:.1f} mm deep, radius {1e3 * _RADII[radius]:g} mm, reading / p, m^2"
        tolerance = 0.015 if depth >= 0.005 else 0.05
        law.compare(case, ours[radius, sensor, beside], exact[radius, beside], tolerance, errors.max())
    law.remarks.append(
        "the largest error up to 16 mm beside the sensor, of the reading above it; sensors less deep than a "
        "cell, 5 mm, err by up to 5 %"
    )


def exact_readings(slabs: Sequence[Slab], depth: float) -> np.ndarray:
    """Return readings per pressure of a sensor at a depth, m, under discs beside it, (radii, positions)."""
    discs = np.array([[*position, radius] for radius in _RADII for position in _BESIDE])
    table = Discs(slabs, depth, (_RADII[0], _RADII[-1]))
    return table.forces(discs, np.zeros((1, 2)), FOOTPRINT[0]).reshape(len(_RADII), len(_BESIDE))


def disc_readings_of(body: Sheet, sensors: Sensors) -> np.ndarray:
    """Return readings per pressure under discs beside sensors, (radii, S, positions), m^2."""
    operator = sum(
        weight * Elastic(mesh, refinement).transfer(reading_rows(mesh, sensors), (2,))[0]
        for weight, mesh, refinement in build_meshes(body, sensors, None, {}, 2)
    )
    shapes = Shapes(("disc",), body, fine=True)
    spread = np.sqrt(4 * float(shapes.levels[0].double().mean()) / np.pi)  # radius over scale
    at = (sensors.positions[:, None, :2] + _BESIDE).reshape(-1, 2)
    turn, readings = np.zeros(len(at)), []
    for radius in _RADII:
        moments = shapes.press(turn.astype(int), turn, turn + radius / spread, at)[0].flatten(1).double()
        every = (moments.numpy() @ operator.T).reshape(len(sensors), len(_BESIDE), -1)
        readings.append(every.diagonal(axis1=0, axis2=2).T * np.pi * radius**2 / np.prod(body.cell))
    return np.stack(readings)


def _draw_slabs(random: np.random.Generator, maximum: float) -> tuple[Sequence[Slab], float]:
    """Return one or two layers, together at most so thick, m, and the depth of sensors."""
    thickness, fraction = random.uniform(0.005, maximum), random.uniform(0.2, 0.8)
    ratio = 20 ** random.uniform(-1, 1)
    depth, poisson = random.uniform(0.002, thickness - 0.0005), random.uniform(0.45, 0.499)
    if min(fraction, 1 - fraction) * thickness < 0.003 or random.random() < 0.5:
        return [Slab(thickness, 1e5, poisson)], depth
    top = Slab(fraction * thickness, 1e5, poisson)
    return [top, Slab((1 - fraction) * thickness, 1e5 * ratio, 0.49)], depth


_YOUNG, _RATIO, _HALF = 170e3, 0.45, 0.01  # Pa, nu of the block, and half of the side of the square, m
_STAR = _YOUNG / (1 - _RATIO**2)
# A quarter of the block is solved: two faces are symmetry planes, or antisymmetric under forces along x.
_MIRRORED = {"left": (0,), "near": (1,), "base": ALL}
_OPPOSED = {"left": (1, 2), "near": (1,), "base": ALL}


@pytest.mark.slow("solves a block for seconds")
def test_boussinesq(law: Law) -> None:
    """Pressure on a thick soft block: displacement and stress below and beside the load.

    Reference: Boussinesq, integrated over the square.
    """
    _compare_forces(law, 2, "under_pressure", ("down", 2), _MIRRORED)


@pytest.mark.slow("solves a block for seconds")
def test_cerruti(law: Law) -> None:
    """Tangential traction on a thick soft block: displacement and stress.

    Reference: Cerruti, integrated over the square.
    """
    _compare_forces(law, 0, "under_shear", ("along x", 0), _OPPOSED)


def _compare_forces(law: Law, axis: int, kind: str, main: tuple[str, int], faces: dict) -> None:
    """Compare displacements, and stresses on planes parallel to the surface, below and beside the square."""
    count = 6 if law.full else 4
    line = graded(_HALF / count, count + count // 2, 60 * _HALF, 1.6)
    mesh, middles = block((line, line, line), _YOUNG, _RATIO), (line[1:] + line[:-1]) / 2
    on = middles < _HALF
    load = mesh.loads(axis) @ np.outer(on, on).ravel().astype(float)
    moved = solve_block(mesh, held(mesh, faces), load[:, None])[:, 0]
    near = middles[middles < 1.6 * _HALF]
    deep = near[near > 0.4 * _HALF]
    points = np.stack(np.meshgrid(near, near, deep), axis=-1).reshape(-1, 3)
    space = HalfSpace(_YOUNG, _RATIO, _HALF)
    motion, stress = getattr(space, kind)(points)
    origin = _motion(mesh, np.zeros((1, 3)), moved)[0, main[1]]
    law.compare(f"middle of the square moves {main[0]}, m/Pa", origin, space.middle()[main[1] == 0], 0.05)
    for case, ours, exact in (
        (f"motion along x, y and down, {len(points)} places", _motion(mesh, points, moved), motion),
        (f"sigma_zz, sigma_xz and sigma_yz, {len(points)} places", _stress(mesh, points, moved), stress),
    ):
        # The largest error over all points, relative to the largest value.
        where = np.unravel_index(np.abs(ours - exact).argmax(), ours.shape)
        error = abs(ours[where] - exact[where]) / np.abs(exact).max()
        law.compare(f"{case}, of the largest", float(ours[where]), float(exact[where]), 0.05, error)


def _motion(mesh: Hexahedra, points: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the motion along x, y and down, (P, 3)."""
    ways = [np.tile(way, (len(points), 1)) for way in np.eye(3)]
    return np.stack([mesh.motion(points, way) @ moved for way in ways], axis=-1)


def _stress(mesh: Hexahedra, points: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return sigma_zz, sigma_xz and sigma_yz, (P, 3)."""
    ways = [np.tile(way, (len(points), 1)) for way in np.eye(3)]
    return np.stack([mesh.stress(points, ways[2], ways[axis]) @ moved for axis in (2, 0, 1)], axis=-1)


@pytest.mark.slow("solves a block for seconds")
def test_hertz(law: Law) -> None:
    """A rigid sphere on a thick block: contact radius, peak pressure and force.

    Reference: Hertz.
    """
    sphere = 0.05  # m, radius
    force = 4 / 3 * _STAR * _HALF**3 / sphere  # for which Hertz' contact has the radius of _HALF
    peak = 1.5 * force / (np.pi * _HALF**2)
    for count in (4, 6, 8) if law.full else (4,):
        middles, _ = _ground(count)
        square = (middles[:, None] ** 2 + middles**2).ravel()
        pressure, approach = _press(count, square / (2 * sphere), force / 4)
        radius = float(np.sqrt(2.5 * (pressure @ square) / pressure.sum()))  # Hertz: <r^2> = 2 a^2 / 5
        law.findings.clear()  # the finest mesh counts
        law.compare(f"contact radius, m, {count} cells long", radius, _HALF, 0.05)
        law.compare("pressure in the middle, Pa", pressure[0], peak, 0.05)
        exact = 4 / 3 * _STAR * math.sqrt(sphere) * approach**1.5
        law.compare("force at its approach, N", force, exact, 0.05)
        law.remarks.append(_mesh_errors(count, law))


@pytest.mark.slow("solves a block for seconds")
def test_punch(law: Law) -> None:
    """Flat rigid punches, square and round: force for a given approach.

    Reference: capacitance of a square plate (Read, 1997); Johnson, section 3.4.
    """
    for count in (4, 6, 8) if law.full else (4,):
        middles, _ = _ground(count)
        square = np.outer(middles < _HALF, middles < _HALF).ravel()
        circle = (middles[:, None] ** 2 + middles**2).ravel() < _HALF**2
        radius = (
            float(np.sqrt(4 * circle.sum() / np.pi)) * _HALF / count
        )  # of the circle as large as its cells
        flat, round_ = (_press(count, np.where(under, 0.0, np.inf), 0.25)[1] for under in (square, circle))
        law.findings.clear()  # the finest mesh counts
        exact = SQUARE_PUNCH * _STAR * 2 * _HALF * flat
        law.compare(f"force at its approach, N, square, {2 * count} cells a side", 1, exact, 0.05)
        law.compare("force at its approach, N, round", 1, 2 * radius * _STAR * round_, 0.05)
        law.remarks.append(_mesh_errors(count, law))


def _mesh_errors(count: int, law: Law) -> str:
    """Return a remark with the errors on one mesh."""
    errors = (f"{100 * (each['ours'] / each['reference'] - 1):+.1f} %" for each in law.findings)
    return f"{count} cells over 10 mm: {', '.join(errors)}"


@cache  # sphere and punches share their blocks
def _ground(count: int) -> tuple[np.ndarray, torch.Tensor]:
    """Return the middles of cells along x and along y, m, and their compliance (contact=rigid), m/Pa.

    They are the finely cut middle of a quarter of a thick block.

    Args:
        count: cells per half side of the square, or per contact radius.
    """
    fine, cells = _HALF / count, count + count // 2
    line = graded(fine, cells, 60 * _HALF, 1.6)
    mesh = block((line, line, graded(fine, 2, 60 * _HALF, 1.4)), _YOUNG, _RATIO)
    inner = (np.arange(len(line) - 1)[:, None] * (len(line) - 1) + np.arange(cells))[:cells].ravel()
    loads = mesh.loads(2)[:, inner]
    moved = solve_block(mesh, held(mesh, _MIRRORED), loads.toarray())
    surface = torch.from_numpy(loads.T @ moved / fine**2)
    body = Sheet((cells * fine, cells * fine), (cells, cells), layers_of([Slab(60 * _HALF, _YOUNG, _RATIO)]))
    return (np.arange(cells) + 0.5) * fine, stabilise_checkerboard((surface + surface.T) / 2, body)


def _press(count: int, gap: np.ndarray, force: float) -> tuple[np.ndarray, float]:
    """Return the pressure (cells,), Pa, of an object on the quarter, and its approach, m; else NaN."""
    compliance, load = _ground(count)[1], torch.tensor([force / (_HALF / count) ** 2])
    contact = press(compliance, torch.from_numpy(gap)[None], load, tolerance=1e-6, iterations=1000)
    pressure = contact.pressure[0].numpy()
    if float(contact.residual[0]) > 1e-6:
        return pressure * np.nan, np.nan
    return pressure, float(np.mean((compliance.numpy() @ pressure + gap)[pressure > 0]))


def test_arm(law: Law) -> None:
    """A sleeve of large radius behaves like a sheet.

    Reference: the sheet.
    """
    sheet = default_sheet(16 if law.full else 8)
    positions = np.array([[0.07, 0.09, 0.005], [0.03, 0.12, 0.003], [0.11, 0.05, 0.005]])
    sensors = Sensors(positions, (0.02, 0.02), np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]]))
    flat = _transfer(sheet, sensors)
    for radius, tolerance in ((1e2, 1e-3), (1e4, 1e-5)):
        rows = _transfer(_sleeve(radius, sheet), sensors)
        error = np.abs(rows - flat).max() / np.abs(flat).max()
        case = f"readings of every cell and direction, radius {radius:g} m"
        law.compare(case, np.abs(rows).max(), np.abs(flat).max(), tolerance, error)


def _sleeve(radius: float, sheet: Sheet) -> Arm:
    angle = sheet.size[0] / radius
    return Arm(cells=sheet.cells, layers=sheet.layers, radius=radius, length=sheet.size[1], angle=angle)


def _transfer(body: AbstractBody, sensors: Sensors) -> np.ndarray:
    mesh = build_mesh(body, 2, {})
    return Elastic(mesh).transfer(reading_rows(mesh, sensors))


def test_tube(law: Law) -> None:
    """A sleeve on a rigid core under uniform pressure behaves like a bonded tube of two layers.

    Reference: Lame's equations.
    """
    # The tube: u = A r + B / r in each layer.
    core, middle, outer = 0.035, 0.045, 0.05
    soft, hard = SLABS
    inner, upper = (_tube(slab) for slab in (hard, soft))
    system = np.zeros((4, 4))
    system[0, :2], system[3, 2:] = inner(core)[0], upper(outer)[1]
    system[1:3, :2], system[1:3, 2:] = inner(middle), -upper(middle)
    amounts = np.linalg.solve(system / np.abs(system).max(axis=1, keepdims=True),
                              [0, 0, 0, -1 / np.abs(system[3]).max()])  # fmt: skip
    surface, between = upper(outer)[0] @ amounts[2:], upper(middle)[1] @ amounts[2:]
    cells, divisions = ((96, 2), 4) if law.full else ((32, 2), 2)
    body = Arm(cells=cells, layers=layers_of(SLABS), radius=outer, length=0.01, angle=np.pi)
    mesh = build_mesh(body, divisions, {})
    # Symmetry planes close the half tube: no vertical motion there, and no motion along the arm anywhere.
    walls = {"left": (2,), "right": (2,), "near": (1,), "far": (1,), "base": ALL}
    load = np.asarray(mesh.loads(2).sum(axis=1)).reshape(-1, 1)
    moved = solve_block(mesh, held(mesh, walls), load)[:, 0]
    top = np.array([[body.size[0] / 2, 0.005, 0.0]])
    sensor = Sensors(top + np.array([0, 0, 0.005]), FOOTPRINT)
    motion = (mesh.motion(top, np.array([[0.0, 0.0, 1.0]])) @ moved)[0]
    law.compare("motion of the surface, m/Pa", motion, -surface, 0.02)
    reading = (reading_rows(mesh, sensor) @ moved)[0] / 1e-4
    law.compare("reading at the interface / p A", reading, -between, 0.01)


def _tube(slab: Slab) -> Callable[[float], np.ndarray]:
    """Return a map from a radius to radial displacement and stress per A and B of u = A r + B / r, (2, 2)."""
    lam = slab.confined - 2 * slab.shear
    return lambda r: np.array([[r, 1 / r], [2 * (lam + slab.shear), -2 * slab.shear / r**2]])
