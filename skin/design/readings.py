"""The readings that sampled touches give at any sites of a skin, and their covariance."""

import sys
from collections.abc import Callable, Iterator

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from skin.device._truth import modelled
from skin.device.base import AbstractSimulated
from skin.rng import Stream, generator
from skin.sensors import Sensors
from skin.touch.movie import Movie
from skin.touch.sampler import balanced

_BATCH = 256


def reading_covariance(
    device: AbstractSimulated, sensors: Sensors, touches: int, seed: int, clip: float
) -> tuple[np.ndarray, int]:
    """Return the covariance of the readings of sampled touches, and from how many frames it is.

    Args:
        device, sensors, touches, seed, clip: as of :func:`sampled_readings`.

    Returns:
        covariance (C, C), N^2, and the number of frames.
    """
    total, squares, frames = np.zeros(len(sensors)), np.zeros((len(sensors), len(sensors))), 0
    for readings in sampled_readings(device, sensors, touches, seed, clip):
        total, squares = total + readings.sum(axis=0), squares + readings.T @ readings
        frames += len(readings)
    mean = total / frames
    return squares / frames - np.outer(mean, mean), frames


@torch.no_grad()
def sampled_readings(
    device: AbstractSimulated, sensors: Sensors, touches: int, seed: int, clip: float
) -> Iterator[np.ndarray]:
    """Sample touches and yield their true readings in parts, (F, C), N.

    Only frames with contact count. Labels are balanced. The touches belong to no split of the device.

    Args:
        device: samples and simulates the touches.
        sensors: C sites.
        touches: their number.
        seed: of the touches.
        clip: largest reading, N.
    """
    read = _reader(device, sensors)
    wanted = balanced(touches, generator(Stream.PLACEMENT, seed, 0))
    parts = range(0, touches, _BATCH)
    console, shown = Console(stderr=True), sys.stderr.isatty()
    for number, first in enumerate(track(parts, "sampling touches", console=console, disable=not shown)):
        labels = wanted[first : first + _BATCH]
        movie = device.sampler.sample(len(labels), generator(Stream.PLACEMENT, seed, 1 + number), labels)
        yield read(movie).clamp(-clip, clip).double().numpy()


def _reader(device: AbstractSimulated, sensors: Sensors) -> Callable[[Movie], Tensor]:
    """Return a function that gives the readings (F, C), N, of all frames with contact of a movie."""
    rows = None if device.sampler.settings.shear else device.model.pressure_rows(sensors)
    if rows is None:
        model = modelled(device.simulator, device.body, sensors, device.model_rate)
        return lambda movie: model.respond(movie, displacement=False).readings[movie.scale > 0]
    operator = torch.from_numpy(rows.T.copy()).float()

    def read(movie: Movie) -> Tensor:
        touched = movie.scale > 0
        return (movie.frames.flatten(1) @ operator)[movie.index[touched]] * movie.scale[touched, None]

    return read
