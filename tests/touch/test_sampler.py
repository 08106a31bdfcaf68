"""Movies of sampled gestures, looked at frame by frame."""

from itertools import groupby

import numpy as np
import pytest
import torch
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import cross_val_score

from skin.body.layout import Scattered
from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.gestures import GestureSettings, TouchSampler
from skin.touch.movie import balanced

LAYER = [{"material": "EcoFlex 00-30", "thickness": 0.005}]
SHEETS = {"default": Sheet([0.16, 0.16], [32, 32], LAYER), "oblong": Sheet([0.20, 0.12], [25, 18], LAYER)}


def sampler(body: Sheet, **settings) -> TouchSampler:
    padded = settings.pop("padded", True)
    sensors = Scattered(5, 5, seed=0).sensors(body)
    return TouchSampler(body, body.footprints(sensors), Prescribed(), GestureSettings.of(settings), padded)


@pytest.fixture(scope="module", params=SHEETS)
def sampled(request):
    source = sampler(SHEETS[request.param])
    movie = source.sample(160, np.random.default_rng(5))
    return source, movie, movie.pressure().double().numpy()


def centres(frames: torch.Tensor, body: Sheet) -> torch.Tensor:
    """Return the centres of pressure, m, of frames (N, H, W), (N, 2)."""
    frames, cells = frames.double(), zip(body.cells, body.cell, strict=True)
    x, y = ((torch.arange(count) + 0.5) * cell for count, cell in cells)
    moments = [(frames.sum(1) * x).sum(1), (frames.sum(2) * y).sum(1)]
    return torch.stack(moments, 1) / frames.sum((1, 2))[:, None]


def test_labels_are_what_the_movie_gives(sampled):
    """Recomputed from the dense movie alone, gesture by gesture, straight from the report's sentences."""
    source, movie, pressure = sampled
    weights = source.footprints.double().numpy()
    for gesture, labels in zip(pressure, movie.labels.bool().tolist(), strict=True):
        contact = gesture > 0.02 * gesture.max()
        big = contact.mean((1, 2)).max() > 0.30
        touched = contact.any((1, 2))
        centre = centres(torch.from_numpy(gesture[touched]), source.body)
        dynamic = (centre - centre[0]).norm(dim=1).max() > 1e-3
        dangerous = (gesture.reshape(len(gesture), -1) @ weights.T).max() > 90.5e3
        longest = max(len(list(run)) for on, run in groupby(touched) if on)
        assert [big, dynamic, longest > 3, dangerous] == labels


@pytest.mark.parametrize("count", [1, 15, 100, 2350])
def test_counts_of_combinations_differ_by_one_at_most(count):
    codes = balanced(count, np.random.default_rng(0)) @ [1, 2, 4, 8]
    counts = np.bincount(codes, minlength=16)
    assert counts.sum() == count
    assert np.ptp(counts) <= 1


def test_force_rises_over_a_third_and_falls_over_a_third(sampled):
    _, movie, _ = sampled
    for fraction, duration in zip(movie.scale, movie.parameters["duration"].int().tolist(), strict=True):
        profile = fraction[fraction > 0]
        ramp = duration // 3
        assert len(profile) == duration
        assert (profile[ramp : duration - ramp] == 1).all()
        assert (profile[:ramp].diff() > 0).all()
        torch.testing.assert_close(profile, profile.flip(0))


def test_sliding_is_straight_and_as_fast_as_drawn():
    """On a large sheet, where nothing is reflected within a few frames of the middle."""
    body = Sheet([1.0, 1.0], [200, 200], LAYER)
    settings = GestureSettings(tap=(0.1, 0.3), shapes=("fingertip",))
    source = TouchSampler(body, np.full((1, 40000), 1 / 40000), Prescribed(), settings)
    wanted = np.tile([False, True, False, False], (40, 1))
    movie = source.sample(40, np.random.default_rng(0), wanted)
    centre = centres(movie.frames, body)[movie.index]
    speed, direction = movie.parameters["speed"], movie.parameters["direction"]
    step = speed[:, None] * torch.stack([direction.cos(), direction.sin()], 1)
    moved = [one[fraction > 0].diff(dim=0) for one, fraction in zip(centre, movie.scale, strict=True)]
    inner = [(one - way).abs().max() < 1e-3 for one, way in zip(moved, step, strict=True)]
    assert sum(inner) >= 30


def test_drawn_area_classes_hold_as_measured(sampled):
    _, movie, _ = sampled
    cells = movie.parameters["area"] * movie.frames[0].numel()
    sheet, big = movie.frames[0].numel(), movie.labels[:, 0] == 1
    # Cells at the rim are in or out, so a shape that covers 1 or 70 % may cover some cells less or more.
    assert 0.01 * sheet - 4 <= cells[~big].min()
    assert cells[~big].max() <= 0.30 * sheet < cells[big].min()
    assert cells[big].max() <= 0.75 * sheet


def test_windows_that_end_during_a_touch_are_labelled_by_what_they_show():
    settings = {"ongoing": 0.5, "press": [0.4, 2.8]}
    source, padded = (sampler(SHEETS["default"], **settings, padded=padded) for padded in (True, False))
    movie = source.sample(1600, np.random.default_rng(5))
    onset, duration, frames = (movie.parameters[name] for name in ("onset", "duration", "frames"))
    rest = 30 - onset - duration  # frames after the touch
    cut = rest < 0
    assert 0.15 < cut.float().mean() < 0.3
    assert (rest <= 3).float().mean() > 0.5
    torch.testing.assert_close(frames, torch.minimum(duration, 30 - onset))
    assert torch.equal(movie.labels[:, 2] == 1, frames > 3)
    sensors = movie.pressure().flatten(2) @ source.footprints.T
    assert torch.equal(movie.labels[:, 3] == 1, sensors.amax(dim=(1, 2)) > 90.5e3)
    peak = movie.scale.amax(dim=1)
    assert (peak[cut] < 1).any()  # before their highest force
    assert torch.equal(peak[~cut], torch.ones(int((~cut).sum())))
    assert (movie.labels.mean(dim=0) == 0.5).all()
    assert (padded.sample(160, np.random.default_rng(5)).parameters["onset"] == 0).all()


def test_a_combination_that_never_occurs_is_refused():
    body = SHEETS["default"]
    blind = np.zeros((1, 1024))
    source = TouchSampler(body, blind, Prescribed(), GestureSettings(redraws=1))
    with pytest.raises(InputError, match=r"no gesture in .* draws was .*dangerous"):
        source.sample(16, np.random.default_rng(0))


def test_nothing_but_the_path_gives_dynamic_away():
    """Duration, onset, shape and area predict it no better than .60; a tap of one frame cannot slide."""
    movie = sampler(SHEETS["default"]).sample(2000, np.random.default_rng(0))
    known = torch.stack([movie.parameters[name] for name in ("duration", "onset", "shape", "area")], 1)
    booster = HistGradientBoostingClassifier(max_iter=60, random_state=0)
    score = cross_val_score(booster, known.numpy(), movie.labels[:, 1].numpy(), cv=5).mean()
    assert score <= 0.60


def test_drag_follows_the_centre_of_pressure():
    """Seen in the frames alone: the shear points from where the pressure was to where it is."""
    source = sampler(SHEETS["default"], shear=0.5)
    movie = source.sample(96, np.random.default_rng(3))
    size = torch.linalg.vector_norm(movie.shear, dim=1)
    dynamic = movie.labels[:, 1] == 1
    for index, scale, slides in zip(movie.index, movie.scale, dynamic.tolist(), strict=True):
        shown = index[scale > 0]
        if not slides:
            assert (size[shown] == 0).all()
            continue
        steps = centres(movie.frames[shown], source.body).diff(dim=0)
        far = torch.linalg.vector_norm(steps, dim=1) > 2e-3
        # Rendering on cells of 5 mm moves a centre by parts of a millimetre.
        cosine = torch.cosine_similarity(steps, movie.shear[shown][1:].double())
        assert (cosine[far] > 0.97).all()
        torch.testing.assert_close(size[shown], torch.full((len(shown),), 0.5))


def test_net_is_from_the_first_place_to_the_last(sampled):
    """The centre of pressure of a rigid shape moves as its place does; cells of 5 to 8 mm blur it."""
    source, movie, _ = sampled
    moved = []
    for index, scale in zip(movie.index, movie.scale, strict=True):
        first, last = centres(movie.frames[index[scale > 0][[0, -1]]], source.body)
        moved.append(last - first)
    net = torch.stack([movie.parameters["net_x"], movie.parameters["net_y"]], dim=1)
    torch.testing.assert_close(net, torch.stack(moved).float(), atol=2e-3, rtol=0)
