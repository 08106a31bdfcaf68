"""The solid obeys laws of elasticity that a few elements show, and agrees with scikit-fem in mixed form."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
import skfem as fem
import torch
from scipy.linalg.blas import dtrsm
from scipy.sparse.linalg import splu, spsolve
from skfem import MeshHex
from skfem.helpers import ddot, div, sym_grad
from threadpoolctl import threadpool_info, threadpool_limits

from experiments.laws.references import Discs, Slab
from skin.body.base import Sensors, Sheet
from skin.errors import InputError
from skin.mechanics.geometry import Fingertip, reading_rows, sample
from skin.mechanics.simulator._mesh import Hexahedra, build_mesh
from skin.mechanics.simulator.fem import PlatesAndBeams
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


identity = lambda points: np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))  # noqa: E731


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


def test_a_tilted_sensor_feels_shear():
    """Traction q along x adds 2 q sin cos to what pushes across a plane leaning along x, in a wide sheet."""
    sheet, angle = Sheet([0.2, 0.2], [20, 20], LAYERS), np.deg2rad(30)
    leaning, flat = (np.sin(angle), 0, np.cos(angle)), (0, 0, 1)
    skin = solid(sensors(*[(0.1, 0.1, 0.0025)] * 3, normals=[leaning, flat, (0, 0, -1)]), sheet)
    nothing = torch.full(sheet.shape, 1e3)
    pushed = skin(nothing).readings.double()
    sheared = skin(nothing, torch.tensor([0.5, 0.0])).readings.double()
    # The traction pushes the surface along +x; on the plane across n it pulls where n leans into the motion.
    change = (sheared - pushed).numpy() / (1e3 * 1e-4)
    assert change[0] == pytest.approx(2 * 0.5 * np.sin(angle) * np.cos(angle), rel=0.03)
    assert change[1] == pytest.approx(0, abs=0.01)
    assert pushed[2] == pytest.approx(pushed[1])  # up or down reads the same


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


def test_readings_alone_are_solved_for_on_one_thread(tmp_path, monkeypatch):
    solved = set()

    def noted(scale, triangle, values, **named):
        if "overwrite_b" not in named:  # a solve, not a factor
            blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
            solved.add((len(values), *blas))
        return dtrsm(scale, triangle, values, **named)

    monkeypatch.setattr("skin.mechanics.simulator.solid.dtrsm", noted)
    with threadpool_limits(2):
        solid(TWO, cache=tmp_path)
    assert solved == {(2, 1, 1)}  # sensors; threads of scipy and of numpy


def test_too_few_rows_are_said_with_the_error_to_expect():
    thick = Sheet([0.08, 0.08], [8, 8], [{"material": "EcoFlex 00-30", "thickness": 0.03}])
    where = sensors((0.04, 0.04, 0.0295))
    with pytest.warns(UserWarning, match=r"divisions=2 makes rows .* 15 mm high .* by 100 %;.* 7 rows"):
        solid(where, thick)


@pytest.mark.parametrize(
    ("size", "thickness", "settings", "reason"),
    [
        (0.08, 0.0009, {}, r"layer 1 of the body is 0\.0009 m thick;.* takes layers from 0\.001 m"),
        (0.02, 0.021, {}, r"layer 1 of the body is 0\.021 m thick.*to the width of the skin, 0\.02 m"),
        (0.08, 0.01, {"divisions": 0}, r"simulator.divisions=0 must be greater than 0"),
        (0.08, 0.01, {"poisson": {"mussel": 0.4}}, r"names mussel, but the body is made of EcoFlex 00-30"),
    ],
)
def test_what_no_solid_can_be(size, thickness, settings, reason):
    body = Sheet([size, 0.08], [4, 8], [{"material": "EcoFlex 00-30", "thickness": thickness}])
    with pytest.raises(InputError, match=reason):
        solid(sensors((0.01, 0.04, 0.0005)), body, **settings)


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


SOFT = {"name": "soft", "young": 1e5, "poisson": 0.3}
SOFT_SHEET = Sheet([0.2, 0.2], [10, 10], [{"material": SOFT, "thickness": high} for high in (0.01, 0.005)])
SENSOR = Sensors(np.array([[0.1, 0.1, 0.005]]), (0.01, 0.01))


def test_even_pressure_squeezes_plates_like_a_column_and_a_wide_solid_as_in_an_oedometer():
    """p / E; confined p (1 + nu) (1 - 2 nu) / (E (1 - nu)) in the middle, and more at the free edges."""
    even, confined = torch.full((1, 10, 10), 2e4), 2e4 * 1.3 * 0.4 / (1e5 * 0.7)
    assert PlatesAndBeams(SOFT_SHEET, SENSOR).strain(even).item() == pytest.approx(0.2, rel=0.1)
    assert confined < Solid(SOFT_SHEET, SENSOR, divisions=2).strain(even).item() < 2 * confined


EXTENT = (0.16, 0.12, 0.015)
SIDE = 0.006
WAYS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0.6, 0.8, 0), (0.6, 0, 0.8), (0.3, -0.2, 0.933)]


def sampled(way, position=(0.071, 0.052, 0.0075)):
    normal = np.array(way, dtype=float)
    normal /= np.linalg.norm(normal)
    points, inside = sample(Sensors(np.array([position]), (SIDE, SIDE), normal), EXTENT)
    return points[0], inside[0], normal


@pytest.mark.parametrize("way", WAYS)
def test_points_lie_across_the_normal_about_the_sensor(way):
    points, inside, normal = sampled(way)
    away = points - [0.071, 0.052, 0.0075]
    assert inside.all()
    assert np.abs(away @ normal).max() < 1e-12
    assert away.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)
    assert (away**2).sum(axis=1).mean() == pytest.approx(SIDE**2 / 6, rel=0.01)


def test_a_cut_footprint_is_said_with_its_share():
    """Leaning by 45 degrees 0.5 mm above the base, 3.5 mm of 10 mm reach into the base: with 0.5 mm, 43 %."""
    body = Sheet([0.08, 0.08], [8, 8], [{"material": "EcoFlex 00-30", "thickness": 0.012}])
    positions = np.array([[0.03, 0.03, 0.0115], [0.05, 0.05, 0.006], [0.0, 0.04, 0.006]])
    lean = np.array([[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0, 1.0]])
    with pytest.warns(UserWarning, match=r"of 1 tilted sensors.*sensor 1 loses 4[0-4] % of its footprint"):
        Solid(body, Sensors(positions, (0.01, 0.01), lean), divisions=1)


_GAUSS = (np.array([-1, 1]) / np.sqrt(3) + 1) / 2


@pytest.mark.parametrize(("seed", "shear"), [(0, 0.0), (1, 0.5)])
def test_the_operator_agrees_with_scikit_fem_on_single_frames(seed, shear):
    body = Sheet((0.12, 0.12), (8, 8), LAYERS)
    position = np.array([3 * body.cell[0], 4 * body.cell[1], 0.005])
    mesh, extent = build_mesh(body, 2, {}), 2 * body.cell[0]
    down, above = np.array([[0.0, 0, 1]]), position * [1, 1, 0]
    # Stress in the middles of the 2 x 2 elements under the footprint, between the rows next to the place.
    weights = np.zeros((4, 8, 8))
    weights[1:3, 3:5, 2:4] = -np.prod(body.cell) * np.array([2 / 3, 1 / 3])[:, None, None]
    stress = mesh.mean_stress(sp.csr_matrix(weights.reshape(1, -1)), down)
    rows = sp.vstack([stress, mesh.motion(position[None], down), mesh.motion(above[None], down)])
    adjoint = Elastic(mesh).solve(rows.T.toarray())
    along, inwards = ((mesh.loads(axis).T @ adjoint).T for axis in (0, 2))
    pressure = 1e4 * np.random.default_rng(seed).random(body.shape)
    theirs = solve_frame(mesh, pressure, shear, position, extent)
    ours = (inwards + shear * along) @ pressure.ravel()
    assert ours == pytest.approx([theirs.reading, theirs.sensor, theirs.surface], rel=1e-8)


@dataclass(frozen=True)
class FrameSolution:
    reading: float  # normal force on a rectangle of whole cells, N
    sensor: float  # displacement into the skin of the node in its middle, m
    surface: float  # the same of the node above, m


def solve_frame(
    mesh: Hexahedra, pressure: np.ndarray, shear: float, position: np.ndarray, extent: float
) -> FrameSolution:
    """Solve a flat skin under a pressure (H, W), Pa, in the mixed form: one pressure unknown per element.

    ``shear`` is the traction along x by the pressure; ``position`` (3,), m, is a node between two rows of
    elements, and ``extent`` the side of the sensor's footprint, m, of whole cells about the node.
    """
    points = MeshHex(mesh.nodes.T.copy(), mesh.corners.T.copy())
    basis = fem.CellBasis(points, fem.ElementVector(fem.ElementHex1()), intorder=2)
    inner = basis.with_element(fem.ElementHex0())
    columns, rows, _ = mesh.counts
    lam, mu = (constant.repeat(columns * rows) for constant in mesh.lame)
    shape = basis.dx.shape
    fields = {"mu": np.broadcast_to(mu[:, None], shape), "lam": np.broadcast_to(lam[:, None], shape)}
    stiff = fem.BilinearForm(lambda u, v, w: 2 * w.mu * ddot(sym_grad(u), sym_grad(v)))
    elastic = stiff.assemble(basis, **fields)
    grown = fem.BilinearForm(lambda u, q, w: div(u) * q).assemble(basis, inner)
    squeezed = fem.BilinearForm(lambda p, q, w: p * q / w.lam).assemble(inner, **fields)
    whole = sp.block_array([[elastic, grown.T], [grown, -squeezed]]).tocsr()

    top = fem.FacetBasis(points, basis.elem, facets=points.facets_satisfying(lambda x: np.abs(x[2]) < 1e-12))
    columns, rows = (np.diff(line[:2])[0] for line in mesh.lines[:2])

    def traction(v, w):
        push = pressure[(w.x[1] // rows).astype(int), (w.x[0] // columns).astype(int)]
        return push * (shear * v[0] - v[2])

    load = np.concatenate([fem.LinearForm(traction).assemble(top), np.zeros(inner.N)])
    table = basis.get_dofs(lambda x: np.abs(x[2] + mesh.lines[2][-1]) < 1e-12).all()
    solution = _solve(*fem.condense(whole, load, D=table))
    moved, squeeze = solution[: basis.N], solution[basis.N :]
    below = np.array([position[0], position[1], -position[2]])
    above = np.array([position[0], position[1], 0.0])
    sensor, surface = (-_at(points, basis, moved, spot)[2] for spot in (below, above))
    reading = _reading(points, basis, moved, squeeze, fields["mu"], mesh, position, extent)
    return FrameSolution(reading, sensor, surface)


def _solve(matrix, right, whole, free) -> np.ndarray:
    """Solve with one step of iterative refinement, because the mixed form is ill-conditioned."""
    factors = splu(matrix.tocsc())
    first = factors.solve(right)
    answer = whole.copy()
    answer[free] = first + factors.solve(right - matrix @ first)
    return answer


def _at(points: MeshHex, basis: fem.CellBasis, moved: np.ndarray, spot: np.ndarray) -> np.ndarray:
    node = np.linalg.norm(points.p - spot[:, None], axis=0).argmin()
    return moved[basis.nodal_dofs[:, node]]


def _reading(points, basis, moved, squeeze, mu, mesh: Hexahedra, position, extent: float) -> float:
    """Integrate -sigma_zz over the footprint in the rows above and below, and interpolate linearly."""
    x, y, z = points.p[:, points.t].mean(axis=1)
    within = (np.abs(x - position[0]) < extent / 2) & (np.abs(y - position[1]) < extent / 2)
    lines = mesh.lines[2]
    row = int(np.searchsorted(lines, position[2] - 1e-9))
    upper, lower = (lines[row - 1] + lines[row]) / 2, (lines[row] + lines[row + 1]) / 2
    s, t = np.meshgrid(_GAUSS, _GAUSS)
    half_way = np.stack([s.ravel(), t.ravel(), np.full(4, 0.5)])
    felt = []
    for middle in (upper, lower):
        elements = np.flatnonzero(within & (np.abs(z + middle) < 1e-9))
        plane = fem.CellBasis(points, basis.elem, quadrature=(half_way, np.full(4, 0.25)), elements=elements)
        push = fem.Functional(lambda w: -(2 * w.mu * w["u"].grad[2][2] + w.q) / w.high)
        shape = plane.dx.shape
        felt.append(
            push.assemble(
                plane, u=plane.interpolate(moved), mu=np.broadcast_to(mu[elements, :1], shape),
                q=np.broadcast_to(squeeze[elements][:, None], shape),
                high=np.full(shape, 2 * abs(lines[row] - middle)),
            )
        )  # fmt: skip
    fraction = (position[2] - upper) / (lower - upper)
    return float((1 - fraction) * felt[0] + fraction * felt[1])
