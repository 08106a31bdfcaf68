"""The field of the whole skin against the operator of its sensors, and what the gallery makes of it."""

import numpy as np
import pytest
import torch

from skin.body.base import Arm, Sensors, Sheet
from skin.body.layout import Grid
from skin.mechanics.simulator.fem import Structure, build
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid
from skin.plot.plot3d import deflection, surface_motion

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


@pytest.mark.parametrize("constraint", ["vertical", "free"])
def test_nodes_move_as_sensors_on_them_do(constraint):
    body = Sheet((0.08, 0.06), (8, 6), LAYERS)
    pressure = torch.zeros(2, 6, 8)
    pressure[0, 1:3, 5:7] = 40e3
    pressure[1, 4, 1] = 90e3
    moved = deflection(body, pressure, constraint)
    assert moved.shape == (2, 2, 7, 9)
    # the operator's way is the adjoint one: a solve per sensor, not per frame
    nodes = np.array([[0.05, 0.02, 0.005], [0.02, 0.05, 0.005], [0.06, 0.01, 0.005]])
    seen = build(Structure(body, constraint), Sensors(nodes, (0.01, 0.01)))
    loads = pressure.flatten(1).double().numpy().T
    column, row = np.round(nodes[:, :2] * 100).astype(int).T
    top, bottom = (seen.surface @ loads).T, (seen.sensor @ loads).T
    assert moved[:, 1, row, column] == pytest.approx(top, rel=1e-9)
    assert moved[:, 0, row, column] == pytest.approx(bottom, rel=1e-9)
    assert moved[0].reshape(2, -1).argmax(axis=1) == pytest.approx(2 * 9 + 6)  # under the first touch


def test_a_single_layer_has_one_face():
    moved = deflection(Sheet((0.04, 0.04), (4, 4), LAYERS[1:]), torch.full((1, 4, 4), 17e3))
    assert moved.shape == (1, 1, 5, 5)
    # strain p / E of 5 mm of 170 kPa
    assert moved.mean() == pytest.approx(0.1 * 0.005, rel=0.1)


def test_the_surface_of_a_solid_moves_as_sensors_on_it_do(tmp_path):
    body = Sheet((0.16, 0.08), (16, 8), LAYERS)
    pressure = torch.zeros(2, 8, 16)
    pressure[0, 3:5, 10:12] = 40e3
    steps = np.arange(-1, 2) * 0.01
    positions = np.stack([*np.meshgrid(0.11 + steps, 0.04 + steps), np.zeros((3, 3))], axis=-1).reshape(-1, 3)
    nu = {"Dragon Skin 10 Medium": 0.45, "EcoFlex 00-30": 0.45}
    # With one element a cell there is one mesh, on which both are read.
    solid = Solid(body, Sensors(positions, (0.01, 0.01)), 1, nu, tmp_path, refinement=1)
    moved = surface_motion(solid, body, solid.loads(pressure))
    assert moved.shape == (2, 9, 17)
    assert (moved[1] == 0).all()
    true = solid(pressure[0]).displacement[:, 1].reshape(3, 3).numpy()
    assert moved[0, 3:6, 10:13] == pytest.approx(true, rel=1e-4)
    assert np.unravel_index(moved[0].argmax(), (9, 17)) == (4, 11)


def test_without_a_compliance_plates_and_beams_tell_how_a_flat_skin_moves():
    body, pressure = Sheet((0.04, 0.04), (4, 4), LAYERS[1:]), torch.full((1, 4, 4), 17e3)
    moved = surface_motion(Naive(body, Grid(2, 2).sensors(body)), body, pressure)
    np.testing.assert_array_equal(moved, deflection(body, pressure)[:, -1])
    arm = Arm(radius=0.05, length=0.1, angle=2.0, cells=[4, 4], layers=LAYERS)
    assert surface_motion(Naive(arm, Grid(2, 2).sensors(arm)), arm, pressure) is None
