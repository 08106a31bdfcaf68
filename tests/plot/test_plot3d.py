"""Pictures of a body that is not flat: what stands where in space."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Path3DCollection, Poly3DCollection

from skin.body.base import Arm
from skin.errors import InputError
from skin.plot.animation import VIEWS
from skin.plot.plot3d import Scene

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


def test_sensors_behind_the_arm_are_not_seen():
    shown = [len(dots._offsets3d[0]) for dots in drawn("sensors3d", scene(), 2)[1]]
    assert shown == [2]  # not the one at the left edge, whose surface looks away


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
