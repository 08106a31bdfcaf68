"""A second gesture at the same time, beside the first: sums of two movies of gestures."""

import numpy as np
import torch
from torch import Tensor

from skin.touch.movie import Movie

_LARGEST = ("peak", "area", "travel", "frames", "pressure")


def add_second(movie: Movie, share: float, contact: float, generator: np.random.Generator) -> Movie:
    """Return gestures of which a share has another gesture of the movie added.

    The second gesture overlaps the first in time, nowhere on the sheet, and has no label that the first does
    not have. The sum then keeps the labels of the first: a label holds if it holds for one of the two.
    A gesture that leaves no room for any other of the movie stays alone. The second one ends in the window.

    Args:
        movie: gestures (B,), whose pressures add up; without friction.
        share: of the gestures that get a second one, 0 to 1.
        contact: share of a frame's peak above which a cell is in contact.
        generator: source of randomness.

    Returns:
        The gestures (B,). The parameter ``contacts`` is the number of gestures at a time, 1 or 2; onset and
        duration are those of both together, force and the measures the largest.
    """
    first = torch.from_numpy(np.flatnonzero(generator.random(len(movie)) < share))
    chance = torch.from_numpy(generator.random((len(first), len(movie) + 1)))
    whole = movie.parameters["onset"] + movie.parameters["duration"] <= movie.index.shape[1]
    kept = (movie.labels <= movie.labels[first][:, None]).all(dim=2)
    allowed = whole & kept & _apart(movie, first, contact)
    score, second = chance[:, :-1].where(allowed, -1).max(dim=1)
    first, second, moment = first[score >= 0], second[score >= 0], chance[score >= 0, -1]
    begin, times = _overlapping(movie, first, second, moment)

    shares = movie.scale[first], movie.scale[second].gather(1, times)
    index = movie.index[first], movie.index[second].gather(1, times)
    full = movie.parameters["force"][:, None]
    total = full[first] * shares[0] + full[second] * shares[1]
    force = total.amax(dim=1)
    scale = total / force[:, None]
    touched = scale > 0
    parts = (
        part[touched][:, None, None] * movie.frames[rows[touched]]
        for part, rows in zip(shares, index, strict=True)
    )
    frames = sum(parts) / scale[touched][:, None, None]
    counts = touched.sum(dim=1)
    column = (touched.cumsum(dim=1) - 1).clamp(min=0) + (counts.cumsum(0) - counts)[:, None]

    parameters = {name: values.clone() for name, values in movie.parameters.items()}
    parameters["contacts"] = torch.ones(len(movie)).index_fill_(0, first, 2)
    for name in _LARGEST:
        parameters[name][first] = torch.maximum(parameters[name][first], movie.parameters[name][second])
    onset = torch.minimum(movie.parameters["onset"][first], begin.float())
    parameters["onset"][first], parameters["duration"][first] = onset, counts.float()
    parameters["force"][first] = force
    indices, scales = movie.index.clone(), movie.scale.clone()
    indices[first], scales[first] = column + len(movie.frames), scale
    sums = Movie(torch.cat([movie.frames, frames]), indices, scales, movie.labels, parameters)
    return sums[torch.arange(len(movie))]  # without the frames of first gestures alone


def _apart(movie: Movie, first: Tensor, contact: float) -> Tensor:
    """Return whether gestures never touch a cell that the ``first`` (N,) touch, (N, B), bool."""
    owner = torch.zeros(len(movie.frames), dtype=torch.long)
    owner[movie.index.flatten()] = torch.arange(len(movie)).repeat_interleave(movie.index.shape[1])
    flat = movie.frames.flatten(1)
    pressed = (flat > contact * flat.amax(dim=1, keepdim=True)).float()
    covered = torch.zeros(len(movie), flat.shape[1]).index_add_(0, owner, pressed).clamp_(max=1)
    return covered[first] @ covered.T == 0


def _overlapping(movie: Movie, first: Tensor, second: Tensor, moment: Tensor) -> tuple[Tensor, Tensor]:
    """Return when the second gestures begin, (N,), and what frame of theirs is at each time, (N, T).

    Args:
        movie: the gestures.
        first, second: (N,), the gestures that overlap.
        moment: (N,), 0 to 1, of the begins that make them overlap within the window.
    """
    window = movie.index.shape[1]
    onset, duration = (movie.parameters[name].long() for name in ("onset", "duration"))
    earliest = (onset[first] - duration[second] + 1).clamp(min=0)
    latest = torch.minimum(onset[first] + duration[first] - 1, window - duration[second])
    begin = earliest + (moment * (latest - earliest + 1)).long()
    return begin, (torch.arange(window) - (begin - onset[second])[:, None]) % window
