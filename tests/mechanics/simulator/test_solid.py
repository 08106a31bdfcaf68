"""The solid obeys the laws of elasticity that a few elements can show; tests/validation shows the rest."""

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import spsolve

from experiments.laws.references import Discs, Slab
from skin.body.base import Sensors, Sheet
from skin.errors import InputError
from skin.mechanics.geometry import Fingertip, reading_rows
from skin.mechanics.simulator._mesh import Hexahedra, build_mesh
from skin.mechanics.simulator.solid import Cholesky, Elastic, Solid
from skin.touch.shapes import cell_moments

LAYERS = [
    {"material": {"name": "muscle", "young": 560e3, "poisson": 0.49}, "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
SHEET = Sheet([0.08, 0.08], [8, 8], LAYERS)
FOOTPRINT = (0.01, 0.01)


def sensors(*positions, normals=(0.0, 0.0, 1.0)):
    return Sensors(np.array(positions, dtype=float), FOOTPRINT, np.array(normals, dtype=float))


MIDDLE = sensors((0.04, 0.04, 0.005))
TWO = sensors((0.021, 0.035, 0.005), (0.06, 0.02, 0.009), normals=[(0.3, 0.1, 0.9), (0, 0, 1)])


def solid(where=MIDDLE, body=SHEET, **settings):
    return Solid(body, where, **{"divisions": 2} | settings)


def bent(points):
    """Move a chart's points smoothly and unevenly: no element stays a box."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x + 0.2 * y * x, y + 0.1 * x * x - 0.1 * z, -z + 0.3 * x * z], axis=-1)


def identity(points):
    return np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))


def test_middles_of_elements_tell_a_cubic_everywhere():
    lines = tuple(np.sort(np.random.default_rng(seed).random(7)) for seed in range(3))
    mesh = Hexahedra(lines, np.full(6, 2e5), np.full(6, 0.49), bent, identity)
    x, y, z = np.meshgrid(*((line[1:] + line[:-1]) / 2 for line in lines), indexing="ij")

    def cubic(x, y, z):
        return (1 + x - 2 * x**3) * (2 - y**2 + y**3) * (1 + 3 * z)

    inner = [(line[0] + line[1], line[-1] + line[-2]) for line in lines]
    points = np.random.default_rng(3).uniform(*(np.array(inner).T / 2), (20, 3))
    between = mesh.between(points) @ cubic(x, y, z).transpose(2, 1, 0).ravel()
    assert between == pytest.approx(cubic(*points.T), rel=1e-9)


def test_the_operator_is_a_direct_solve_on_two_meshes():
    pressure = 1e4 * np.random.default_rng(0).random(64)
    moments = np.kron(cell_moments(8), cell_moments(8)) @ pressure
    expected = np.zeros(2)
    for weight, divisions, refinement in ((4 / 3, 2, 2), (-1 / 3, 1, 1)):
        mesh = build_mesh(SHEET, divisions, {}, refinement)
        elastic, free = Elastic(mesh, refinement), np.flatnonzero(~mesh.held)
        load = elastic.loads(2) @ moments - 0.4 * elastic.loads(0) @ moments
        moved = np.zeros(len(load))
        moved[free] = spsolve(mesh.stiffness()[free][:, free].tocsc(), load[free])
        expected += weight * (reading_rows(mesh, TWO) @ moved)
    frame, shear = torch.from_numpy(pressure).reshape(8, 8), torch.tensor([-0.4, 0.0])
    assert solid(TWO)(frame, shear).readings.numpy() == pytest.approx(expected, rel=2e-6)


@pytest.fixture(scope="module")
def wide():
    """Return a wide sheet and how much pushes across a leaning, a flat and an upright plane in its middle."""
    sheet, angle = Sheet([0.2, 0.2], [20, 20], LAYERS), np.deg2rad(30)
    positions = np.array([(0.1, 0.1, 0.0025), (0.1, 0.1, 0.0025), (0.1, 0.1, 0.0075)])
    normals = np.array([(np.sin(angle), 0, np.cos(angle)), (0, 0, 1), (1, 0, 0)])
    return sheet, solid(Sensors(positions, FOOTPRINT, normals), sheet)


def test_a_tilted_sensor_feels_shear(wide):
    """Traction q along x adds 2 q sin cos to what pushes across a plane leaning along x, in a wide sheet."""
    sheet, skin = wide
    nothing = torch.full(sheet.shape, 1e3)
    pushed = skin(nothing).readings.double()
    sheared = skin(nothing, torch.tensor([0.5, 0.0])).readings.double()
    # The traction pushes the surface along +x; on the plane across n it pulls where n leans into the motion.
    change, angle = (sheared - pushed).numpy() / (1e3 * 1e-4), np.deg2rad(30)
    assert change[0] == pytest.approx(2 * 0.5 * np.sin(angle) * np.cos(angle), rel=0.03)
    assert change[1] == pytest.approx(0, abs=0.01)


def test_sensors_of_three_axes_read_what_endless_layers_do():
    """Forces along x, along y and inwards under a fingertip, with and without friction, beside the sensor."""
    sheet, middle, rim = Sheet([0.09, 0.09], [18, 18], [LAYERS[1] | {"thickness": 0.01}]), 0.045, 0.0015
    skin = Solid(sheet, Sensors(np.array([[middle, middle, 0.0055]] * 3), FOOTPRINT, directions=np.eye(3)))
    fingertips = middle + np.array([[0, 0], [0.004, 0.002], [-0.007, 0.006], [0.002, -0.015]])
    touches = torch.tensor([[x, y, 0.009, 1.0] for x, y in fingertips.tolist()])
    loads, ways = Fingertip(sheet, rim, smooth=True)(touches), torch.tensor([[1.0, 0], [0, 1], [0, 0]])
    ours = np.stack([skin.press(loads, way).readings for way in ways], -1)
    ours[..., :2] -= ours[..., 2:]
    edges = rim * np.log(np.arange(1, 32, 2) / np.arange(31, 0, -2))  # a soft rim is a mean of discs
    table = Discs([Slab(0.01, 170e3, 0.499)], 0.0055, (0.008, 0.01), 0.05, edges.tolist())
    discs = np.column_stack([fingertips, np.full(4, 0.009)])
    exact = table.tractions(discs, np.array([[middle, middle]]), 0.01)[:, 0]
    exact /= np.pi * np.square(0.009 + edges).mean()
    assert np.abs(ours - exact).max() < 0.02 * np.abs(exact).max()
    assert np.abs(ours - exact)[..., :2].max() < 0.02 * np.abs(exact[..., :2]).max()


def test_simulators_of_one_body_share_its_factors(tmp_path, monkeypatch):
    made, kept = [], {"cache": tmp_path}
    counted = lambda *given: made.append(given) or Cholesky(*given)  # noqa: E731
    monkeypatch.setattr("skin.mechanics.simulator.solid.Cholesky", counted)
    coarse, fine = (Sheet([0.06, 0.06], [count, count], LAYERS) for count in (6, 12))
    skins = [solid(sensors((x, 0.03, 0.005)), coarse, **kept) for x in (0.03, 0.02)]
    assert len(made) == 2  # a fine and a coarse mesh
    # The same elements under smaller cells.
    skins.append(solid(sensors((0.03, 0.03, 0.005)), fine, refinement=1, **kept))
    assert [skin.transfer.shape[1] for skin in skins] == [36, 36, 144]
    assert len(made) == 3
    del skins
    solid(sensors((0.04, 0.03, 0.005)), coarse, **kept)
    assert len(made) == 5


def test_too_few_rows_are_said_with_the_error_to_expect():
    thick = Sheet([0.08, 0.08], [8, 8], [{"material": "EcoFlex 00-30", "thickness": 0.03}])
    where = sensors((0.04, 0.04, 0.0295))
    with pytest.warns(UserWarning, match=r"divisions=2 makes rows .* 15 mm high .* by 100 %;.* 7 rows"):
        solid(where, thick)


@pytest.mark.parametrize(
    ("size", "thickness", "reason"),
    [
        (0.08, 0.0009, r"layer 1 of the body is 0\.0009 m thick; simulator=solid takes layers from 0\.001 m"),
        (0.02, 0.021, r"layer 1 of the body is 0\.021 m thick.*to the width of the skin, 0\.02 m"),
    ],
)
def test_layers_that_no_mesh_can_hold(size, thickness, reason):
    body = Sheet([size, 0.08], [4, 8], [{"material": "EcoFlex 00-30", "thickness": thickness}])
    with pytest.raises(InputError, match=reason):
        solid(sensors((0.01, 0.04, 0.0005)), body)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"divisions": 0}, r"simulator.divisions=0 must be greater than 0"),
        ({"poisson": {"muscle": 0.5}}, r"muscle has Poisson's ratio 0\.5.*poisson=\{muscle: 0\.49\}"),
        ({"poisson": {"mussel": 0.4}}, r"names mussel, but the body is made of EcoFlex 00-30, muscle"),
    ],
)
def test_what_no_solid_can_be(settings, reason):
    with pytest.raises(InputError, match=reason):
        solid(**settings)


def test_the_measured_ratio_of_dragon_skin_is_replaced_in_python_as_in_the_configuration():
    dragon, other = "Dragon Skin 10 Medium", {"name": "other", "young": 560e3, "poisson": 0.49}
    transfers = []
    for material in (dragon, {"name": dragon, "poisson": 0.49}, other):
        sheet = Sheet([0.12, 0.12], [12, 12], [{"material": material, "thickness": 0.01}])
        transfers.append(solid(sensors((0.06, 0.06, 0.005)), sheet, divisions=1).transfer)
    assert torch.equal(transfers[0], transfers[1])
    assert torch.equal(transfers[0], transfers[2])


def test_an_impossible_ratio_is_refused_by_name():
    material = {"name": "rubber", "young": 560e3, "poisson": 0.54}
    body = Sheet([0.12, 0.12], [12, 12], [{"material": material, "thickness": 0.01}])
    with pytest.raises(InputError, match=r"rubber has Poisson's ratio 0\.54") as caught:
        solid(sensors((0.06, 0.06, 0.0)), body)
    python, shell = "poisson={'rubber': 0.49}", "'simulator.poisson={rubber: 0.49}'"
    assert f"in Python give {python}" in str(caught.value)
    assert f"on the command line give {shell}" in str(caught.value)
    given = eval(python.removeprefix("poisson="))
    assert Solid(body, sensors((0.06, 0.06, 0.005)), divisions=1, poisson=given).transfer.isfinite().all()


def test_sensors_move_with_what_slides_over_them():
    """Under a shear along x they go along x, and by symmetry neither along y nor deeper."""
    body = Sheet([0.16, 0.16], [8, 8], LAYERS)
    solid = Solid(body, Sensors(np.array([[0.08, 0.08, 0.005]]), (0.02, 0.02)), divisions=1)
    pressure = torch.zeros(1, 8, 8)
    pressure[:, 3:5, 3:5] = 1e4
    still, pulled = solid.motion(pressure), solid.motion(pressure, torch.tensor([[0.5, 0.0]]))
    assert pulled[0, 0, 0] > 1e-6
    torch.testing.assert_close(pulled[0, 0, 1:], still[0, 0, 1:], atol=1e-8, rtol=1e-4)
    torch.testing.assert_close(still[0, 0, :2], torch.zeros(2), atol=1e-8, rtol=0)
