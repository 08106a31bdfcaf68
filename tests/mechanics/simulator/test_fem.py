"""Laws that the plates and beams obey, whatever their code."""

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import spsolve
from scipy.special import erf

from skin.body.base import Sensors, Sheet
from skin.body.layout import Grid, Scattered
from skin.errors import InputError
from skin.mechanics.simulator.fem import PlatesAndBeams, Structure, build
from skin.mechanics.simulator.naive import Naive

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


def gaussian(body: Sheet, width: float = 0.015) -> np.ndarray:
    """Return cell means (H * W,) of a Gaussian of 90.5 kPa in the middle: the same force on any mesh."""
    along = []
    for axis in (0, 1):
        edges = np.linspace(-0.5, 0.5, body.cells[axis] + 1) * body.size[axis] / (2**0.5 * width)
        along.append(np.diff(erf(edges)) / np.diff(edges) * np.pi**0.5 / 2)
    return 90.5e3 * np.outer(along[1], along[0]).ravel()


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


def test_the_share_that_reaches_a_sensor_lies_in_its_known_range(default):
    response = default(touches(Sheet([0.16, 0.16], [32, 32], LAYERS), 500))
    sensor, surface = response.displacement[response.readings > 0].T
    fraction = sensor / surface
    assert len(fraction) > 1000
    assert 0.19 < fraction.min() < 0.25
    assert 0.60 < fraction.max() < 0.80


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
    skin = PlatesAndBeams(
        body, at((0.03, 0.02, 0.003), footprint=(0.02, 0.01)), reading="interface", cache=cache
    )
    lower, upper = (
        build(Structure(body), at((0.02, 0.02, z), (0.03, 0.02, z), (0.04, 0.02, z))).sensor
        @ pressure.double().numpy().ravel()
        for z in body.interfaces[:2]
    )
    expected = 170e3 / 0.005 * 1e-4 * (np.array([0.5, 1, 0.5]) @ (upper - lower))
    assert skin(pressure).readings.item() == pytest.approx(expected, rel=1e-5)


def refined(cells: int) -> np.ndarray:
    """Return D_s and D_t under the middle of a 15 mm Gaussian, m."""
    body = Sheet([0.16, 0.16], [cells, cells], LAYERS)
    operator = build(Structure(body), at((0.08, 0.08, 0.005)))
    pressure = gaussian(body)
    return np.concatenate([operator.sensor @ pressure, operator.surface @ pressure])


def test_refinement_shrinks_the_differences():
    """The surface's motion on these meshes is that of an independent prototype, 3.19, 3.56 and 3.89 mm."""
    answers = np.array([refined(cells) for cells in (16, 32, 64)])
    steps = np.abs(np.diff(answers, axis=0))
    assert (steps[1] < steps[0]).all()
    np.testing.assert_allclose(answers[:, 1], [3.19e-3, 3.56e-3, 3.89e-3], atol=0.005e-3)


@pytest.mark.slow("solves for 128 x 128 cells")
def test_64_cells_are_within_5_percent_of_128_and_the_default_is_as_its_docstring_says():
    default, fine, finer = (refined(cells) for cells in (32, 64, 128))
    np.testing.assert_allclose(fine, finer, rtol=0.05)
    sensor, surface = default / finer
    assert (sensor, surface, sensor / surface) == pytest.approx((0.84, 0.89, 0.95), abs=0.006)


def test_a_sensor_sinks_as_far_as_its_displacement_says(cache):
    body = Sheet([0.16, 0.12], [10, 8], LAYERS)
    skin = PlatesAndBeams(body, Grid(3, 4).sensors(body), constraint="free", cache=cache)
    pressure = torch.rand(2, *body.shape, generator=torch.Generator().manual_seed(0))
    motion = skin.motion(pressure)
    assert motion.shape == (2, 12, 3)
    torch.testing.assert_close(motion[..., 2], skin(pressure).displacement[..., 0])
    torch.testing.assert_close(skin.motion(3 * pressure), 3 * motion)


def test_what_does_not_move_along_the_sheet_says_so(cache):
    body = Sheet([0.16, 0.16], [8, 8], LAYERS)
    held = PlatesAndBeams(body, at((0.08, 0.08, 0.005)), cache=cache)
    with pytest.raises(InputError, match=r"simulator\.constraint=vertical: set simulator\.constraint=free"):
        held.motion(torch.zeros(body.shape))
    with pytest.raises(InputError, match=r"simulator=naive: set simulator=fem simulator\.constraint=free"):
        Naive(body, at((0.08, 0.08, 0.005))).motion(torch.zeros(body.shape))


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
