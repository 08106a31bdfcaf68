"""Laws of the solid: any elastic body, layers bonded to a rigid base, and a thick soft block."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch

from experiments.validation import CheckResult, Curve, Finding, Plot, relative_finding
from experiments.validation.references import (
    ALL,
    WALLS,
    Discs,
    HalfSpace,
    HertzContact,
    Slab,
    block,
    bonded_layer,
    graded,
    held,
    round_punch,
    row_means,
    solve_block,
    square_punch,
)
from skin.body.arm import Arm
from skin.body.base import AbstractBody, Sensors
from skin.body.sheet import Sheet
from skin.mechanics.contact.rigid import solve_contact as press
from skin.mechanics.contact.rigid import stabilise_checkerboard
from skin.mechanics.simulator._hexahedra import Hexahedra
from skin.mechanics.simulator._mesh import build_mesh, build_meshes
from skin.mechanics.simulator._reading import reading_rows
from skin.mechanics.simulator.solid import Elastic
from skin.touch.shapes import Shapes

# The default skin, from the surface down.
SLABS = (Slab(0.005, 170e3, 0.499), Slab(0.010, 560e3, 0.49))


def _layers(slabs: Sequence[Slab]) -> Any:
    """Return slabs as the layers of a body."""
    return tuple(
        {"material": {"name": f"layer {number}", "young": slab.young, "poisson": slab.poisson},
         "thickness": slab.thickness}
        for number, slab in reversed(list(enumerate(slabs)))
    )  # fmt: skip


_LAYERS = _layers(SLABS)


def default_sheet(cells: int = 16, size: float = 0.16) -> Sheet:
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
        mesh = Hexahedra((x, y, z), np.full(count, 2e5), np.full(count, ratio), _bent, _axes)
        strain = np.array([[1.0, 0.3, -0.2], [0.3, -0.4, 0.5], [-0.2, 0.5, 0.7]]) * 1e-3
        exact = (mesh.nodes @ strain).ravel()
        faces = dict.fromkeys(("left", "right", "near", "far", "base", "top"), (0, 1, 2))
        fixed = held(mesh, faces)
        prescribed = np.where(fixed, exact, 0)
        moved = prescribed + solve_block(mesh, fixed, -(mesh.stiffness() @ prescribed)[:, None])[:, 0]
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
    body = default_sheet(16 if quick else 24, 0.24)
    depths = (0.0025, 0.005, 0.012)
    sensors = Sensors(np.array([[0.12, 0.12, depth] for depth in depths]), (0.01, 0.01))
    mesh = build_mesh(body, 2, {}, 2)
    felt = Elastic(mesh, 2).transfer(reading_rows(mesh, sensors), (2,))[0].sum(axis=1) / 1e-4
    return CheckResult(
        [
            relative_finding(f"reading / p A, {1e3 * depth:g} mm deep", reading, 1, 2e-3)
            for depth, reading in zip(depths, felt, strict=True)
        ]
    )


def wide_arm(quick: bool) -> CheckResult:
    """Check that a sleeve approaches a sheet as its radius grows."""
    sheet = default_sheet(8 if quick else 16)
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
    mesh = build_mesh(body, 2 if quick else 4, {})
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
    mesh = build_mesh(body, 2, {})
    return Elastic(mesh).transfer(reading_rows(mesh, sensors))


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


_RATIOS = (0.45, 0.49, 0.499, 0.4999)


def thin_layer(quick: bool) -> CheckResult:
    """Compare the compliance of a thin bonded layer under a pressure wave with the closed form."""
    slab = Slab(0.005, 170e3, 0.499)
    shares = np.array([2.0, 8.0]) if quick else np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    measured, exact = [], []
    for share in shares:
        number = 2 * np.pi / (share * slab.thickness)
        measured.append(_wave(number, slab, 16, 8))
        exact.append(bonded_layer(number, slab))
    findings = [
        relative_finding(f"compliance, m/Pa, wave of {share:g} thicknesses", ours, reference, 0.02)
        for share, ours, reference in zip(shares, measured, exact, strict=True)
    ]
    fine = np.geomspace(0.7, 40, 200)
    line = [bonded_layer(2 * np.pi / (share * slab.thickness), slab) for share in fine]
    picture = Plot(
        "layer", "Bonded layer, nu = 0.499, under a wave of pressure", "wavelength / thickness",
        "surface motion per pressure, m/Pa",
        [Curve("closed form", fine, line), Curve("elements", shares, measured, marks=True)], log=True,
    )  # fmt: skip
    return CheckResult(findings, (), (picture,))


def no_locking(quick: bool) -> CheckResult:
    """Check that the error does not grow when nu approaches one half."""
    findings, curves = [], []
    for rows in (4,) if quick else (4, 8):
        errors = []
        for ratio in _RATIOS:
            slab = Slab(0.01, 170e3, ratio)
            ours, exact = _wave(100.0, slab, 2 * rows, rows), bonded_layer(100.0, slab)
            errors.append(ours / exact - 1)
            findings.append(
                relative_finding(f"compliance, m/Pa, nu = {ratio}, {rows} rows", ours, exact, 0.01)
            )
        change = abs(errors[-1] - errors[-2])
        case = f"change of the error from nu = {_RATIOS[-2]} to {_RATIOS[-1]}, {rows} rows"
        findings.append(Finding(case, errors[-1], errors[-2], change, 1e-3))
        curves.append(Curve(f"{rows} rows of elements", 0.5 - np.array(_RATIOS), np.abs(errors), marks=True))
    picture = Plot("locking", "No locking: a bonded layer under a wave", "0.5 - nu", "relative error",
                      curves, log=True)  # fmt: skip
    return CheckResult(findings, (), (picture,))


def convergence(quick: bool) -> CheckResult:
    """Check that halving the element size divides the displacement error by four."""
    counts = (4, 8, 16) if quick else (4, 8, 16, 32)
    findings, curves = [], []
    for ratio in (0.3, 0.499):
        slab = Slab(0.01, 170e3, ratio)
        exact = bonded_layer(100.0, slab)
        errors = [abs(_wave(100.0, slab, count, count) / exact - 1) for count in counts]
        order = float(np.log2(errors[-2] / errors[-1]))
        findings.append(Finding(f"order, nu = {ratio}", order, 2, abs(order - 2), 0.2))
        curves.append(Curve(f"nu = {ratio}", counts, errors, marks=True))
    curves.append(Curve("second order", counts, [0.5 / count**2 for count in counts]))
    picture = Plot(
        "convergence", "Motion under a wave of pressure", "elements per thickness", "relative error",
        curves, log=True,
    )  # fmt: skip
    return CheckResult(findings, (), (picture,))


_FOOTPRINT = 0.01  # m
_RADII = (0.005, 0.008, 0.02)  # m
_BESIDE = np.array([[0.0, 0.0], [0.0025, 0.0], [0.008, 0.0], [0.016, 0.0]])  # m, from the sensor to the disc


def layered(quick: bool) -> CheckResult:
    """Compare readings of the default skin and of drawn ones under discs with endless exact layers."""
    random, findings = np.random.default_rng(0), []
    for number in range(3 if quick else 30):
        slabs, depth = _drawn(random, 0.01 if quick else 0.04) if number else (SLABS, SLABS[0].thickness)
        whole = sum(slab.thickness for slab in slabs)
        # Of 5 mm; the rim is then not felt in the middle.
        cells = 2 * math.ceil(max(0.04 if quick else 0.06, 2 * whole) / 0.005)
        body = Sheet((0.005 * cells,) * 2, (cells, cells), _layers(slabs))
        # The sensors stand in different places within a cell.
        inside = np.array([[0, 0], [2.5, 2.5], [2.5, 0], [1.2, -1.3], [-0.8, 1.9]]) * 1e-3
        places = np.column_stack([body.size[0] / 2 + inside, np.full(len(inside), depth)])
        exact = exact_readings(slabs, depth)
        ours = _under_discs(body, Sensors(places, (_FOOTPRINT, _FOOTPRINT)))
        errors = np.abs(ours - exact[:, None]) / exact[:, None, :1]
        radius, sensor, beside = map(int, np.unravel_index(errors.argmax(), errors.shape))
        layers = " on ".join(f"{1e3 * slab.thickness:.1f} mm of {slab.young / 1e3:.0f} kPa" for slab in slabs)
        case = f"{layers}, {1e3 * depth:.1f} mm deep, radius {1e3 * _RADII[radius]:g} mm, reading / p, m^2"
        tolerance = 0.015 if depth >= 0.005 else 0.05
        numbers = float(ours[radius, sensor, beside]), float(exact[radius, beside]), float(errors.max())
        findings.append(Finding(case, *numbers, tolerance))
    remarks = (
        "the largest error of each skin, at the sensor and up to 16 mm beside, as a share of the reading "
        "above it; sensors less deep than a cell is long, 5 mm, err by up to 5 %, because the moments of "
        "cells do not know the edge of a disc exactly",
    )
    return CheckResult(findings, remarks)


def exact_readings(slabs: Sequence[Slab], depth: float) -> np.ndarray:
    """Return readings per pressure of a sensor at a depth, m, under discs beside it, (radii, places), m^2."""
    discs = np.array([[*place, radius] for radius in _RADII for place in _BESIDE])
    table = Discs(slabs, depth, (_RADII[0], _RADII[-1]))
    return table.forces(discs, np.zeros((1, 2)), _FOOTPRINT).reshape(len(_RADII), len(_BESIDE))


def _drawn(random: np.random.Generator, most: float) -> tuple[Sequence[Slab], float]:
    """Return one or two layers, at most this thick, m, and the depth of sensors."""
    whole, share, ratio = random.uniform(0.005, most), random.uniform(0.2, 0.8), 20 ** random.uniform(-1, 1)
    depth, poisson = random.uniform(0.002, whole - 0.0005), random.uniform(0.45, 0.499)
    if min(share, 1 - share) * whole < 0.003 or random.random() < 0.5:
        return [Slab(whole, 1e5, poisson)], depth
    return [Slab(share * whole, 1e5, poisson), Slab((1 - share) * whole, 1e5 * ratio, 0.49)], depth


def _under_discs(body: Sheet, sensors: Sensors) -> np.ndarray:
    """Return readings per pressure under discs beside sensors, (radii, S, places), m^2."""
    operator = sum(
        weight * Elastic(mesh, refinement).transfer(reading_rows(mesh, sensors), (2,))[0]
        for weight, mesh, refinement in build_meshes(body, sensors, None, {}, 2)
    )
    shapes = Shapes(("disc",), body, fine=True)
    spread = np.sqrt(4 * float(shapes.levels[0].double().mean()) / np.pi)  # radius over scale
    at = (sensors.positions[:, None, :2] + _BESIDE).reshape(-1, 2)
    turn, felt = np.zeros(len(at)), []
    for radius in _RADII:
        moments, _, _ = shapes.press(turn.astype(int), turn, turn + radius / spread, at)
        every = (moments.flatten(1).double().numpy() @ operator.T).reshape(len(sensors), len(_BESIDE), -1)
        felt.append(every.diagonal(axis1=0, axis2=2).T * np.pi * radius**2 / np.prod(body.cell))
    return np.stack(felt)


def _wave(number: float, slab: Slab, columns: int, rows: int) -> float:
    """Return the elements' surface motion per pressure under half a wave between smooth walls, m/Pa."""
    x = np.linspace(0, np.pi / number, columns + 1)
    lines = (x, x[:2].copy(), np.linspace(0, slab.thickness, rows + 1))
    mesh = block(lines, slab.young, slab.poisson)
    pressure = np.diff(np.sin(number * x)) / (number * np.diff(x))  # a cell's mean
    moved = solve_block(mesh, held(mesh, WALLS), (mesh.loads(2) @ pressure)[:, None])[:, 0]
    top = -moved.reshape(rows + 1, 2, columns + 1, 3)[0, 0, :, 2]
    return float(2 * number / np.pi * np.trapezoid(top * np.cos(number * x), x))


_YOUNG, _RATIO, _HALF = 170e3, 0.45, 0.01
_STAR = _YOUNG / (1 - _RATIO**2)
# A quarter of the block is solved: two faces are symmetry planes, or antisymmetric under forces along x.
_MIRRORED = {"left": (0,), "near": (1,), "base": ALL}
_OPPOSED = {"left": (1, 2), "near": (1,), "base": ALL}


def boussinesq(quick: bool) -> CheckResult:
    """Compare displacement and stress under a square of pressure with Boussinesq's solution."""
    return _forces(quick, 2, "under_pressure", ("down", 2), _MIRRORED)


def cerruti(quick: bool) -> CheckResult:
    """Compare displacement and stress under a square of traction along x with Cerruti's solution."""
    return _forces(quick, 0, "under_shear", ("along x", 0), _OPPOSED)


def _forces(quick: bool, axis: int, kind: str, main: tuple[str, int], faces: dict) -> CheckResult:
    """Compare displacements, and stresses on planes parallel to the surface, below and beside the square."""
    count = 4 if quick else 6
    line = graded(_HALF / count, count + count // 2, 60 * _HALF, 1.6)
    mesh, middles = block((line, line, line), _YOUNG, _RATIO), row_means(line)
    on = middles < _HALF
    load = mesh.loads(axis) @ np.outer(on, on).ravel().astype(float)
    moved = solve_block(mesh, held(mesh, faces), load[:, None])[:, 0]
    near = middles[middles < 1.6 * _HALF]
    deep = near[near > 0.4 * _HALF]
    places = np.stack(np.meshgrid(near, near, deep), axis=-1).reshape(-1, 3)
    space = HalfSpace(_YOUNG, _RATIO, _HALF)
    motion, stress = getattr(space, kind)(places)
    ours, tension = _motion(mesh, places, moved), _stress(mesh, places, moved)
    origin = _motion(mesh, np.zeros((1, 3)), moved)[0, main[1]]
    findings = [
        relative_finding(
            f"middle of the square moves {main[0]}, m/Pa", origin, space.middle()[main[1] == 0], 0.05
        ),
        _worst(f"motion along x, y and down, {len(places)} places", ours, motion),
        _worst(f"sigma_zz, sigma_xz and sigma_yz, {len(places)} places", tension, stress),
    ]
    return CheckResult(findings, (), (_profile(mesh, moved, kind, middles, count),))


def _profile(mesh: Hexahedra, moved: np.ndarray, kind: str, middles: np.ndarray, count: int) -> Plot:
    """Draw a stress below the square's edge, along x."""
    depth = float(middles[count - 1])
    x = middles[middles < 4 * _HALF]
    fine = np.linspace(0, 4 * _HALF, 200)
    part, name = (0, "sigma_zz") if kind == "under_pressure" else (1, "sigma_xz")
    ours = _stress(mesh, np.column_stack([x, 0 * x + middles[0], 0 * x + depth]), moved)[:, part]
    space = HalfSpace(_YOUNG, _RATIO, _HALF)
    exact = getattr(space, kind)(np.column_stack([fine, 0 * fine + middles[0], 0 * fine + depth]))[1][:, part]
    law = "Boussinesq" if kind == "under_pressure" else "Cerruti"
    return Plot(
        law.lower(), f"{name} under a square of 20 mm, {1e3 * depth:.1f} mm deep", "x, mm",
        f"{name} per traction", [Curve(law, 1e3 * fine, exact), Curve("elements", 1e3 * x, ours, marks=True)],
    )  # fmt: skip


def _motion(mesh: Hexahedra, places: np.ndarray, moved: np.ndarray) -> np.ndarray:
    ways = [np.tile(way, (len(places), 1)) for way in np.eye(3)]
    return np.stack([mesh.motion(places, way) @ moved for way in ways], axis=-1)


def _stress(mesh: Hexahedra, places: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return sigma_zz, sigma_xz and sigma_yz, (P, 3)."""
    ways = [np.tile(way, (len(places), 1)) for way in np.eye(3)]
    return np.stack([mesh.stress(places, ways[2], ways[axis]) @ moved for axis in (2, 0, 1)], axis=-1)


def _worst(case: str, ours: np.ndarray, exact: np.ndarray) -> Finding:
    """Return the largest error over all places, relative to the largest value."""
    where = np.unravel_index(np.abs(ours - exact).argmax(), ours.shape)
    error = abs(ours[where] - exact[where]) / np.abs(exact).max()
    return Finding(f"{case}, of the largest", float(ours[where]), float(exact[where]), float(error), 0.05)


def hertz(quick: bool) -> CheckResult:
    """Compare contact radius, peak pressure and force of a rigid sphere with Hertz, on several meshes."""
    sphere = HertzContact(0.05, _STAR)
    force = 4 / 3 * _STAR * _HALF**3 / 0.05  # for which Hertz' contact has the radius of _HALF
    findings: list[Finding] = []
    remarks, curves = [], []
    for count in (4,) if quick else (4, 6, 8):
        ground = _ground(count)
        square = (ground.middles[:, None] ** 2 + ground.middles**2).ravel()
        pressure, approach = ground.press(square / (2 * sphere.radius), force / 4)
        radius = float(np.sqrt(2.5 * (pressure @ square) / pressure.sum()))  # Hertz: <r^2> = 2 a^2 / 5
        findings = [
            relative_finding(f"contact radius, m, {count} cells long", radius, sphere.contact(force), 0.05),
            relative_finding("pressure in the middle, Pa", pressure[0], sphere.peak(force), 0.05),
            relative_finding("force at its approach, N", force, sphere.force(approach), 0.05),
        ]
        remarks.append(_refined(count, findings))
        near = square < (1.4 * _HALF) ** 2
        distance, height = 1e3 * np.sqrt(square[near]), pressure[near] / 1e3
        curves.append(Curve(f"{count} cells a radius", distance, height, marks=True))
    r = np.linspace(0, 1.4, 200)
    exact = sphere.peak(force) * np.sqrt(np.clip(1 - r**2, 0, None))
    curves.append(Curve("Hertz", 1e3 * _HALF * r, exact / 1e3))
    title, x, y = "A rigid sphere on a thick block", "distance from the middle, mm", "pressure, kPa"
    return CheckResult(findings, remarks, (Plot("hertz", title, x, y, curves),))


def flat_punch(quick: bool) -> CheckResult:
    """Compare the force on flat rigid punches, round and square, with the solution for their approach."""
    findings: list[Finding] = []
    remarks = []
    for count in (4,) if quick else (4, 6, 8):
        ground, cell = _ground(count), _HALF / count
        on = ground.middles < _HALF
        square = np.outer(on, on).ravel()
        circle = (ground.middles[:, None] ** 2 + ground.middles**2).ravel() < _HALF**2
        radius = float(np.sqrt(4 * circle.sum() / np.pi)) * cell  # of the circle as large as its cells
        flat, round_ = (ground.press(np.where(under, 0.0, np.inf), 0.25)[1] for under in (square, circle))
        findings = [
            relative_finding(f"force at its approach, N, square, {2 * count} cells a side", 1,
                     square_punch(_STAR, 2 * _HALF, flat), 0.05),
            relative_finding("force at its approach, N, round", 1, round_punch(_STAR, radius, round_), 0.05),
        ]  # fmt: skip
        remarks.append(_refined(count, findings))
    return CheckResult(findings, remarks)


def _refined(count: int, findings: list[Finding]) -> str:
    """Return a remark with the errors on one mesh."""
    errors = (f"{100 * (finding.ours / finding.reference - 1):+.1f} %" for finding in findings)
    return f"with {count} cells over 10 mm: {', '.join(errors)}"


@dataclass(frozen=True)
class _Ground:
    """A quarter of a thick block and the compliance of its finely cut middle.

    Attributes:
        count: cells per half side of the square, or per contact radius.
    """

    count: int

    @property
    def middles(self) -> np.ndarray:
        """Middles of the cells along x and along y, m."""
        return (np.arange(self.count + self.count // 2) + 0.5) * _HALF / self.count

    @cached_property
    def compliance(self) -> torch.Tensor:
        """As contact=rigid makes it of the elements', m/Pa."""
        fine, cells = _HALF / self.count, len(self.middles)
        line = graded(fine, cells, 60 * _HALF, 1.6)
        mesh = block((line, line, graded(fine, 2, 60 * _HALF, 1.4)), _YOUNG, _RATIO)
        inner = (np.arange(len(line) - 1)[:, None] * (len(line) - 1) + np.arange(cells))[:cells].ravel()
        loads = mesh.loads(2)[:, inner]
        moved = solve_block(mesh, held(mesh, _MIRRORED), loads.toarray())
        surface = torch.from_numpy(loads.T @ moved / fine**2)
        layer: Any = {
            "material": {"name": "block", "young": _YOUNG, "poisson": _RATIO},
            "thickness": 60 * _HALF,
        }
        body = Sheet((cells * fine, cells * fine), (cells, cells), (layer,))
        return stabilise_checkerboard((surface + surface.T) / 2, body)

    def press(self, gap: np.ndarray, force: float) -> tuple[np.ndarray, float]:
        """Return the pressure (cells,), Pa, of an object on the quarter, and its approach, m."""
        area = (_HALF / self.count) ** 2
        contact = press(
            self.compliance, torch.from_numpy(gap)[None], torch.tensor([force / area]), tolerance=1e-6,
            iterations=1000,
        )  # fmt: skip
        pressure = contact.pressure[0].numpy()
        if float(contact.residual[0]) > 1e-6:
            return pressure * np.nan, np.nan
        under = pressure > 0
        return pressure, float(np.mean((self.compliance.numpy() @ pressure + gap)[under]))


_ground = cache(_Ground)  # sphere and punches share their blocks
