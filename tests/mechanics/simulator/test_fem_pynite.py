"""PyNite, a finite-element program of others, as the referee of the plates and beams."""

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import spsolve

from skin.body.base import Sensors, Sheet
from skin.mechanics.simulator.fem import PlatesAndBeams, Structure
from tests.mechanics import pynite_model

DRAGON = {"material": "Dragon Skin 10 Medium", "thickness": 0.010}
ECOFLEX = {"material": "EcoFlex 00-30", "thickness": 0.005}
FOAM = {"material": {"name": "foam", "young": 40e3, "poisson": 0.2}, "thickness": 0.003}
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
    model = pynite_model.model(structure, pressure)
    pynite_model.solve(model)
    return model, pynite_model.displacements(model, structure)


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
