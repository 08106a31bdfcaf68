"""The distribution that simulated gestures are drawn from, as a density."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from skin.errors import InputError
from skin.touch.gesture import Draws, draw_gestures, draw_paths

if TYPE_CHECKING:
    from skin.device.base import AbstractSimulated
    from skin.touch.movie import Movie

State = Draws
"""Gestures, (N,) each: shape, angle (rad), area (share of the sheet), x and y (m, halfway on the path),
sliding (bool), direction (rad), speed (m per frame), duration and onset (frames), peak (Pa). A static
gesture also has a direction and a speed. They have no effect and follow the same distribution."""

_AT_ONCE = 2000


class GesturePrior:
    """The density of gestures, their labels and what a device measures of them on average.

    Every combination of labels is equally likely. A path without the labels that it is drawn for is drawn
    again for the same shape, size and duration. This makes gestures likelier whose other paths seldom have
    these labels. A classifier learns this factor from draws.

    Args:
        device: simulates the touches.
        draws: of each combination of labels, to learn this factor.

    Attributes:
        pool: gestures with their labels, each drawn once.
        readings: (N, T, S), N, of the pool, on average over the noise.
        weights: (N,), logarithm of their density over that with which they were drawn.

    Raises:
        InputError: imperfections other than gain, offset, noise, clipping and dead sensors, or gestures
            that are drawn in another way.
    """

    def __init__(self, device: "AbstractSimulated", draws: int = 1000) -> None:
        _check(device)
        self.device, self.sampler, self.settings = device, device.sampler, device.sampler.settings
        random = np.random.default_rng(0)
        wanted = np.tile(np.arange(16)[:, None] >> np.arange(4) & 1, (draws, 1)).astype(bool)
        parts = [
            self._draw(part, random) for part in np.split(wanted, range(_AT_ONCE, len(wanted), _AT_ONCE))
        ]
        pool = {name: np.concatenate([part[0][name] for part in parts]) for name in parts[0][0]}
        misfits, features, right = (np.concatenate([part[n] for part in parts]) for n in (1, 2, 3))
        self._fitting = np.array([1 / (1 + misfits[wanted[:, 0] == big].mean()) for big in (False, True)])
        self._accepted = _acceptance(features, right)
        self.pool = {name: each[right] for name, each in pool.items()}
        self.readings = torch.cat([part[4] for part in parts])[torch.from_numpy(right)]
        self._balance = np.zeros(16)
        kind, weights = _combination(features[right]), np.exp(self._redrawn(features[right]))
        self._balance = np.log(np.bincount(kind, weights, 16) / draws)
        self.weights = self._redrawn(features[right])

    @torch.no_grad()
    def _draw(
        self, wanted: np.ndarray, random: np.random.Generator
    ) -> tuple[State, np.ndarray, np.ndarray, np.ndarray, Tensor]:
        """Return gestures (N,), misfits, features, whether they have their labels, and readings."""
        drawn = draw_gestures(wanted, self.settings, self.sampler.shapes, self.sampler.padded, random)
        chance = random.random((len(wanted), 5))
        drawn |= draw_paths(wanted, drawn, self.settings, self.device.size, chance)
        movie = self._movie(drawn, wanted)
        right = (movie.labels.numpy() == wanted).all(axis=1)
        state = {name: drawn[name] for name in ("shape", "angle", "duration", "onset", "peak")}
        aside = self.draw_velocity(drawn["duration"], random)
        state |= {name: np.where(wanted[:, 1], drawn[name], each) for name, each in aside.items()}
        state |= {"sliding": wanted[:, 1], "area": self.sampler.shapes.area(drawn["shape"], drawn["scale"])}
        state["x"], state["y"] = (drawn["start"] - drawn["low"] + _half_way(state)).T
        features = _features(wanted, drawn)
        return state, drawn["misfits"], features, right, self._measured(movie)

    def draw_velocity(self, duration: np.ndarray, random: np.random.Generator) -> State:
        """Return directions and speeds (N,) of gestures of such durations (frames)."""
        slowest, highest = self._speeds(duration)
        speed = slowest + (highest - slowest) * random.random(len(duration))
        return {"direction": random.uniform(0, 2 * np.pi, len(duration)), "speed": speed}

    def _speeds(self, duration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        least, most = self.settings.frames.speed
        slowest = np.maximum(least, self.settings.path / np.maximum(duration - 1, 1))
        return slowest, np.full(len(duration), most)

    @torch.no_grad()
    def evaluate(self, state: State) -> tuple[np.ndarray, np.ndarray, Tensor]:
        """Return the log density (N,), -inf where impossible, labels (N, 4), bool, and readings (N, T, S), N.

        The density is known up to a factor. Readings are those of the device without noise, 0 of impossible
        gestures and dead sensors.
        """
        drawn, labels = self._gestures(state)
        log = self._density(state, drawn, labels)
        readings = torch.zeros(len(log), self.settings.frames.window, len(self.device.sensors))
        possible = np.flatnonzero(np.isfinite(log))
        if len(possible):
            movie = self._movie({name: each[possible] for name, each in drawn.items()}, labels[possible])
            log[possible[(movie.labels.numpy() != labels[possible]).any(axis=1)]] = -np.inf
            readings[torch.from_numpy(possible)] = self._measured(movie)
        return log, labels, readings

    def _gestures(self, state: State) -> tuple[Draws, np.ndarray]:
        """Return gestures as ``draw_gestures`` and ``draw_paths`` do, and the labels they are drawn for."""
        shapes, limits = self.sampler.shapes, self.settings.thresholds
        big, dangerous = state["area"] > limits.area, state["peak"] > limits.pressure
        press = state["duration"] > self.settings.frames.duration
        scale = shapes.scale(state["shape"], np.maximum(state["area"], 0))
        low, high = shapes.extent(state["shape"], state["angle"], scale)
        drawn = {name: state[name] for name in ("shape", "angle", "direction", "duration", "onset", "peak")}
        drawn |= {"scale": scale, "low": low, "high": high, "span": np.array(self.device.size) - (high - low)}
        drawn |= {"speed": np.where(state["sliding"], state["speed"], 0.0)}
        drawn |= {"start": np.stack([state["x"], state["y"]], axis=1) + low - _half_way(state)}
        drawn |= {"stretch": np.ones(len(scale)), "misfits": np.zeros(len(scale))}
        return drawn, np.stack([big, state["sliding"], press, dangerous], axis=1)

    def _density(self, state: State, drawn: Draws, labels: np.ndarray) -> np.ndarray:
        """Return the log density (N,) of gestures that turn out to have their labels."""
        settings, frames = self.settings, self.settings.frames
        big, sliding, press, dangerous = labels.T
        shortest, longest = np.where(press[:, None], frames.press, frames.tap).T
        shortest = np.where(sliding, np.maximum(shortest, frames.slide), shortest)
        span, free = drawn["span"], self.sampler.padded * (frames.window - state["duration"])
        inside = (drawn["start"] >= 0) & (drawn["start"] <= span) & (span >= settings.spare)
        log = np.where(inside.all(axis=1), -np.log(np.maximum(span, 1e-9)).sum(axis=1), -np.inf)
        areas = np.where(big[:, None], settings.big_area, settings.small_area).T
        peaks = np.where(dangerous[:, None], settings.dangerous_peak, settings.safe_peak).T
        log += _uniform(state["area"], *areas) + _uniform(state["peak"], *peaks)
        log += _uniform(state["speed"], *self._speeds(state["duration"]))
        # Counts of frames: n values from a to b are a range of width n.
        log += _uniform(state["duration"], shortest - 0.5, longest + 0.5)
        log += _uniform(state["onset"], -0.5, free + 0.5)
        log -= np.log(self._fitting)[big.astype(int)]
        return log + self._redrawn(_features(labels, drawn))

    def _redrawn(self, features: np.ndarray) -> np.ndarray:
        """Return the logarithm of the factor by which redrawn paths make gestures likelier, (N,)."""
        chance = np.clip(self._accepted(features), 1e-3, 1)
        often = np.log1p(-np.minimum((1 - chance) ** self.settings.redraws, 1 - 1e-9)) - np.log(chance)
        return often - self._balance[_combination(features)]

    def _movie(self, gestures: Draws, wanted: np.ndarray) -> "Movie":
        order = np.argsort(gestures["scale"], kind="stable")
        movie = self.sampler.render({name: each[order] for name, each in gestures.items()}, wanted[order])
        return movie[torch.from_numpy(np.argsort(order))]

    def _measured(self, movie: "Movie") -> Tensor:
        constants, true = self.device.constants, self.device.model.respond(movie, displacement=False).readings
        felt = (true * constants.gain).clamp(-constants.clip, constants.clip)
        return (felt + constants.offset - constants.baseline).masked_fill(constants.dead, 0.0)


def _check(device: "AbstractSimulated") -> None:
    """Raise InputError where the density of gestures or of their readings is not known."""
    constants, sampler = device.constants, device.sampler
    changing = constants.hysteresis, constants.drift, constants.time_constant, constants.quantum
    if any(one.any() for one in changing) or device.rate != device.model_rate or constants.gain.ndim > 1:
        raise InputError(
            "the density of readings is known for gains, offsets, noise and dead sensors only, at the "
            "rate of the model: set profile=mild device.randomise=false device.rate=10"
        )
    if sampler.fit or sampler.settings.shear or not sampler.contact.proportional or device.stream:
        raise InputError(
            "the density of gestures is known for whole ones of prescribed pressure, without friction, "
            "with shapes that are not stretched: leave out contact=, touch.shear=, data.stream= and body="
        )


def _acceptance(features: np.ndarray, right: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the probability of having the labels (N,) as a function of features."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    if right.all():
        return lambda asked: np.ones(len(asked))
    model = HistGradientBoostingClassifier(random_state=0, categorical_features=[4]).fit(features, right)
    return lambda asked: model.predict_proba(asked)[:, 1]


def _features(labels: np.ndarray, drawn: Draws) -> np.ndarray:
    """Return what stays the same where a path is drawn again, (N, 9), beginning with the labels."""
    kept = [drawn[name] for name in ("shape", "scale", "duration")]
    return np.column_stack([labels, *kept, drawn["span"]]).astype(float)


def _combination(features: np.ndarray) -> np.ndarray:
    """Return the number of the combination of labels, (N,)."""
    return features[:, :4].astype(int) @ (8, 4, 2, 1)


def _half_way(state: State) -> np.ndarray:
    """Return the way (N, 2), m, from the beginning of a path to its middle; paths may be reflected."""
    half = np.where(state["sliding"], state["speed"] * (state["duration"] - 1) / 2, 0.0)
    return half[:, None] * np.stack([np.cos(state["direction"]), np.sin(state["direction"])], axis=1)


def _uniform(each: np.ndarray, least: np.ndarray | float, most: np.ndarray | float) -> np.ndarray:
    """Return the log density of a range, -inf outside."""
    width = np.maximum(np.asarray(most) - least, 1e-12)
    return np.where((each >= least) & (each <= most), -np.log(width), -np.inf)
