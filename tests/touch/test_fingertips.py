"""Fingertips press where their contacts say, as hard as they say, and are labelled by what they do."""

import numpy as np
import pytest
import torch

from skin.body.arm import Arm
from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.fingertips import FingertipSampler, FingertipSettings
from skin.touch.labels import Limits, Thresholds
from tests.touch.movie_labels import movie_labels

LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
BODIES = {
    "sheet": Sheet([0.16, 0.16], [64, 64], LAYER),
    "oblong": Sheet([0.20, 0.12], [50, 36], LAYER),
    "arm": Arm(radius=0.05, length=0.2, angle=2.4, cells=[40, 64], layers=LAYER),
}


def sampler(body=BODIES["sheet"], padded=True, **settings) -> FingertipSampler:
    footprints = body.footprints(Grid(3, 3).sensors(body))
    return FingertipSampler(body, footprints, Prescribed(), FingertipSettings(**settings), padded)


@pytest.fixture(scope="module", params=BODIES)
def sampled(request):
    """A sampler, its movie, the dense pressure and the contacts, whose absent ones are 0."""
    source = sampler(BODIES[request.param], limits=Limits(90.5e3, tap_pressure=90.5e3, human_force=20.0))
    movie = source.sample(160, np.random.default_rng(3))
    return source, movie, movie.pressure().double(), movie.contacts.double().nan_to_num(0)


def test_the_pressure_is_that_of_the_contacts(sampled):
    source, movie, pressure, contacts = sampled
    width, height = source.body.cell
    x, y, _, force, _ = contacts.unbind(-1)
    np.testing.assert_allclose(pressure.sum((2, 3)) * width * height, force.sum(2), atol=1e-4)
    np.testing.assert_allclose(movie.force, force.sum(2), rtol=1e-5)
    cells = zip(source.body.cells, (width, height), strict=True)
    along, down = ((torch.arange(count) + 0.5).double() * size for count, size in cells)
    touched = force.sum(2) > 0
    for moments, positions in ((pressure.sum(2) @ along, x), (pressure.sum(3) @ down, y)):
        middle = moments * width * height / force.sum(2)
        expected = (positions * force).sum(2) / force.sum(2)
        assert (middle - expected)[touched].abs().max() < 0.1 * max(width, height)


def test_contacts_are_within_their_ranges(sampled):
    source, movie, _, _ = sampled
    settings = source.settings
    assert movie.force.max() <= settings.danger.human_force
    contacts = movie.contacts.double()
    x, y, radius, force, peak = contacts[~contacts[..., 0].isnan()].unbind(-1)
    assert settings.radius[0] <= radius.min() * (1 + 1e-6)
    assert radius.max() <= settings.radius[1] * (1 + 1e-6)
    mean = force / (torch.pi * radius**2)
    assert mean.max() <= settings.pressure * (1 + 1e-5)
    # The rim of the disc is softened over one of the picture's 96 pixels.
    assert (peak / mean).numpy() == pytest.approx(1.0, abs=0.02)
    full = (contacts[..., 3] / movie.scale[..., None]).nan_to_num(1e9)
    assert full.min() >= settings.force * (1 - 1e-5)
    width, height = source.body.size
    assert ((x >= radius - 1e-6) & (x <= width - radius + 1e-6)).all()
    assert ((y >= radius - 1e-6) & (y <= height - radius + 1e-6)).all()


def test_fingertips_are_apart(sampled):
    source, movie, _, _ = sampled
    x, y, radius, _, _ = movie.contacts.double().unbind(-1)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        gap = torch.hypot(x[..., first] - x[..., second], y[..., first] - y[..., second])
        gap -= radius[..., first] + radius[..., second]
        assert gap[~gap.isnan()].min() >= source.settings.apart - 1e-6


def test_labels_are_what_the_movie_gives_and_balanced(sampled):
    source, movie, pressure, _ = sampled
    assert torch.equal(movie_labels(pressure.float(), source.footprints, source.body.cell), movie.labels)
    codes = movie.labels[:, 1:3].numpy() @ [1, 2]
    assert np.bincount(codes.astype(int), minlength=4).tolist() == [40] * 4
    assert not movie.labels[:, 0].any()


def test_the_same_seed_is_the_same_movie_and_redraws_change_no_other_touch():
    movies = [sampler().sample(24, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert torch.equal(movies[0].pressure(), movies[1].pressure())
    assert not torch.equal(movies[0].force, movies[2].force)
    # A path of 1.2 mm that turns at an edge goes no millimetre away: some draws are not dynamic.
    picky = sampler(path=0.0012, speed=(0.006, 0.006), tap=(0.3, 0.3))
    movie = picky.sample(200, np.random.default_rng(0))
    draws = movie.parameters["draws"]
    assert draws.max() > 1
    kept = draws == 1
    first = picky._draw(picky.balanced(200, random := np.random.default_rng(0)), random, np.arange(200), 1)
    assert torch.equal(movie.contacts[kept].nan_to_num(0), first.contacts[kept].nan_to_num(0))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"force": 20.0}, r"touch.force=20 N is more than the 6.53 N"),
        ({"contacts": (0, 2)}, r"touch.contacts=\[0, 2\] must be greater than 0"),
        ({"contacts": (3, 2)}, r"touch.contacts=\[3, 2\] must be a range"),
        ({"radius": (0.01, 0.004)}, r"touch.radius=\[0.01, 0.004\] must be a range"),
        ({"tap": (0.5, 0.6)}, r"touch.tap=\[0.5, 0.6\] s gives"),
        ({"thresholds": Thresholds(travel=0.5)}, r"no touch of fingertips in 30 draws was dynamic"),
        ({"radius": (0.03, 0.03)}, r"no room for 3 fingertips of touch.radius=\[0.03, 0.03\] m"),
        ({"shapes": ("potato",)}, r"no shape potato"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(settings, message):
    with pytest.raises(InputError, match=message):
        sampler(BODIES["oblong"], **settings).sample(32, np.random.default_rng(0))


def test_rigid_fingertips_are_refused():
    rigid = type("Rigid", (), {"proportional": False})()
    with pytest.raises(InputError, match="contact=prescribed, or touch=gestures"):
        FingertipSettings().sampler(BODIES["sheet"], np.zeros((1, 4096)), rigid, True, None)
