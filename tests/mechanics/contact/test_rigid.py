"""Contact from the command line on; gestures of rigid objects: their shape, their force, their labels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from skin.body.base import Arm, Sheet
from skin.body.layout import Grid
from skin.core.files import CONF
from skin.device.base import in_threads
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.mechanics.contact.rigid import Rigid, solids, solve_contact
from skin.mechanics.simulator.base import AbstractSimulator, Response
from skin.runs.build import build_device
from skin.touch.gestures import GestureSettings, TouchSampler
from skin.touch.movie import ContactProblem
from skin.touch.paths import Trajectories
from skin.touch.shapes import Pose, Shapes
from tests.mechanics.contact.test_unilateral import love
from tests.touch.movie_labels import movie_labels

BODY = Sheet([0.16, 0.16], [20, 20], [{"material": "EcoFlex 00-30", "thickness": 0.015}])
SENSORS = Grid(5, 5).sensors(BODY)
# A tenth as soft as the half-space, about as a layer glued to a table is.
COMPLIANCE = torch.from_numpy(love(BODY.shape, BODY.cell, 10 * BODY.layers[0].material.young))


class HalfSpace(AbstractSimulator):
    """A surface of known compliance, and nothing below it."""

    def forward(self, pressure: torch.Tensor, shear: torch.Tensor | None = None) -> Response:
        return Response(pressure.new_zeros(*pressure.shape[:-2], len(SENSORS)), None)

    def compliance(self) -> torch.Tensor:
        return COMPLIANCE


def rigid(**settings) -> Rigid:
    return Rigid(BODY, HalfSpace(), **settings)


def sampler(contact=None, **settings) -> TouchSampler:
    given = GestureSettings.of(settings)
    return TouchSampler(BODY, BODY.footprints(SENSORS), contact or Prescribed(), given)


def problem(**settings) -> ContactProblem:
    given = GestureSettings.of(settings)
    shapes = Shapes(given.shapes, BODY, given.thresholds.contact)
    return ContactProblem(shapes, torch.from_numpy(BODY.footprints(SENSORS)).float(), given)


def still(scale: float, peak: float = 50e3, fractions=(1.0,), wanted=(0, 0, 0, 0)) -> Trajectories:
    """Return one gesture of the first shape that stands still, at several shares of its force."""
    count = len(fractions)
    zeros, position = np.zeros(count, int), np.full((count, 2), 0.08)
    poses = Pose(zeros, np.zeros(count), np.full(count, scale), position, np.ones(count))
    shown = np.array(fractions), torch.arange(count)[None], torch.tensor([fractions])
    rest = np.zeros((count, 2)), np.zeros(1, int), np.zeros((1, 2)), np.zeros(1)
    return Trajectories(zeros, poses, *shown, np.array([peak]), np.array([wanted], bool), *rest)


@pytest.fixture(scope="module")
def sampled():
    source = sampler(rigid())
    return source, source.sample(64, np.random.default_rng(5))


def test_labels_are_what_the_movie_gives(sampled):
    """All but sliding: more of an object comes down as force grows, and the centre of pressure moves."""
    source, movie = sampled
    labels = movie_labels(movie.pressure(), source.footprints, BODY.cell)
    assert torch.equal(movie.labels[:, [0, 2, 3]], labels[:, [0, 2, 3]])
    assert torch.equal(movie.labels[:, 1] > 0.5, movie.parameters["speed"] > 0)
    counts = torch.unique(movie.labels, dim=0, return_counts=True)[1]
    assert counts.tolist() == [4] * 16


def test_every_frame_of_a_movie_is_at_rest(sampled):
    """The surface under pressure follows the object: gaps differ from the picture's by one number."""
    contact = sampled[0].contact
    trajectories = still(0.05, fractions=(1.0, 0.5, 0.2))
    gap = contact.gap(trajectories, problem()).double()
    surface = contact.compliance.double()
    pressed = contact.press(trajectories, problem())
    assert not pressed.refused.any()
    pressure = (pressed.frames * torch.tensor([1.0, 0.5, 0.2])[:, None, None]).flatten(1).double()
    height = pressure @ surface + gap
    for one, heights in zip(pressure, height, strict=True):
        touched = one > 0
        deepest = (one @ surface).max()
        assert np.ptp(heights[touched].numpy()) < 4e-4 * deepest
        assert heights[~touched].min() > heights[touched].mean() - 2e-4 * deepest


def test_white_touches_first_and_the_outline_is_an_arc():
    contact = rigid(relief=0.01, fillet=0.0)
    shapes = problem(shapes=["blurred_disc"])
    gap = contact.gap(still(0.06), shapes)[0]
    grey = solids(shapes.shapes, still(0.06).poses)
    inside = grey.inside[0].flatten()
    expected = 0.01 * (1 - grey.grey[0].flatten()[inside])
    torch.testing.assert_close(gap[inside], expected - expected.min())
    assert gap[~inside].isinf().all()

    square = problem(shapes=["square"])
    trajectories = still(0.06)
    gap = rigid(relief=0.0, fillet=0.02).gap(trajectories, square)[0].view(BODY.shape)
    row = gap[10][gap[10].isfinite()]
    rim = np.minimum(np.arange(len(row)), np.arange(len(row))[::-1]) * BODY.cell[0]
    # The outline lies within a cell of the first one inside.
    for start in (0.0, BODY.cell[0]):
        arc = 0.02 - np.sqrt(0.02**2 - np.clip(0.02 - rim - start, 0, 0.02) ** 2)
        assert ((row.numpy() <= arc + 1e-6) if start == 0 else (row.numpy() >= arc - 1e-6)).all()


def rounded(compliance: torch.Tensor, seed: int) -> torch.Tensor:
    """Return what another processor may make of a compliance: noise of 1e-12 to 1e-7, or fewer digits."""
    if seed < 4:  # so few that sums are exact, whatever their order
        unit = 2.0 ** (torch.log2(compliance.max()).floor() - 8 - 2 * seed)
        return (compliance / unit).round() * unit
    noise = np.random.default_rng(seed).standard_normal(compliance.shape)
    size = 10.0 ** (-12 + seed % 6)
    return (compliance.double() * (1 + size * torch.from_numpy(noise + noise.T))).float()


@pytest.mark.parametrize("wanted", [(1, 0, 0, 0), (1, 0, 0, 1), (0, 0, 0, 1)])
def test_rounding_decides_nothing(wanted):
    """The same force, class by class, on every processor; the fewest digits move it by their own size."""
    where = problem(shapes=["blurred_disc"])
    low = (where.settings.dangerous_peak if wanted[3] else where.settings.safe_peak)[0]
    stroke = still(0.065 if wanted[0] else 0.03, peak=low, wanted=wanted)
    contact = rigid(relief=0.002)
    exact, forces = contact.compliance, []
    for seed in range(16):
        contact.compliance = rounded(exact, seed)
        pressed = contact.press(stroke, where)
        assert not pressed.refused.any(), seed
        labels = movie_labels(pressed.frames[None], where.footprints, BODY.cell)[0, [0, 3]]
        assert labels.tolist() == [wanted[0], wanted[3]], seed
        forces.append(pressed.force.item())
    assert forces == pytest.approx([forces[-1]] * 16, rel=0.02)
    assert forces[4:] == pytest.approx([forces[-1]] * 12, rel=1e-4)


@pytest.mark.parametrize("maximum", [82.7e3, 83.2e3, 83.4e3])
def test_the_end_of_a_range_is_tried_itself(maximum):
    """The ball is big from 82.5 kPa on: wherever the search begins, it must not stop a little below that."""
    where, contact = problem(shapes=["blurred_disc"]), rigid(relief=0.002)
    settings = replace(where.settings, safe_peak=(10e3, 1.03 * maximum))
    for peak in np.linspace(10e3, 80e3, 9):
        stroke = still(0.065, peak=peak, wanted=(1, 0, 0, 0))
        assert not contact.press(stroke, where._replace(settings=settings)).refused.any(), peak


def test_frames_that_do_not_converge_are_reported_and_not_used():
    hasty = sampler(rigid(iterations=5))
    with pytest.warns(RuntimeWarning, match=r"\d+ frames did not converge to contact.tolerance"):
        movie = hasty.sample(16, np.random.default_rng(5))
    assert movie.parameters["unconverged"].sum() > 0


def test_the_same_seed_gives_the_same_movies_on_any_number_of_threads(sampled):
    source = sampled[0]

    def draw(number: int):
        return source.sample(4, np.random.default_rng(number))

    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = in_threads(draw, 2)
        torch.set_num_threads(2)
        two = in_threads(draw, 2)
    finally:
        torch.set_num_threads(threads)
    for first, second in zip(one, two, strict=True):
        assert torch.equal(first.pressure(), second.pressure())
        assert torch.equal(first.labels, second.labels)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"relief": -0.001}, r"contact\.relief=-0.001 must be"),
        ({"tolerance": 1e-9}, r"contact\.tolerance=1e-09 must be greater than or equal to 0.00001"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        rigid(**settings)


def test_the_skin_of_an_arm_falls_away_below_a_stamp():
    """By radius (1 - cos(x / radius)) at x around the arm from the middle of the contact."""
    arm = Arm(radius=0.05, length=0.16, angle=3.2, cells=(20, 20), layers=BODY.layers)
    flat = Rigid(arm, HalfSpace(), relief=0.0, fillet=0.0)
    stamp = still(0.06)
    given = problem(shapes=["square"])
    shapes = Shapes(("square",), arm, given.settings.thresholds.contact)
    gap = flat.gap(stamp, given._replace(shapes=shapes))[0].view(20, 20)
    assert (gap == gap[10:11])[gap.isfinite()].all()
    row = gap[10]
    inside = row.isfinite().numpy()
    away = (np.arange(20) + 0.5) * 0.008
    away = np.abs(away - away[inside].mean())
    expected = 0.05 * (1 - np.cos(away[inside] / 0.05))
    assert inside.sum() >= 10
    assert row[inside].numpy() == pytest.approx(expected - expected.min(), abs=1e-7)
    assert flat.gap(stamp, given).isinf().sum() == gap.isinf().sum()


OPTIONS = sorted(path.stem for path in (CONF / "contact").glob("*.yaml"))
SMALL = ("body.cells=[12,12]", "layout=grid", "data.gestures=16", "device.test_gestures=16")
SOLID = ("simulator=solid", "simulator.divisions=1")


@pytest.fixture(scope="module", params=OPTIONS)
def device(request, configured):
    return build_device(configured(f"contact={request.param}", *SOLID, *SMALL))


@pytest.mark.parametrize(("gap", "total"), [(0.0, -1.0), (float("inf"), 1.0), (0.0, float("nan"))])
def test_what_no_pressure_solves_is_refused(gap, total):
    with pytest.raises(InputError, match="solve_contact takes"):
        solve_contact(torch.eye(2), torch.full((1, 2), gap), torch.tensor([total]))


def test_touches_are_made_of_pressures_that_carry_their_force(device):
    movie = device.sampler.sample(16, np.random.default_rng(0))
    width, height = device.body.cell
    force = movie.pressure().sum((2, 3)) * width * height
    torch.testing.assert_close(force, movie.force, rtol=1e-3, atol=1e-3)
    assert (movie.frames >= 0).all()


@pytest.mark.parametrize("simulator", ["naive", "fem"])
def test_rigid_objects_need_a_surface_that_gives_way(configured, simulator):
    match = f"simulator={simulator}: set simulator=solid, or contact=prescribed"
    with pytest.raises(InputError, match=match):
        build_device(configured("contact=rigid", f"simulator={simulator}"))
