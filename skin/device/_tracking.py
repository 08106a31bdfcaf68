"""Displacement of the sensors: from the simulator, or estimated from readings."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from skin.recording import Touches
from skin.signal.device_sampling import draw_constants, measure
from skin.signal.imperfection import Imperfection
from skin.simulator.base import AbstractSimulator
from skin.touch.sampler import Movie, TouchSampler

_GESTURES = 1024
_PENALTIES = np.logspace(-2, 6, 9)


@dataclass(frozen=True)
class Tracker:
    """Gives the displacement of the sensors of a simulated device.

    Attributes:
        simulator: computes the true displacement; or None.
        weights: (S, 3 S), m/N, of the estimate from readings; or None.
    """

    simulator: AbstractSimulator | None = None
    weights: Tensor | None = None

    def motion(self, movie: Movie) -> Tensor | None:
        """Return the true motion, (B, T, S, 3), m, of sensors under gestures."""
        return None if self.simulator is None else _motion(self.simulator, movie)

    def estimate(self, touches: Touches) -> Touches:
        """Return touches with the motion estimated from their readings."""
        if self.weights is None:
            return touches
        guess = (touches.readings @ self.weights.to(touches.readings.device)).unflatten(-1, (-1, 3))
        return replace(touches, motion=guess)


def oracle(model: AbstractSimulator, shape: tuple[int, int]) -> Tracker:
    """Return a tracker with the true motion of a simulator of a sheet of ``shape`` (H, W) cells.

    Raises:
        InputError: sensors do not move along the sheet in this simulator.
    """
    model.motion(torch.zeros(shape))  # fails now rather than in the first batch
    return Tracker(simulator=model)


def estimated(
    model: AbstractSimulator,
    sampler: TouchSampler,
    imperfection: Imperfection,
    sensors: int,
    randomness: np.random.Generator,
) -> Tracker:
    """Fit a ridge regression from readings to motion, on gestures that differ from those of the test.

    There is no intercept: a skin at rest does not move.

    Args:
        model: of the skin as designed.
        sampler: of gestures on it.
        imperfection: every gesture is measured by another device of this kind, so the fit depends on none.
        sensors: number of sensors.
        randomness: of gestures, devices and noise.

    Raises:
        InputError: sensors do not move along the sheet in this simulator.
    """
    # Imported here because it takes a second and few devices need it.
    from sklearn.linear_model import RidgeCV

    with torch.no_grad():
        movie = sampler.sample(_GESTURES, randomness)
        motion = _motion(model, movie)
        force = model.respond(movie, displacement=False).readings
    rate = sampler.settings.rate
    constants = draw_constants(imperfection, sensors, rate, randomness, len(movie))
    readings, *_ = measure(imperfection, constants, force, rate, randomness)
    ridge = RidgeCV(_PENALTIES, fit_intercept=False, alpha_per_target=True)
    ridge.fit(readings.flatten(0, 1).double().numpy(), motion.flatten(2).flatten(0, 1).double().numpy())
    return Tracker(weights=torch.from_numpy(ridge.coef_.T.copy()).float())


def _motion(simulator: AbstractSimulator, movie: Movie) -> Tensor:
    """Return the motion (B, T, S, 3), m, of sensors under gestures; each distinct frame is solved once."""
    home = next(simulator.buffers(), movie.frames).device
    shear = None if movie.shear is None else movie.shear.to(home)
    motion = simulator.motion(movie.frames.to(home), shear)[movie.index.to(home)]
    return motion * movie.scale.to(home)[..., None, None]
