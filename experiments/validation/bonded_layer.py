"""Checks of layers bonded to a rigid base against exact Fourier sums."""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from experiments.validation.blocks import WALLS, block, held, row_means, solve_block
from experiments.validation.finding import CheckResult, Curve, Finding, Plot, relative_finding
from experiments.validation.layered import Slab, bonded_layer, patch
from experiments.validation.mixed_form import locking
from experiments.validation.patch_and_equilibrium import SLABS, stack
from skin.sensors import Sensors
from skin.simulator._hexahedra import Hexahedra
from skin.simulator.solid import reading_rows

_SIDE = 0.16
_LOADED = (0.06, 0.10, 0.06, 0.10)
_PLACES = np.array([[0.08, 0.08], [0.105, 0.08], [0.12, 0.08]])
_RATIOS = (0.45, 0.49, 0.499, 0.4999)


def thin_layer(quick: bool) -> CheckResult:
    """Compare the compliance of a thin bonded layer under a pressure wave with the closed form."""
    slab = Slab(0.005, 170e3, 0.499)
    shares = np.array([2.0, 8.0]) if quick else np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    found, exact = [], []
    for share in shares:
        number = 2 * np.pi / (share * slab.thickness)
        found.append(_wave(number, slab, 16, 8))
        exact.append(bonded_layer(number, slab))
    findings = [
        relative_finding(f"compliance, m/Pa, wave of {share:g} thicknesses", one, other, 0.02)
        for share, one, other in zip(shares, found, exact, strict=True)
    ]
    fine = np.geomspace(0.7, 40, 200)
    line = [bonded_layer(2 * np.pi / (share * slab.thickness), slab) for share in fine]
    picture = Plot(
        "layer", "Bonded layer, nu = 0.499, under a wave of pressure", "wavelength / thickness",
        "surface motion per pressure, m/Pa",
        [Curve("closed form", fine, line), Curve("elements", shares, found, marks=True)], log=True,
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
    slabs = [Slab(0.01, 170e3, ratio) for ratio in _RATIOS]
    plain = [abs(_wave(100.0, slab, 8, 4, locking) / bonded_layer(100.0, slab) - 1) for slab in slabs]
    curves.append(Curve("4 rows of plain elements, which lock", 0.5 - np.array(_RATIOS), plain, marks=True))
    picture = Plot("locking", "No locking: a bonded layer under a wave", "0.5 - nu", "relative error",
                      curves, log=True)  # fmt: skip
    remark = (
        f"plain, fully integrated elements, 4 rows of them, have an error of {100 * plain[-1]:.0f} % at "
        f"nu = {_RATIOS[-1]}"
    )
    return CheckResult(findings, (remark,), (picture,))


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


def default_mesh(quick: bool) -> CheckResult:
    """Compare readings of the default skin under a square load with the exact layers, on several meshes."""
    meshes = ((16, 3), (32, 2)) if quick else ((16, 3), (32, 1), (32, 3), (64, 3))
    exact = _exact(200 if quick else 320)
    remarks, found = [], {}
    for cells, divisions in meshes:
        found[cells, divisions] = ours = _pressed(cells, divisions)
        error = (ours - exact) / exact[:, :1]
        remarks.append(
            f"{cells} x {cells} cells, {divisions} rows a layer, a 40 mm square pressed: "
            f"readings {_list(error[0])}, D_s {_list(error[1])}, D_t {_list(error[2])} of the value under "
            "its middle, for sensors under its middle, 5 mm and 20 mm beside its edge"
        )
    fine = (32, 2) if quick else (32, 3)
    ours = found[fine]
    findings = [
        relative_finding("reading under the middle / p A", ours[0, 0], exact[0, 0], 0.05),
        Finding("reading 5 mm beside / p A", ours[0, 1], exact[0, 1],
                abs(ours[0, 1] - exact[0, 1]) / exact[0, 0], 0.05),
        relative_finding("D_s under the middle, m/Pa", ours[1, 0], exact[1, 0], 0.05),
        relative_finding("D_t under the middle, m/Pa", ours[2, 0], exact[2, 0], 0.05),
    ]  # fmt: skip
    return CheckResult(findings, remarks)


def _list(errors: np.ndarray) -> str:
    return ", ".join(f"{100 * error:+.1f} %" for error in errors)


def _wave(
    number: float,
    slab: Slab,
    columns: int,
    rows: int,
    stiffness: Callable[[Hexahedra], sp.csc_matrix] = Hexahedra.stiffness,
) -> float:
    """Return the elements' surface motion per pressure under half a wave between smooth walls, m/Pa."""
    x = np.linspace(0, np.pi / number, columns + 1)
    lines = (x, x[:2].copy(), np.linspace(0, slab.thickness, rows + 1))
    mesh = block(lines, slab.young, slab.poisson)
    pressure = np.diff(np.sin(number * x)) / (number * np.diff(x))  # a cell's mean
    moved = solve_block(mesh, held(mesh, WALLS), (mesh.loads(2) @ pressure)[:, None], stiffness(mesh))[:, 0]
    top = -moved.reshape(rows + 1, 2, columns + 1, 3)[0, 0, :, 2]
    return float(2 * number / np.pi * np.trapezoid(top * np.cos(number * x), x))


def _pressed(cells: int, divisions: int) -> np.ndarray:
    """Return reading / A, D_s and D_t (3, S) per pressure on a square in the middle, by elements.

    Sensors and load are even about y = side / 2, and the load about x = side / 2, where smooth walls stand.
    """
    half = cells // 2
    x = np.linspace(0, _SIDE, cells + 1)[: half + 1]
    depth, young, ratio = stack(divisions)
    mesh = block((x, x, depth), young, ratio)
    middle = row_means(x)
    on = (middle > _LOADED[0]) & (middle < _LOADED[1])
    load = mesh.loads(2) @ np.outer(on, on).ravel().astype(float)
    moved = solve_block(mesh, held(mesh, WALLS), load[:, None])[:, 0]
    deep = np.column_stack([_SIDE - _PLACES, np.full(len(_PLACES), SLABS[0].thickness)])
    # A footprint on the mirror is cut in half there: twice per mirror gives it back.
    cut = 2.0 ** (np.abs(deep[:, :2] - _SIDE / 2) < 1e-9).sum(axis=1)
    felt = reading_rows(mesh, Sensors(deep, (0.01, 0.01))) @ moved / 1e-4 * cut
    down = np.tile([0.0, 0.0, 1.0], (len(deep), 1))
    sensor, surface = (mesh.motion(deep * [1, 1, share], down) @ moved for share in (1, 0))
    return np.stack([felt, sensor, surface])


def _exact(count: int) -> np.ndarray:
    """Return the same by waves."""
    found = []
    for x, y in _PLACES:
        print_ = (x - 0.005, x + 0.005, y - 0.005, y + 0.005)
        point = (x - 1e-9, x + 1e-9, y - 1e-9, y + 1e-9)
        depth = SLABS[0].thickness
        size = (_SIDE, _SIDE)
        felt = -patch(SLABS, size, _LOADED, print_, depth, count)[1]
        sensor, surface = (patch(SLABS, size, _LOADED, point, z, count)[0] for z in (depth, 0.0))
        found.append([felt, sensor, surface])
    return np.array(found).T
