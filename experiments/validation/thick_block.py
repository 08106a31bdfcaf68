"""Checks of a thick soft block: tractions and rigid objects far from its ends."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import torch

from experiments.validation.blocks import ALL, block, graded, held, row_means, solve_block
from experiments.validation.finding import CheckResult, Curve, Finding, Plot, relative_finding
from experiments.validation.halfspace import HalfSpace, Hertz, round_punch, square_punch
from skin.body.sheet import Sheet
from skin.contact._checkerboard import stabilise_checkerboard
from skin.contact._unilateral import solve_contact as press
from skin.simulator._hexahedra import Hexahedra

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
    sphere = Hertz(0.05, _STAR)
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
        distance, shown = 1e3 * np.sqrt(square[near]), pressure[near] / 1e3
        curves.append(Curve(f"{count} cells a radius", distance, shown, marks=True))
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
    errors = (f"{100 * (one.ours / one.reference - 1):+.1f} %" for one in findings)
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
        found = press(
            self.compliance, torch.from_numpy(gap)[None], torch.tensor([force / area]), tolerance=1e-6,
            iterations=1000,
        )  # fmt: skip
        pressure = found.pressure[0].numpy()
        if float(found.residual[0]) > 1e-6:
            return pressure * np.nan, np.nan
        under = pressure > 0
        return pressure, float(np.mean((self.compliance.numpy() @ pressure + gap)[under]))


_ground = cache(_Ground)  # sphere and punches share their blocks
