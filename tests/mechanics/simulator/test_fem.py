"""Laws that the plates and beams obey, whatever their code."""

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import spsolve

from skin.body.base import Sensors, Sheet
from skin.body.layout import Scattered
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams, Structure, build

LAYERS = [
    {"material": "Dragon Skin 10 Medium", "thickness": 0.010},
    {"material": "EcoFlex 00-30", "thickness": 0.005},
]
THREE = [*LAYERS, {"material": {"name": "foam", "young": 40e3, "poisson": 0.2}, "thickness": 0.003}]


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


def test_uniform_pressure_deviates_at_free_edges_as_known():
    """The consistent corner moments have nothing to lean on at the edge: .89 to 1.03 at 32 cells."""
    structure = Structure(Sheet([0.16, 0.16], [32, 32], LAYERS))
    motion = spsolve(structure.stiffness(), structure.load().sum(axis=1))
    surface = -motion.reshape(*structure.grid, -1)[-1, ..., 0]
    fraction = surface / (0.010 / 560e3 + 0.005 / 170e3)
    assert fraction.min() == pytest.approx(0.889, abs=0.002)
    assert fraction.max() == pytest.approx(1.027, abs=0.002)


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


def test_interface_reading_feels_a_neighbour_and_equation_10_does_not(cache):
    body = Sheet([0.16, 0.16], [32, 32], LAYERS)
    beside = at((0.06, 0.08, 0.005))
    pressure = torch.zeros(body.shape)
    pressure[14:18, 14:18] = 1e5  # its nearest edge is 5 mm beside the footprint's
    assert PlatesAndBeams(body, beside, cache=cache)(pressure).readings == 0
    assert PlatesAndBeams(body, beside, reading="interface", cache=cache)(pressure).readings > 0.1


def test_interface_reading_is_the_force_of_the_beams_under_the_footprint(cache):
    """Two of a layer's beams and a half: E A / h times their shortening, by hand."""
    body = Sheet([0.06, 0.06], [6, 6], THREE)
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
