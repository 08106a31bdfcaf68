"""Compute with a given number of threads: python -m experiments.validation.fixed_threads 2 16 out.npz."""

import sys
import tempfile

import numpy as np
import torch

from experiments.validation.patch_and_equilibrium import skin
from skin.contact._checkerboard import stabilise_checkerboard
from skin.contact._unilateral import solve_contact
from skin.sensors import Sensors
from skin.simulator._elastic import Elastic
from skin.simulator.solid import Solid, hexahedra, reading_rows


def main(threads: int, cells: int, path: str) -> None:
    """Write an operator, readings of random frames and the pressure under a sphere to an .npz file."""
    torch.set_num_threads(threads)
    body = skin(cells)
    places = np.random.default_rng(0).uniform(0.02, 0.14, (25, 2))
    sensors = Sensors(np.column_stack([places, np.full(25, 0.005)]), (0.01, 0.01))
    mesh = hexahedra(body, 2, {})
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
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
