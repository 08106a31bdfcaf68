"""Sequential Monte Carlo over gestures: which of them could have given the readings of a touch."""

import numpy as np
import torch
from torch import Tensor

from experiments.studies.gesture_prior import GesturePrior, State

_CONTINUOUS = {"angle": 1.8, "area": 0.1, "x": 0.03, "y": 0.03, "direction": 1.8, "speed": 5e-3, "peak": 25e3}
"""The parameters that a walk changes, and about their standard deviations before the touch is felt."""

_MOVES = {"walk": 0.6, "timing": 0.1, "path": 0.15, "body": 0.15}
_WANTED_RATE = 0.25  # of accepted steps of a walk
_EFFECTIVE = 0.6  # share of the samples that must stay effective from one step to the next
_AT_ONCE = 4000


class Samples:
    """Gestures that could have given measured readings: K samples of the posterior of each of B touches.

    Args:
        prior: of the gestures.
        readings: (B, T, S), N, measured.
        count: K.
        random: source of randomness.
    """

    def __init__(
        self, prior: GesturePrior, readings: Tensor, count: int, random: np.random.Generator
    ) -> None:
        self._prior, self._random, self._count = prior, random, count
        self._alive, self._noise = ~prior.device.constants.dead, float(prior.device.constants.noise)
        self._readings = readings[..., self._alive]
        # The gestures of the pool are the first samples, with weights.
        seen, pool = self._readings.flatten(1), prior.readings[..., self._alive].flatten(1)
        apart = seen.square().sum(1, keepdim=True) - 2 * seen @ pool.T + pool.square().sum(1)
        fit = -0.5 * apart.double().numpy() / self._noise**2
        self._share = np.array([next_share(one, 0.0, count, prior.weights) for one in fit])
        start = np.stack(
            [self._resampled(s * one + prior.weights) for s, one in zip(self._share, fit, strict=True)]
        )
        self._state: State = {name: each[start] for name, each in prior.pool.items()}
        self._log, self._labels, self._fit = self._evaluate(self._state, np.arange(len(readings)))
        self._length = np.full(len(readings), 0.7)

    @property
    def misfit(self) -> np.ndarray:
        """Mean squares of what the samples leave of the readings, (B,), in units of the noise."""
        return -2 * self._fit.mean(axis=1) / self._readings[0].numel()

    def run(self, moves: int, rounds: int = 10) -> np.ndarray:
        """Let the readings count more and more, move the samples, and return probabilities of labels (B, 4).

        Args:
            moves: Metropolis-Hastings moves of each sample in each step.
            rounds: steps at the end, over which the labels are averaged.
        """
        from rich.console import Console
        from rich.progress import Progress

        console, total = Console(stderr=True), np.zeros(self._labels[:, 0].shape)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as shown:
            tempering = shown.add_task("tempering", total=-np.log(self._share).sum())
            averaging = shown.add_task("averaging", total=rounds)
            while len(active := np.flatnonzero(self._share < 1)):
                before = np.log(self._share).sum()
                self._temper(active)
                for _ in range(moves):
                    self._move(active)
                shown.advance(tempering, np.log(self._share).sum() - before)
            for _ in range(rounds):
                for _ in range(moves):
                    self._move(np.arange(len(total)))
                total += self._labels.mean(axis=1)
                shown.advance(averaging)
        return total / rounds

    def _temper(self, touches: np.ndarray) -> None:
        """Let more of the log-likelihood count, as much as leaves enough samples effective."""
        for touch in touches:
            share = next_share(self._fit[touch], self._share[touch], _EFFECTIVE * self._count)
            kept = self._resampled((share - self._share[touch]) * self._fit[touch])
            for each in (*self._state.values(), self._log, self._labels, self._fit):
                each[touch] = each[touch][kept]
            self._share[touch] = share

    def _resampled(self, log: np.ndarray) -> np.ndarray:
        """Return the numbers of K samples, drawn with log weights (N,), systematically."""
        share = np.exp(log - log.max()).cumsum()
        at = (np.arange(self._count) + self._random.random()) / self._count * share[-1]
        return np.minimum(np.searchsorted(share, at), len(log) - 1)

    def _evaluate(self, state: State, touches: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return log densities (b, K), labels (b, K, 4) and log-likelihoods (b, K) of samples."""
        flat = {name: each.reshape(-1) for name, each in state.items()}
        owner = torch.from_numpy(np.repeat(touches, self._count))
        found = []
        for first in range(0, len(owner), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            log, labels, readings = self._prior.evaluate({name: each[part] for name, each in flat.items()})
            apart = (self._readings[owner[part]] - readings[..., self._alive]) / self._noise
            found.append((log, labels, -0.5 * apart.double().square().sum((1, 2)).numpy()))
        log, labels, fit = (np.concatenate(each) for each in zip(*found, strict=True))
        return log.reshape(-1, self._count), labels.reshape(-1, self._count, 4), fit.reshape(-1, self._count)

    def _move(self, touches: np.ndarray) -> None:
        """Change the samples of some touches, by a kind of move each (Metropolis-Hastings)."""
        old = {name: each[touches] for name, each in self._state.items()}
        shape = len(touches), self._count
        kind = self._random.choice(list(_MOVES), size=shape, p=list(_MOVES.values()))
        moved = {"walk": self._walk(old, self._length[touches]), "timing": self._timing(old),
                 "path": self._path(old), "body": self._body(old)}  # fmt: skip
        new = {name: each.copy() for name, each in old.items()}
        for name, changes in moved.items():
            new |= {key: np.where(kind == name, value, new[key]) for key, value in changes.items()}
        log, labels, fit = self._evaluate(new, touches)
        with np.errstate(invalid="ignore"):
            chance = log - self._log[touches] + self._share[touches, None] * (fit - self._fit[touches])
        taken = np.isfinite(log) & (np.log(self._random.random(shape)) < chance)
        for each, value in ((self._log, log), (self._fit, fit), *((self._state[n], new[n]) for n in new)):
            each[touches] = np.where(taken, value, each[touches])
        self._labels[touches] = np.where(taken[..., None], labels, self._labels[touches])
        walked = kind == "walk"
        rate = (taken & walked).sum(axis=1) / np.maximum(walked.sum(axis=1), 1)
        longer = np.exp(0.5 * (rate - _WANTED_RATE) * walked.any(axis=1))
        self._length[touches] = np.clip(self._length[touches] * longer, 1e-3, 2)

    def _walk(self, state: State, length: np.ndarray) -> State:
        """Go by the difference of two other samples (differential evolution; ter Braak, 2006)."""
        shape = state["area"].shape
        rows, one, other = (
            np.arange(len(length))[:, None],
            *self._random.integers(self._count, size=(2, *shape)),
        )
        step = length[:, None] * np.exp(self._random.normal(0, 0.7, shape))
        return {
            name: state[name]
            + step * (state[name][rows, one] - state[name][rows, other])
            + step * 1e-3 * wide * self._random.standard_normal(shape)
            for name, wide in _CONTINUOUS.items()
        }

    def _timing(self, state: State) -> State:
        """Move the end by a frame or, where touches begin at any frame, the beginning or both."""
        shape = state["area"].shape
        which, sign = self._random.integers(3, size=shape), self._random.choice([-1, 1], size=shape)
        which = which * self._prior.sampler.padded
        onset = np.select([which == 1, which == 2], [-sign, sign], 0)
        return {"duration": state["duration"] + sign * (which < 2), "onset": state["onset"] + onset}

    def _path(self, state: State) -> State:
        """Draw another direction and speed, and let a static touch slide or a sliding one rest."""
        shape = state["area"].shape
        drawn = self._prior.draw_velocity(state["duration"].reshape(-1), self._random)
        flipped = state["sliding"] ^ (self._random.random(shape) < 0.7)
        return {name: each.reshape(shape) for name, each in drawn.items()} | {"sliding": flipped}

    def _body(self, state: State) -> State:
        """Turn the shape to any angle, and mostly take another one."""
        shape = state["area"].shape
        other = self._random.integers(len(self._prior.sampler.shapes.names), size=shape)
        kept = self._random.random(shape) < 0.3
        angle = self._random.uniform(0, 2 * np.pi, shape)
        return {"angle": angle, "shape": np.where(kept, state["shape"], other)}


def next_share(fit: np.ndarray, share: float, effective: float, weights: np.ndarray | float = 0.0) -> float:
    """Return the share up to 1 of the log-likelihood at which so many samples are effective.

    Args:
        fit: (N,), log-likelihood of the samples.
        share: that counts already.
        effective: their number (Kish).
        weights: (N,), their logarithm before.
    """

    def enough(new: float) -> bool:
        log = (new - share) * fit + weights
        each = np.exp(log - log.max())
        return each.sum() ** 2 >= effective * (each**2).sum()

    if enough(1.0):
        return 1.0
    low, high = np.log(max(share, 1e-9)), 0.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if enough(np.exp(middle)) else (low, middle)
    # A step of at least a thousandth ends, even if one sample is far better than the others.
    return min(1.0, max(float(np.exp(low)), share * 1.001))
