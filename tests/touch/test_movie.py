"""The movies of the default settings stay what the published numbers were computed from."""

import hashlib

import numpy as np
import pytest
import torch

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.core.rng import Stream, generator
from skin.device.touches import draw_timeline
from skin.mechanics.contact.prescribed import Prescribed
from skin.touch.gestures import GestureSettings, TouchSampler

BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
SENSORS = Grid(5, 5).sensors(BODY)


def content(movie):
    """Return a hash of movies, of whole numbers and of places to a micrometre: alike on every processor."""
    known = movie.parameters
    positions = torch.stack([known[name] for name in ("x", "y", "net_x", "net_y")]).double().numpy()
    whole = (movie.labels, movie.index, known["shape"], known["duration"], known["onset"], known["frames"])
    values = [values.numpy() for values in whole] + [np.round(1e6 * positions)]
    return hashlib.sha256(b"".join(one.astype(np.int64).tobytes() for one in values)).hexdigest()[:16]


@pytest.mark.parametrize(("padded", "expected"), [(True, "1dae3ead7e41041b"), (False, "1a29a25f89bf9452")])
def test_400_gestures_are_those_of_the_published_numbers(padded, expected):
    sampler = TouchSampler(BODY, BODY.footprints(SENSORS), Prescribed(), GestureSettings(), padded)
    movie = sampler.sample(400, generator(Stream.BUDGET, 0, 1))
    assert movie.index.shape == (400, 30)
    assert content(movie) == expected


def test_a_stream_is_that_of_the_published_numbers():
    sampler = TouchSampler(BODY, BODY.footprints(SENSORS), Prescribed(), GestureSettings())
    timeline = draw_timeline(sampler, 2000, (10, 60), generator(Stream.BUDGET, 0, 2))
    assert len(timeline.begin) > 30
    assert content(timeline.movie) == "0949cc88db13cbcf"
    assert timeline.begin[:6].tolist() == [49, 118, 158, 192, 239, 267]
