"""Endless gestures for an emulated skin, and its converter."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch

from skin.core.rng import Stream, generator
from skin.device.base import AbstractSimulated
from skin.touch.sampler import balanced

_BATCH = 16  # every combination of the labels once
_EDGE = 0.25  # of a frame, in which force rises and falls


@dataclass(frozen=True)
class Gesture:
    """A simulated gesture.

    Attributes:
        labels: name -> 0 or 1.
        force: true readings, (T, S), N, at the model's rate.
        applied: total force on the skin, (T,), N.
    """

    labels: Mapping[str, int]
    force: np.ndarray
    applied: np.ndarray


@dataclass(frozen=True)
class Converter:
    """Converts N to counts.

    The middle of the converter is at 0 N and its ends are at twice the clip, as in
    skin.hardware.calibration.presses.

    Attributes:
        bits: of the converter; None: N are sent.
        clip: of the device, N.
    """

    bits: int | None
    clip: float

    @property
    def scale(self) -> float:
        """N per count; 1 if N are sent."""
        return 1.0 if self.bits is None else 2 * self.clip / 2 ** (self.bits - 1)

    def __call__(self, newtons: np.ndarray) -> np.ndarray:
        """Return counts, or N if ``bits`` is None, float64."""
        if self.bits is None:
            return np.asarray(newtons, dtype=np.float64)
        middle = 2 ** (self.bits - 1)
        return np.clip(np.round(middle + newtons / self.scale), 0, 2**self.bits - 1).astype(np.float64)


def emulated_gestures(device: AbstractSimulated, seed: int = 0) -> Iterator[Gesture]:
    """Yield gestures that are not used for training, balanced in batches of 16."""
    with ThreadPoolExecutor(1, "skin-gestures") as ahead:
        # Drawn while the previous ones are sent, so that there is no pause.
        coming = ahead.submit(_batch, device, seed, 0)
        for number in count(1):
            ready = coming.result()
            coming = ahead.submit(_batch, device, seed, number)
            yield from ready


def gestures_with_labels(device: AbstractSimulated, labels: np.ndarray, seed: int = 0) -> list[Gesture]:
    """Return one gesture for each row of labels (B, 4), 0 or 1, in the order of ``TOUCH``."""
    return _draw_gestures(device, labels, generator(Stream.TEST, 5, seed))


def _batch(device: AbstractSimulated, seed: int, number: int) -> list[Gesture]:
    draw = generator(Stream.TEST, 2, seed, number)
    return _draw_gestures(device, balanced(_BATCH, draw), draw)


@torch.no_grad()
def _draw_gestures(device: AbstractSimulated, labels: np.ndarray, draw: np.random.Generator) -> list[Gesture]:
    movie = device.sampler.sample(len(labels), draw, labels)
    readings = device.model.respond(movie, displacement=False).readings.double().numpy()
    names, rows, force = device.task.names, movie.labels.int().tolist(), movie.force.double().numpy()
    return [
        Gesture(dict(zip(names, row, strict=True)), reading, applied)
        for row, reading, applied in zip(rows, readings, force, strict=True)
    ]


def upsample(force: np.ndarray, model_rate: float, rate: float) -> np.ndarray:
    """Upsample true readings to the rate of a device; return (F, S), N.

    A frame of the model is held for its interval, with ramps of a quarter of the interval towards smaller
    neighbours. The maximum over the interval is the frame itself, so resampling restores the original frames
    and no touch becomes longer.

    Args:
        force: (T, S), N.
        model_rate: of ``force``, Hz.
        rate: of the device, Hz.
    """
    frames = round(len(force) * rate / model_rate)
    place = (np.arange(frames) + 0.5) * model_rate / rate
    now = np.minimum(place.astype(int), len(force) - 1)
    share = (place - now)[:, None]
    padded = np.concatenate([np.zeros_like(force[:1]), force, np.zeros_like(force[:1])])
    level = padded[now + 1]
    before, after = np.minimum(padded[now], level), np.minimum(padded[now + 2], level)
    rising = before + (level - before) * np.clip(share / _EDGE, 0, 1)
    falling = after + (level - after) * np.clip((1 - share) / _EDGE, 0, 1)
    return np.where(share < 0.5, rising, falling)
