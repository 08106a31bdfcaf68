"""Pictures of a body in space: what stands where, and how its surface moves."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Path3DCollection, Poly3DCollection

from skin.body.base import Arm, Sensors, Sheet
from skin.body.layout import Grid
from skin.errors import InputError
from skin.mechanics.simulator.fem import Structure, build
from skin.mechanics.simulator.naive import Naive
from skin.mechanics.simulator.solid import Solid
from skin.plot.animation import VIEWS
from skin.plot.plot3d import Scene, deflection, surface_motion

LAYERS = [{"material": "EcoFlex 00-30", "thickness": 0.015}]
ARM = Arm(radius=0.05, length=0.12, angle=3.0, cells=[10, 6], layers=LAYERS)
# On top, at the left edge, and far around towards the right one.
PLACES = np.array([[0.075, 0.06, 0.005], [0.001, 0.06, 0.005], [0.12, 0.02, 0.005]])


def scene(body: Arm = ARM, **more) -> Scene:
    """Return a scene in which sensor 0 reads 3 N in frame 2, and sensor 2 a third of it."""
    readings = np.zeros((6, 3))
    readings[2] = [3.0, 0.0, 1.0]
    positions = np.broadcast_to(PLACES, (6, 3, 3))
    return Scene(readings, positions, body.size, 10.0, "a touch", body=body, **more)


def moved() -> np.ndarray:
    field = np.zeros((6, 7, 11))
    field[2, 3, 5] = 0.002
    return field


def drawn(view, known: Scene, frame: int):
    figure = Figure()
    VIEWS[view](figure, known)(frame)
    return [figure.axes[0].findobj(kind) for kind in (Line3DCollection, Path3DCollection, Poly3DCollection)]


def test_bars_stand_out_of_the_surface_as_long_as_they_read():
    bars, _, _ = drawn("sensors3d", scene(), 2)
    ends = 1e-3 * np.concatenate([np.array(one._segments3d) for one in bars if len(one._segments3d)])
    radius = np.hypot(ends[..., 0], ends[..., 2])
    np.testing.assert_allclose(radius[:, 0], 0.05)
    rise = sorted(radius[:, 1] - radius[:, 0])
    np.testing.assert_allclose(rise, [0, 0.4 * 0.12 / 3, 0.4 * 0.12], atol=1e-12)
    # each along its own radius
    turn = np.arctan2(ends[..., 0], ends[..., 2])
    np.testing.assert_allclose(turn[:, 0], turn[:, 1])


def test_the_surface_is_pressed_in_where_it_moves():
    """The most, 2 mm, is drawn as about half the thickness of 15 mm: 4 times as deep as it is."""
    surface = drawn("skin3d", scene(moved=moved()), 2)[2][0]
    x, _, z = 1e-3 * np.concatenate(surface._faces).T
    radius = np.hypot(x, z)
    assert radius.min() == pytest.approx(0.05 - 4 * 0.002)
    assert np.mean(np.isclose(radius, 0.05)) > 0.9


def test_the_skin_is_coloured_by_pressure_where_nobody_knows_how_it_moves():
    pressure = np.zeros((6, 6, 10))
    pressure[2, 3, 5] = 50e3
    figure = Figure()
    VIEWS["skin3d"](figure, scene(pressure=pressure))(2)
    assert [axis.get_ylabel() for axis in figure.axes][-1] == "pressure, kPa"
    with pytest.raises(InputError, match="view=skin3d needs the pressure on the skin"):
        VIEWS["skin3d"](Figure(), scene())


TWO_LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]


@pytest.mark.parametrize("constraint", ["vertical", "free"])
def test_nodes_move_as_sensors_on_them_do(constraint):
    body = Sheet((0.08, 0.06), (8, 6), TWO_LAYERS)
    pressure = torch.zeros(2, 6, 8)
    pressure[0, 1:3, 5:7] = 40e3
    pressure[1, 4, 1] = 90e3
    moved = deflection(body, pressure, constraint)
    assert moved.shape == (2, 2, 7, 9)
    nodes = np.array([[0.05, 0.02, 0.005], [0.02, 0.05, 0.005], [0.06, 0.01, 0.005]])
    seen = build(Structure(body, constraint), Sensors(nodes, (0.01, 0.01)))
    loads = pressure.flatten(1).double().numpy().T
    column, row = np.round(nodes[:, :2] * 100).astype(int).T
    top, bottom = (seen.surface @ loads).T, (seen.sensor @ loads).T
    assert moved[:, 1, row, column] == pytest.approx(top, rel=1e-9)
    assert moved[:, 0, row, column] == pytest.approx(bottom, rel=1e-9)
    assert moved[0].reshape(2, -1).argmax(axis=1) == pytest.approx(2 * 9 + 6)  # under the first touch


def test_the_surface_of_a_solid_moves_as_sensors_on_it_do(tmp_path):
    body = Sheet((0.16, 0.08), (16, 8), TWO_LAYERS)
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
    true = solid.press(solid.loads(pressure[0]), displacement=True).displacement[:, 1].reshape(3, 3).numpy()
    assert moved[0, 3:6, 10:13] == pytest.approx(true, rel=1e-4)
    assert np.unravel_index(moved[0].argmax(), (9, 17)) == (4, 11)


def test_without_a_compliance_plates_and_beams_tell_how_a_flat_skin_moves():
    body, pressure = Sheet((0.04, 0.04), (4, 4), TWO_LAYERS[1:]), torch.full((1, 4, 4), 17e3)
    moved = surface_motion(Naive(body, Grid(2, 2).sensors(body)), body, pressure)
    np.testing.assert_array_equal(moved, deflection(body, pressure)[:, -1])
    arm = Arm(radius=0.05, length=0.1, angle=2.0, cells=[4, 4], layers=TWO_LAYERS)
    assert surface_motion(Naive(arm, Grid(2, 2).sensors(arm)), arm, pressure) is None
