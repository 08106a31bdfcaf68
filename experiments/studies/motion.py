"""How far touches move the sensors of a skin, and how well readings tell it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.representation.graph import neighbours

NO_EFFECT = 0.01
"""Relative change of distance below which a graph that follows the sensors can make no difference."""
_CHUNK = 500


@dataclass(frozen=True)
class Change:
    """How far touches move sensors.

    Attributes:
        largest: largest relative change of the distance of two neighbours, over all frames.
        quantile: 99 % quantile of it over the frames in contact and the pairs.
        furthest: largest motion along x, along y and into the skin, m.
        explained: share of the motion's mean square along x, along y and into the skin that the estimate from
            readings explains, at most 1.
    """

    largest: float
    quantile: float
    furthest: tuple[float, float, float]
    explained: tuple[float, float, float]

    @property
    def motion(self) -> str:
        """How far sensors move, and how much of it readings tell."""
        x, y, z = (f"{1e3 * value:.2f}" for value in self.furthest)
        told = ", ".join(f"{value:.0%}" for value in self.explained)
        return (
            f"Sensors move at most {x} mm along x, {y} mm along y and {z} mm into the skin; a ridge "
            f"regression on the readings explains {told} of that motion's mean square."
        )

    @property
    def sentence(self) -> str:
        """What this means for graphs that follow the sensors."""
        line = (
            f"neighbours' distances change by {self.largest:.2%} at most, 99 % quantile {self.quantile:.2%}"
        )
        small = self.largest < NO_EFFECT
        return f"{line}: " + ("below 1 %, no effect possible" if small else "an effect is possible")


def motion_change(device: AbstractSimulated, count: int, neighbourhood: int = 6) -> Change:
    """Measure how far ``count`` test gestures move the sensors of a skin in which they can.

    Args:
        device: with ``simulator.constraint=free``.
        count: number of gestures.
        neighbourhood: pairs are each sensor with its nearest so many (``representation.count``).

    Raises:
        InputError: sensors cannot move along this skin, or there are fewer than two.
    """
    if len(device.sensors) < 2:
        raise InputError(
            "one sensor has no neighbours whose distance could change: add sensors to the layout"
        )
    true = device.replace(track="oracle", test_gestures=count).touches("test")
    guess = device.replace(track="estimated", test_gestures=count).touches("test")
    assert true.motion is not None
    assert guess.motion is not None
    pairs = np.argwhere(np.triu(neighbours(device.sensors.positions, "knn", neighbourhood)))
    changes = torch.cat(list(_changes(true.positions, true.motion, torch.from_numpy(pairs))))
    missed = (guess.motion - true.motion).square().mean(dim=(0, 1, 2))
    explained = 1 - missed / true.motion.square().mean(dim=(0, 1, 2))
    return Change(
        float(changes.max()),
        float(np.quantile(changes.numpy(), 0.99)),
        _three(true.motion.abs().amax(dim=(0, 1, 2))),
        _three(explained),
    )


def _changes(places: Tensor, motion: Tensor, pairs: Tensor) -> Iterator[Tensor]:
    """Yield relative changes of distance in the frames of contact, each (frames * pairs,)."""
    first, second = pairs.T
    before = (places[first] - places[second]).norm(dim=-1)
    for part in motion.split(_CHUNK):
        moved = places + part[part.flatten(2).abs().amax(dim=-1) > 0]
        now = (moved[:, first] - moved[:, second]).norm(dim=-1)
        yield (now / before - 1).abs().flatten()


def _three(values: Tensor) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
