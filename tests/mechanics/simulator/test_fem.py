"""Laws that the plates and beams obey, PyNite as their referee, and their operator on disk: never trusted."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from Pynite import FEModel3D
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import spsolve

from skin.body.base import Sensors, Sheet
from skin.body.layout import Scattered
from skin.body.material import Material
from skin.errors import InputError
from skin.mechanics.simulator import fem as _operator
from skin.mechanics.simulator.fem import PlatesAndBeams, Structure, build, cached

DRAGON = {"material": "Dragon Skin 10 Medium", "thickness": 0.010}
ECOFLEX = {"material": "EcoFlex 00-30", "thickness": 0.005}
FOAM = {"material": {"name": "foam", "young": 40e3, "poisson": 0.2}, "thickness": 0.003}
LAYERS = [DRAGON, ECOFLEX]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("operators")


@pytest.fixture(scope="module")
def default(cache):
    body = Sheet([0.16, 0.16], [32, 32], LAYERS)
    return PlatesAndBeams(body, Scattered(seed=0).sensors(body), cache=cache)


def centres(body: Sheet) -> tuple[np.ndarray, np.ndarray]:
    """Return x (1, W) and y (H, 1) of the cells' centres, m."""
    x, y = ((np.arange(n) + 0.5) * step for n, step in zip(body.cells, body.cell, strict=True))
    return x[None, :], y[:, None]


def at(*positions: tuple[float, float, float], footprint=(0.01, 0.01)) -> Sensors:
    return Sensors(np.array(positions), footprint)


def touches(body: Sheet, count: int) -> torch.Tensor:
    """Return discs of 10 to 60 mm radius and 100 kPa at random places, (count, H, W)."""
    rng = np.random.default_rng(0)
    x, y = centres(body)
    discs = [
        (x - rng.uniform(0, body.size[0])) ** 2 + (y - rng.uniform(0, body.size[1])) ** 2
        < rng.uniform(0.01, 0.06) ** 2
        for _ in range(count)
    ]
    return torch.from_numpy(1e5 * np.stack(discs)).float()


def test_equation_10_is_what_it_says(default):
    """F_i = D_s / D_t * F_in, from the float64 rows, one sensor at a time; zero beside the contact."""
    pressure = touches(Sheet([0.16, 0.16], [32, 32], LAYERS), 50)
    readings = default(pressure).readings
    operator = default.operator
    for frame, given in zip(pressure.double().numpy().reshape(50, -1), readings.numpy(), strict=True):
        for sensor in range(len(given)):
            applied = operator.applied[sensor] @ frame
            expected = 0.0
            if applied > 0:
                expected = operator.sensor[sensor] @ frame / (operator.surface[sensor] @ frame) * applied
            assert given[sensor] == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_interface_reading_is_the_force_of_the_beams_under_the_footprint(cache):
    """Two of a layer's beams and a half: E A / h times their shortening, by hand."""
    body = Sheet([0.06, 0.06], [6, 6], [*LAYERS, FOAM])
    pressure = torch.rand(body.shape, generator=torch.Generator().manual_seed(0)) * 1e5
    sensor = at((0.03, 0.02, 0.003), footprint=(0.02, 0.01))
    skin = PlatesAndBeams(body, sensor, reading="interface", cache=cache)
    lower, upper = (
        build(Structure(body), at((0.02, 0.02, z), (0.03, 0.02, z), (0.04, 0.02, z))).sensor
        @ pressure.double().numpy().ravel()
        for z in body.interfaces[:2]
    )
    expected = 170e3 / 0.005 * 1e-4 * (np.array([0.5, 1, 0.5]) @ (upper - lower))
    assert skin(pressure).readings.item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("depth", "options", "says"),
    [
        (0.003, {}, r"sensor 1 lies 0.003 m deep.*0.005, 0 m.*depth_m.*simulator=solid"),
        (0.015, {}, r"sensor 1 lies 0.015 m deep"),
        (0.005, {"reading": "both"}, r"simulator.reading=both must be 'equation10' or 'interface'"),
        (0.005, {"constraint": "none"}, r"simulator.constraint=none must be 'vertical' or 'free'"),
    ],
)
def test_what_it_cannot_simulate_is_refused(depth, options, says, cache):
    body = Sheet([0.16, 0.16], [8, 8], LAYERS)
    with pytest.raises(InputError, match=says):
        PlatesAndBeams(body, at((0.08, 0.08, depth)), cache=cache, **options)


def test_a_mesh_too_fine_for_its_factors_is_refused_before_they_are_made(cache, monkeypatch):
    body = Sheet([0.16, 0.16], [400, 400], LAYERS)
    monkeypatch.setattr("psutil.virtual_memory", lambda: type("Memory", (), {"available": 4e9}))
    with pytest.raises(InputError, match=r"stiffness of body.cells=\[400,400\].*needs about .* GB"):
        PlatesAndBeams(body, at((0.08, 0.08, 0.005)), cache=cache)


STRUCTURE = Structure(Sheet([0.04, 0.03], [4, 3], [ECOFLEX]))
SENSORS = Sensors(np.array([[0.01, 0.02, 0.0], [0.03, 0.01, 0.0]]), (0.01, 0.01))


def same(first, second) -> bool:
    return all(np.array_equal(vars(first)[name], vars(second)[name]) for name in vars(first))


@pytest.fixture
def built(monkeypatch) -> list:
    calls: list = []

    def counted(*args):
        calls.append(args)
        return build(*args)

    monkeypatch.setattr(_operator, "build", counted)
    return calls


def stored(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def _rewrite(**changes):
    def damage(path: Path) -> None:
        with np.load(path) as file:
            arrays = dict(file)
        arrays |= {name: change(arrays[name]) for name, change in changes.items()}
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})

    return damage


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(content)


DAMAGE = {
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "a flipped byte": _flip,
    "another key": _rewrite(key=lambda _: np.array("0" * 64)),
    "a row missing": _rewrite(surface=lambda _: None),
    "another shape": _rewrite(sensor=lambda rows: rows[:, :-1]),
    "another type": _rewrite(sensor=lambda rows: rows.astype(np.float32)),
    "NaN": _rewrite(carried=lambda rows: rows * np.nan),
    "objects": _rewrite(sensor=lambda rows: rows.astype(object)),
    "a bare array": lambda path: np.save(path.open("wb"), np.zeros(3)),
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_file_that_is_not_right_is_rebuilt(damage, tmp_path, built):
    first = cached(STRUCTURE, SENSORS, tmp_path)
    damage(stored(tmp_path))
    assert same(cached(STRUCTURE, SENSORS, tmp_path), first)
    assert len(built) == 2
    assert same(cached(STRUCTURE, SENSORS, tmp_path), first)
    assert len(built) == 2


def other_body(**changes):
    return replace(STRUCTURE, body=replace(STRUCTURE.body, **changes)), SENSORS


LAYER = STRUCTURE.body.layers[0]
OTHERS = {
    "size": other_body(size=(0.04, 0.031)),
    "cells": other_body(cells=(3, 4)),
    "thickness": other_body(layers=(replace(LAYER, thickness=0.006),)),
    "young": other_body(layers=(replace(LAYER, material=replace(LAYER.material, young=1e5)),)),
    "poisson": other_body(layers=(replace(LAYER, material=replace(LAYER.material, poisson=0.3)),)),
    "constraint": (replace(STRUCTURE, constraint="free"), SENSORS),
    "positions": (STRUCTURE, replace(SENSORS, positions=SENSORS.positions + 1e-6)),
    "order": (STRUCTURE, replace(SENSORS, positions=SENSORS.positions[::-1])),
    "footprint": (STRUCTURE, replace(SENSORS, footprint=(0.01, 0.011))),
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS.keys())
def test_everything_it_depends_on_makes_another_file(other, tmp_path, built):
    cached(STRUCTURE, SENSORS, tmp_path)
    cached(*other, tmp_path)
    assert len(built) == len(list(tmp_path.iterdir())) == 2


def test_many_may_write_at_once(tmp_path):
    answers = []
    start = threading.Barrier(8)

    def work() -> None:
        start.wait()
        answers.append(cached(STRUCTURE, SENSORS, tmp_path))

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 8
    assert all(same(answer, answers[0]) for answer in answers)
    assert stored(tmp_path).suffix == ".npz"


BODIES = {
    "3x3, one layer": Sheet([0.03, 0.03], [3, 3], [ECOFLEX]),
    "6x5, flat cells, two layers": Sheet([0.05, 0.09], [6, 5], [DRAGON, ECOFLEX]),
    "3x6, wide cells, two layers": Sheet([0.16, 0.07], [3, 6], [DRAGON, ECOFLEX]),
    "5x4, three layers": Sheet([0.06, 0.05], [5, 4], [DRAGON, ECOFLEX, FOAM]),
    "4x4, stiff on soft": Sheet([0.04, 0.04], [4, 4], [FOAM, DRAGON]),
    "4x5, three layers": Sheet([0.06, 0.05], [4, 5], [DRAGON, ECOFLEX, FOAM]),
}
LOADS = ("one cell off the centre", "random")
# Every body with either constraint and with either load, and every constraint with either load.
CASES = [
    (name, constraint, LOADS[(number + turn) % 2])
    for number, name in enumerate(BODIES)
    for turn, constraint in enumerate(("vertical", "free"))
]


def load(body: Sheet, kind: str) -> np.ndarray:
    """Return a pressure (H, W), Pa, that is no mirror image of itself."""
    pressure = np.zeros(body.shape)
    if kind == "random":
        return np.random.default_rng(0).uniform(0, 1e5, body.shape)
    pressure[0, body.cells[0] - 2] = 8e4
    return pressure


def solved(structure: Structure, pressure: np.ndarray):
    model = build_model(structure, pressure)
    model.analyze_linear(check_stability=False)
    return model, displacements(model, structure)


@pytest.fixture(scope="module", params=CASES, ids=" ".join)
def case(request):
    name, constraint, kind = request.param
    structure = Structure(BODIES[name], constraint)
    pressure = load(structure.body, kind)
    return structure, pressure, *solved(structure, pressure)


def test_pynite_agrees_on_every_displacement_and_on_the_table(case):
    """Held nodes above the table take nothing vertically: what is pressed on comes out below."""
    structure, pressure, model, expected = case
    motion = spsolve(structure.stiffness(), structure.load() @ pressure.ravel())
    ours = motion.reshape(*structure.grid, -1)
    for position, dof in enumerate(structure.free):
        largest = np.abs(expected[..., dof]).max()
        assert largest > 0
        np.testing.assert_allclose(ours[..., position], expected[..., dof], rtol=0, atol=1e-6 * largest)
    table = sum(node.RxnFZ["Combo 1"] for name, node in model.nodes.items() if name.startswith("0,"))
    force = pressure.sum() * np.prod(structure.body.cell)
    assert table == pytest.approx(force, rel=1e-6)


def test_pynite_agrees_with_the_cached_operator_on_sensors_at_every_interface(case, tmp_path):
    """D_s, D_t and motion along x and y out of the file that the simulator works from, between nodes."""
    structure, pressure, _, expected = case
    body, count = structure.body, 7
    where = np.random.default_rng(1).uniform(0.05, 0.95, (count, 2)) * body.size
    levels = np.arange(count) % len(body.layers)
    sensors = Sensors(np.column_stack([where, np.array(body.interfaces)[levels]]), (0.01, 0.01))
    PlatesAndBeams(body, sensors, constraint=structure.constraint, cache=tmp_path)
    skin = PlatesAndBeams(body, sensors, constraint=structure.constraint, cache=tmp_path)
    lines = [np.linspace(0, body.size[axis], body.cells[axis] + 1) for axis in (1, 0)]

    def moved(dof: int, sign: int, levels: np.ndarray) -> np.ndarray:
        into = [RegularGridInterpolator(lines, sign * layer[..., dof]) for layer in expected]
        given = zip(levels, where[:, ::-1], strict=True)
        return np.array([into[level](position)[0] for level, position in given])

    top = np.full(count, len(body.layers) - 1)
    at_sensor, at_surface = moved(2, -1, levels), moved(2, -1, top)
    largest = np.abs(at_surface).max()
    for rows, answer in ((skin.operator.sensor, at_sensor), (skin.operator.surface, at_surface)):
        np.testing.assert_allclose(rows @ pressure.ravel(), answer, rtol=0, atol=1e-6 * largest)
    displacement = skin(torch.from_numpy(pressure)).displacement.numpy()
    np.testing.assert_allclose(displacement, np.stack([at_sensor, at_surface], axis=-1), atol=1e-5 * largest)
    if structure.constraint == "vertical":
        assert not skin.operator.along_x.any()
        assert not skin.operator.along_y.any()
        return
    answer = np.stack([moved(0, 1, levels), moved(1, 1, levels), at_sensor], axis=-1)
    rows = (skin.operator.along_x, skin.operator.along_y, skin.operator.sensor)
    for ours, theirs in zip(rows, answer.T, strict=True):
        largest = np.abs(theirs).max()
        assert largest > 0
        np.testing.assert_allclose(ours @ pressure.ravel(), theirs, rtol=0, atol=1e-6 * largest)
    motion = skin.double().motion(torch.from_numpy(pressure)).numpy()
    np.testing.assert_allclose(motion, answer, rtol=0, atol=1e-5 * np.abs(answer).max())


def build_model(structure: Structure, pressure: np.ndarray) -> FEModel3D:
    """Return a PyNite model of a sheet under pressure (H, W), Pa, ready to be analysed.

    Nodes are called ``interface,row,column``, with interface 0 on the table; z runs up from the table.
    """
    body = structure.body
    built = FEModel3D()
    _add_nodes(built, structure)
    for number, layer in enumerate(body.layers, start=1):
        _add_beams(built, structure, number)
        for row, column in np.ndindex(body.shape):
            corners = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
            names = [f"{number},{j},{i}" for j, i in corners]
            name = f"{number},{row},{column}"
            material = _add_material(built, f"plate {name}", layer.material)
            built.add_plate(name, *names, layer.thickness, material)
    for (row, column), value in np.ndenumerate(pressure):
        if value:
            built.add_plate_surface_pressure(f"{len(body.layers)},{row},{column}", -float(value))
    return built


def displacements(built: FEModel3D, structure: Structure) -> np.ndarray:
    """Return what each node above the table does, (layers, ny + 1, nx + 1, 6): m and rad, z upwards."""
    answer = np.zeros((*structure.grid, 6))
    for level, row, column in np.ndindex(structure.grid):
        node = built.nodes[f"{level + 1},{row},{column}"]
        for dof, name in enumerate(("DX", "DY", "DZ", "RX", "RY", "RZ")):
            answer[level, row, column, dof] = getattr(node, name)["Combo 1"]
    return answer


def _add_nodes(built: FEModel3D, structure: Structure) -> None:
    body = structure.body
    heights = [0.0, *(body.thickness - depth for depth in body.interfaces)]
    for level, height in enumerate(heights):
        held = [level == 0 or dof not in structure.free for dof in range(6)]
        for row, column in np.ndindex(structure.grid[1:]):
            name = f"{level},{row},{column}"
            built.add_node(name, column * body.cell[0], row * body.cell[1], height)
            built.def_support(name, *held)


def _add_material(built: FEModel3D, name: str, material: Material) -> str:
    built.add_material(name, material.young, material.shear, material.poisson, rho=1.0)
    return name


def _add_beams(built: FEModel3D, structure: Structure, number: int) -> None:
    """Join each node of an interface to the one below by the part of the sheet nearest to it."""
    body, layer = structure.body, structure.body.layers[number - 1]
    rows, columns = structure.grid[1:]
    for row, column in np.ndindex(rows, columns):
        width = body.cell[0] * (0.5 if column in {0, columns - 1} else 1)
        height = body.cell[1] * (0.5 if row in {0, rows - 1} else 1)
        second_y, second_x = width * height**3 / 12, height * width**3 / 12
        name = f"{number},{row},{column}"
        material = _add_material(built, f"beam {name}", layer.material)
        built.add_section(name, width * height, second_y, second_x, second_y + second_x)
        built.add_member(name, f"{number - 1},{row},{column}", name, material, name)
