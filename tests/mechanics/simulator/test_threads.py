"""Operators, readings and contact pressures are the same on one thread and on two."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from skin.body.base import Sensors, Sheet
from skin.core.files import ROOT
from skin.mechanics.contact.rigid import solve_contact, stabilise_checkerboard
from skin.mechanics.geometry import reading_rows
from skin.mechanics.simulator._mesh import build_mesh
from skin.mechanics.simulator.solid import Elastic, Solid

CELLS = 8
LAYERS = [
    {"material": {"name": "muscle", "young": 560e3, "poisson": 0.49}, "thickness": 0.010},
    {"material": {"name": "skin", "young": 170e3, "poisson": 0.499}, "thickness": 0.005},
]


@pytest.mark.slow("solves anew with each number of threads")
def test_results_do_not_depend_on_the_number_of_threads(tmp_path):
    outputs = []
    for count in ("1", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        command = [sys.executable, "-P", __file__, count, str(tmp_path / f"{count}.npz")]
        environment = os.environ | dict.fromkeys(names, count) | {"PYTHONPATH": str(ROOT)}
        subprocess.run(command, check=True, env=environment | {"SKIN_CACHE": str(tmp_path / count)})
        with np.load(tmp_path / f"{count}.npz") as file:
            outputs.append({name: file[name] for name in file.files})
    for name, tolerance in (("operator", 1e-10), ("readings", 1e-5), ("contact", 1e-5)):
        single, double = (arrays[name] for arrays in outputs)
        assert np.abs(single - double).max() <= tolerance * np.abs(single).max()


def write_results(threads: int, path: str) -> None:
    """Write an operator, readings of random frames and the pressure under a sphere to an .npz file."""
    torch.set_num_threads(threads)
    body = Sheet((0.16, 0.16), (CELLS, CELLS), LAYERS)
    positions = np.random.default_rng(0).uniform(0.02, 0.14, (25, 2))
    sensors = Sensors(np.column_stack([positions, np.full(25, 0.005)]), (0.01, 0.01))
    mesh = build_mesh(body, 2, {})
    operator = Elastic(mesh).transfer(reading_rows(mesh, sensors))
    frames = torch.rand(20000, *body.shape, generator=torch.Generator().manual_seed(0))
    solid = Solid(body, sensors, divisions=2)
    compliance = stabilise_checkerboard(solid.compliance().double(), body)
    away = (np.indices(body.shape) + 0.5 - CELLS / 2) * body.cell[0]
    gap = torch.from_numpy((away**2).sum(axis=0).reshape(1, -1) / (2 * 1.0))
    load = torch.tensor([200 / body.cell[0] ** 2])
    pressed = solve_contact(compliance, gap, load, tolerance=1e-8, iterations=1000)
    readings = solid(1e4 * frames).readings.numpy()
    np.savez(path, operator=operator, readings=readings, contact=pressed.pressure.numpy())


if __name__ == "__main__":
    write_results(int(sys.argv[1]), sys.argv[2])
