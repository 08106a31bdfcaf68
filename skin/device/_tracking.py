"""How far sensors have moved: known from the simulator, or estimated from readings."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from skin.errors import InputError
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.simulator.base import AbstractSimulator
from skin.touch.sampler import Movie, TouchSampler

if TYPE_CHECKING:
    from skin.device.simulated import Simulated

__all__ = ["TRACKERS", "Tracker", "tracker"]

_GESTURES = 1024
_PENALTIES = np.logspace(-2, 6, 9)


@dataclass(frozen=True)
class Tracker:
    """Tells where the sensors of a simulated device go.

    Attributes:
        simulator: knows it; or None.
        weights: (S, 3 S), m/N, estimate it from readings; or None.
    """

    simulator: AbstractSimulator | None = None
    weights: Tensor | None = None

    def known(self, movie: Movie) -> Tensor | None:
        """Return the true motion, (B, T, S, 3), m, of sensors under gestures."""
        return None if self.simulator is None else _motion(self.simulator, movie)

    def told(self, touches: Touches) -> Touches:
        """Return touches with the motion that their readings tell."""
        if self.weights is None:
            return touches
        guess = (touches.readings @ self.weights.to(touches.readings.device)).unflatten(-1, (-1, 3))
        return replace(touches, motion=guess)


def tracker(track: str, device: "Simulated") -> Tracker:
    """Return what ``device.track`` asks for.

    Raises:
        InputError: an unknown choice, or a skin whose sensors do not move along it.
    """
    if track not in TRACKERS:
        raise InputError(
            f"device.track must be {', '.join(TRACKERS)}, got {track}: as in device.track=oracle"
        )
    return TRACKERS[track](device)


def _oracle(device: "Simulated") -> Tracker:
    device.model.motion(torch.zeros(device.body.shape))  # refused at the door rather than in the first batch
    return Tracker(simulator=device.model)


def _estimated(device: "Simulated") -> Tracker:
    """Fit a ridge regression from readings to motion, on gestures that no test draws.

    It is fitted as it would be for a real skin: in simulation, to the skin as designed (its layout without
    position error, its layers without variation), with the constants of another device in every gesture. So
    it knows no device in particular. There is no intercept: a skin at rest does not move.
    """
    # Here, because it takes a second and few devices need it.
    from sklearn.linear_model import RidgeCV

    body = replace(device.body, variation=0.0)
    model = device.simulator(body, device.sensors)
    # Not the device's own sampler: its labels know where the sensors truly are.
    contact = device.contact(body, model)
    sampler = TouchSampler(body, body.footprints(device.sensors), contact, device.touch, device.padded)
    randomness = generator(Stream.TRACKING, device.data_seed)
    with torch.no_grad():
        movie = sampler.sample(_GESTURES, randomness)
        motion = _motion(model, movie)
        force = model.respond(movie, displacement=False).readings
    constants = device.imperfection.constants(len(device.sensors), randomness, len(movie))
    readings, *_ = device.imperfection.apply(force, constants, randomness)
    ridge = RidgeCV(_PENALTIES, fit_intercept=False, alpha_per_target=True)
    ridge.fit(readings.flatten(0, 1).double().numpy(), motion.flatten(2).flatten(0, 1).double().numpy())
    return Tracker(weights=torch.from_numpy(ridge.coef_.T.copy()).float())


def _motion(simulator: AbstractSimulator, movie: Movie) -> Tensor:
    """Return the motion (B, T, S, 3), m, of sensors under gestures; each distinct frame is solved once."""
    home = next(simulator.buffers(), movie.frames).device
    drag = None if movie.drag is None else movie.drag.to(home)
    motion = simulator.motion(movie.frames.to(home), drag)[movie.index.to(home)]
    return motion * movie.scale.to(home)[..., None, None]


TRACKERS: dict[str, Callable[["Simulated"], Tracker]] = {
    "none": lambda device: Tracker(),
    "oracle": _oracle,
    "estimated": _estimated,
}
"""``none`` tells nothing, ``oracle`` what the simulator knows, ``estimated`` what readings tell of it."""
