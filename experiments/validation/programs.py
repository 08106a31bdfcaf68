"""Laws that another program, the report, or another number of threads decides.

``python experiments/validation/programs.py 2 16 out.npz`` computes with two threads.
"""

import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import spsolve

from experiments.validation import CheckResult, Finding, pynite_model, relative_finding
from experiments.validation.references import solve_frame
from experiments.validation.solid import default_sheet
from skin.body.base import Sensors, Sheet
from skin.core.files import ROOT
from skin.errors import InputError
from skin.mechanics.contact.rigid import solve_contact, stabilise_checkerboard
from skin.mechanics.relaxation import Relaxing
from skin.mechanics.simulator.fem import PlatesAndBeams
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.plates import Structure
from skin.mechanics.simulator.solid import Elastic, Solid, build_mesh, reading_rows

_DRAGON: Any = {"material": "Dragon Skin 10 Medium", "thickness": 0.010}
_ECOFLEX: Any = {"material": "EcoFlex 00-30", "thickness": 0.005}
_FOAM: Any = {"material": {"name": "foam", "young": 40e3, "poisson": 0.2}, "thickness": 0.003}


def single_frames(quick: bool) -> CheckResult:
    """Compare the precomputed operator with a scikit-fem solution of single frames."""
    body = default_sheet(8 if quick else 12, 0.12)
    place = np.array([3 * body.cell[0], 4 * body.cell[1], 0.005])
    mesh, extent = build_mesh(body, 2, {}), 2 * body.cell[0]
    sensors = Sensors(place[None], (extent, extent))
    down, above = np.array([[0.0, 0, 1]]), place * [1, 1, 0]
    rows = [reading_rows(mesh, sensors), mesh.motion(place[None], down), mesh.motion(above[None], down)]
    along, _, inwards = Elastic(mesh).transfer(sp.vstack(rows).tocsr())
    findings = []
    for seed, shear in ((0, 0.0), (1, 0.5)):
        pressure = 1e4 * np.random.default_rng(seed).random(body.shape)
        ours = (inwards + shear * along) @ pressure.ravel()
        theirs = solve_frame(mesh, pressure, shear, place, extent)
        for name, number, reference in zip(
            ("reading, N", "D_s, m", "D_t, m"),
            ours,
            (theirs.reading, theirs.sensor, theirs.surface),
            strict=True,
        ):
            findings.append(relative_finding(f"{name}, friction {shear:g}", number, reference, 1e-8))
    return CheckResult(findings)


def plates_and_beams(quick: bool) -> CheckResult:
    """Compare the nodal displacements of simulator=fem with those of PyNite."""
    bodies = {
        "4x3, two layers": Sheet((0.04, 0.04), (4, 3), (_DRAGON, _ECOFLEX)),
        "5x4, three layers that vary": Sheet((0.06, 0.05), (5, 4), (_DRAGON, _ECOFLEX, _FOAM), 0.2, 3),
    }
    findings = []
    for name, body in list(bodies.items())[: 1 if quick else 2]:
        for constraint in ("vertical", "free"):
            structure = Structure(body, constraint)
            pressure = np.random.default_rng(0).uniform(0, 1e5, body.shape)
            expected = _pynite_displacements(structure, pressure)[..., list(structure.free)]
            ours = spsolve(structure.stiffness(), structure.load() @ pressure.ravel()).reshape(expected.shape)
            error = (np.abs(ours - expected).max((0, 1, 2)) / np.abs(expected).max((0, 1, 2))).max()
            case = f"all displacements, {name}, constraint={constraint}"
            findings.append(Finding(case, np.abs(ours).max(), np.abs(expected).max(), float(error), 1e-8))
    return CheckResult(findings)


def equation_ten(quick: bool) -> CheckResult:
    """Check that readings of simulator=fem are D_s / D_t times the force on the footprint."""
    body = Sheet((0.04, 0.04), (4, 4), (_DRAGON, _ECOFLEX))
    pressure = np.random.default_rng(0).uniform(0, 1e5, body.shape)
    with tempfile.TemporaryDirectory() as cache:
        fem = PlatesAndBeams(body, Sensors(np.array([[0.02, 0.03, 0.005]]), body.cell), cache=cache).double()
    moves = _pynite_displacements(Structure(body), pressure)[:, 3, 2, 2]
    # The footprint is a quarter of each of the four cells about the node.
    force = pressure[2:4, 1:3].mean() * np.prod(body.cell)
    reading = [float(fem(torch.from_numpy(factor * pressure)).readings[0]) for factor in (1, 7)]
    return CheckResult(
        [
            # The simulator keeps its operator in single precision.
            relative_finding(
                "reading, N; D_s and D_t from PyNite", reading[0], moves[0] / moves[1] * force, 1e-6
            ),
            relative_finding("reading under seven times the pressure, N", reading[1], 7 * reading[0], 1e-6),
        ]
    )


def naive_readings(quick: bool) -> CheckResult:
    """Check that readings of simulator=naive are the pressure of one cell times the footprint area."""
    body = default_sheet(16)
    place = np.random.default_rng(0).uniform(0.01, 0.15, (25, 2))
    sensors = Sensors(np.column_stack([place, np.full(25, 0.005)]), (0.01, 0.01))
    pressure = np.random.default_rng(1).uniform(0, 1e5, body.shape)
    felt = Naive(body, sensors)(torch.from_numpy(pressure)).readings.numpy()
    exact = np.array([pressure[int(y // body.cell[1]), int(x // body.cell[0])] for x, y in place]) * 1e-4
    error = np.abs(felt - exact).max() / exact.max()
    return CheckResult([Finding("25 readings, N", felt.max(), exact.max(), float(error), 1e-6)])


def creep(quick: bool) -> CheckResult:
    """Compare the creep of a skin of one material under a constant load with the standard linear solid."""
    time, strength, rate, frames = 0.6, 0.8, 10.0, 30
    branch = {"time": time, "strength": strength}
    rubber = {"name": "rubber", "young": 170e3, "poisson": 0.45, "relaxation": branch}
    layer: Any = {"material": rubber, "thickness": 0.01}
    body = Sheet((0.08, 0.08), (4, 4), (layer,))
    sensors = Sensors(np.array([[0.03, 0.05, 0.0]]), (0.02, 0.02))
    index, scale = torch.zeros(1, frames, dtype=torch.long), torch.ones(1, frames)
    pressure = torch.rand(1, *body.shape, generator=torch.Generator().manual_seed(0))
    after = np.arange(1, frames + 1) / rate  # a load counts from the frame before
    exact = 1 - strength / (1 + strength) * np.exp(-after / (time * (1 + strength)))
    findings = []
    with tempfile.TemporaryDirectory() as cache:
        for name, simulator in (("fem", PlatesAndBeams), ("solid", Solid)):
            skin_ = Relaxing(partial(simulator, cache=cache), body, sensors, rate)
            final = skin_(pressure).displacement
            moved = skin_.play(pressure, index, scale).displacement
            assert final is not None
            assert moved is not None
            ours = (moved[0, :, 0, 1] / final[0, 0, 1]).numpy()
            error = float(np.abs(ours - exact).max())
            case = f"D_t in the first frame / in the end, worst of {frames}, simulator={name}"
            findings.append(Finding(case, float(ours[0]), float(exact[0]), error, 1e-5))
    return CheckResult(findings)


def threads(quick: bool) -> CheckResult:
    """Check that operators, readings and contact pressures are the same on one thread and on two."""
    cells = "8" if quick else "16"
    with tempfile.TemporaryDirectory() as folder:
        outputs = []
        for count in ("1", "2"):
            path = Path(folder) / f"{count}.npz"
            names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
            command = [sys.executable, "-P", __file__, count, cells, str(path)]
            environment = os.environ | dict.fromkeys(names, count) | {"PYTHONPATH": str(ROOT)}
            subprocess.run(command, check=True, env=environment)
            with np.load(path) as file:
                outputs.append({name: file[name] for name in file.files})
    findings = []
    for name, tolerance in (("operator", 1e-10), ("readings", 1e-5), ("contact", 1e-5)):
        single, double = (arrays[name] for arrays in outputs)
        error = float(np.abs(single - double).max() / np.abs(single).max())
        findings.append(Finding(name, np.abs(double).max(), np.abs(single).max(), error, tolerance))
    return CheckResult(findings)


def _pynite_displacements(structure: Structure, pressure: np.ndarray) -> np.ndarray:
    """Return PyNite's displacements, (layers, ny + 1, nx + 1, 6), with w positive upwards."""
    try:
        model = pynite_model.model(structure, pressure)
    except ModuleNotFoundError as missing:
        raise InputError(
            "checking simulator=fem needs PyNite, which is not installed: pip install PyNiteFEA"
        ) from missing
    pynite_model.solve(model)
    return pynite_model.displacements(model, structure)


def write_results(threads: int, cells: int, path: str) -> None:
    """Write an operator, readings of random frames and the pressure under a sphere to an .npz file."""
    torch.set_num_threads(threads)
    body = default_sheet(cells)
    places = np.random.default_rng(0).uniform(0.02, 0.14, (25, 2))
    sensors = Sensors(np.column_stack([places, np.full(25, 0.005)]), (0.01, 0.01))
    mesh = build_mesh(body, 2, {})
    operator = Elastic(mesh).transfer(reading_rows(mesh, sensors))
    frames = torch.rand(20000, *body.shape, generator=torch.Generator().manual_seed(0))
    with tempfile.TemporaryDirectory() as cache:
        solid = Solid(body, sensors, divisions=2, cache=cache)
        felt = solid(1e4 * frames).readings
        compliance = stabilise_checkerboard(solid.compliance().double(), body)
    away = (np.indices(body.shape) + 0.5 - cells / 2) * body.cell[0]
    gap = torch.from_numpy((away**2).sum(axis=0).reshape(1, -1) / (2 * 1.0))
    pressed = solve_contact(
        compliance, gap, torch.tensor([200 / body.cell[0] ** 2]), tolerance=1e-8, iterations=1000
    )
    np.savez(path, operator=operator, readings=felt.numpy(), contact=pressed.pressure.numpy())


if __name__ == "__main__":
    write_results(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
