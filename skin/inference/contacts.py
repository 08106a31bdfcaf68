"""Several contacts: found one after the other on the residual, refined together, weighed by samples."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri
from scipy.stats.qmc import Sobol

from skin.inference.candidates import CandidateReadings, FingertipPrior
from skin.inference.likelihood import Observation, fit_residual

_STEPS = 12  # of Gauss-Newton
_LONGEST = 0.01, 0.01, 1, 2, 2, 2  # step
_LATTICE = 0.0064  # m, largest distance of positions that are searched in pairs
_TOLERANCE = 0.2  # relative misfit of a pair of such positions
_PAIRS = 8  # pairs that are refined
_SAMPLES = 10  # binary logarithm of the number of samples
_WIDER = 1.1  # spread of the samples' proposal, relative to the posterior's
_FREEDOM = 8.0  # degrees of freedom of the proposal, Student's distribution
_MODES, _UNLIKELY, _ALIKE = 6, 6.0, 0.002  # modes that are sampled; log score below the best; m between two
_WALKERS, _WALK = 256, 60  # and steps of each

# A guess is (M, n, P): x, y, m, and scores whose prior is the standard normal distribution: of the radius,
# which is uniform, of the force, which is log-normal (P = 4), and with friction of the tangential force along
# x and y per newton (P = 6). Posteriors are then nearly Gaussian.


@dataclass(frozen=True)
class Mixture:
    """Posterior of n contacts as weighted samples.

    Attributes:
        samples: (N, n, P), x, y, m, with scores of radius and forces.
        weight: (N,), probabilities that sum to 1.
        evidence: log of the likelihood integrated over the prior.
        misfit: posterior mean of the squared misfit in variances.
        mode: (n, P), the most probable contacts, with scores of radius and forces.
        predicted: (S,), readings at the mode, N.
    """

    samples: np.ndarray
    weight: np.ndarray
    evidence: float
    misfit: float
    mode: np.ndarray
    predicted: np.ndarray


class Addition(NamedTuple):
    """What a further contact would explain, at each of N positions.

    Attributes:
        mode: (N,), the most probable log force.
        ratio: (N,), log of the likelihood ratio to no further contact, integrated over the force.
        factor: log factor of the evidence: the mean of the ratio over all positions, also where no sensor
            responds, times the orders that the contact can have among the others.
    """

    mode: np.ndarray
    ratio: np.ndarray
    factor: float


class Search:
    """Finds several contacts in a frame.

    Args:
        candidates: of the skin.
        prior: of each contact; contacts are independent.
    """

    def __init__(self, candidates: CandidateReadings, prior: FingertipPrior) -> None:
        self.candidates, self.prior = candidates, prior
        size, radii = candidates.size, candidates.radii
        self._minimum, self._range = radii[0], radii[1] - radii[0]
        self._scale = np.array([*(size / math.sqrt(12)), 1, 1, *((1, 1) if candidates.friction else ())])
        self._parameters = len(self._scale)
        self._density = -math.log(size[0] * size[1])
        counts = np.ceil(size / _LATTICE).astype(int)
        x, y = ((np.arange(count) + 0.5) * side / count for count, side in zip(counts, size, strict=True))
        self._positions = np.stack(np.meshgrid(x, y, [sum(radii) / 2], indexing="ij"), -1).reshape(-1, 3)
        self._lattice = np.ascontiguousarray(candidates.at(self._positions)[:, 0, 0])

    @cached_property
    def _normal(self) -> np.ndarray:
        """Normal points for three contacts (2^10, 3 P)."""
        return ndtri(Sobol(3 * self._parameters, rng=0).random_base2(_SAMPLES).clip(1e-9, 1 - 1e-9))

    @cached_property
    def _stretch(self) -> np.ndarray:
        """What makes normal points those of Student's distribution, (2^10,)."""
        return np.sqrt(_FREEDOM / np.random.default_rng(1).chisquare(_FREEDOM, 2**_SAMPLES))

    def predict(self, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (M, S), N, and their derivatives (M, P n, S) by position and scores."""
        count, number, size = guess.shape
        positions, force, stretch = self._positions_of(guess.reshape(-1, size))
        rows = force[:, None, None, None] * self.candidates.at(positions)
        loads = np.pad(guess.reshape(-1, size)[:, 4:], [(0, 0), (1, 0)], constant_values=1)
        blended = (loads[:, None, None] @ rows)[:, :, 0]
        predicted = blended[:, 0]
        columns = np.empty((len(positions), size, predicted.shape[1]))
        columns[:, :3], columns[:, 4:] = blended[:, 1:], rows[:, 0, 1:]
        columns[:, 2] *= stretch[:, None]
        columns[:, 3] = self.prior.spread * predicted
        return predicted.reshape(count, number, -1).sum(1), columns.reshape(count, size * number, -1)

    def _positions_of(self, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions and radii (N, 3), m, forces (N,), N, and m of radius per score (N,)."""
        radius = self._minimum + self._range * ndtr(guess[:, 2])
        stretch = self._range * np.exp(-0.5 * guess[:, 2] ** 2) / math.sqrt(2 * math.pi)
        force = self.prior.force * np.exp(self.prior.spread * guess[:, 3])
        return np.column_stack([guess[:, :2], radius]), force, stretch

    def scores(self, radius: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the scores of radii, m, and forces, N."""
        fraction = ((radius - self._minimum) / self._range).clip(0.02, 0.98)
        return ndtri(fraction), np.log(force / self.prior.force) / self.prior.spread

    def variance(self, frame: Observation, predicted: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the variance (M, S), N^2, of readings as of :meth:`predict`."""
        variance = frame.noise.floor + (frame.noise.relative * predicted) ** 2
        if frame.noise.position:
            for axis in (0, 1):
                moved = columns[:, axis :: self._parameters].sum(1)
                variance = variance + (frame.noise.position * moved) ** 2
        return variance

    def refine(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return guesses after steps of Gauss and Newton, and their log posterior (M,)."""
        guess, damping = self._inside(guess), np.full(len(guess), 1e-2)
        score, pull, information = self._expand(frame, guess)
        for _ in range(_STEPS):
            ridge = damping[:, None] * np.diagonal(information, axis1=1, axis2=2)
            step = np.linalg.solve(information + ridge[:, None] * np.eye(pull.shape[1]), pull[..., None])
            longest = np.array(_LONGEST[: self._parameters])
            bounded = np.clip(step.reshape(guess.shape), -longest, longest)
            tried = self._inside(guess + bounded)
            after = self._expand(frame, tried)
            better = after[0] > score
            guess = np.where(better[:, None, None], tried, guess)
            gain = np.where(better, after[0] - score, 0).max()
            score, pull, information = (
                np.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
                for new, old in zip(after, (score, pull, information), strict=True)
            )
            damping = np.where(better, damping / 5, damping * 5).clip(1e-6, 1e3)
            if gain < 1e-2 and better.any():
                break
        return guess, score

    def _inside(self, guess: np.ndarray) -> np.ndarray:
        free = [np.inf] * (self._parameters - 3)
        return np.clip(guess, [0, 0, -4, *np.negative(free)], [*self.candidates.size, 4, *free])

    def _expand(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the log posterior (M,), its gradient (M, P n) and information (M, P n, P n)."""
        predicted, columns = self.predict(guess)
        variance = self.variance(frame, predicted, columns)
        misfit = frame.readings - predicted
        counts = np.broadcast_to(frame.counts, predicted.shape)
        if len(frame.clipped):
            # A sensor that clips pulls upwards until it is predicted to do so.
            misfit, counts = misfit.copy(), counts.copy()
            short = frame.noise.clip - predicted[:, frame.clipped]
            misfit[:, frame.clipped], counts[:, frame.clipped] = short, short > 0
        weight = counts / variance
        distance = guess * (np.arange(self._parameters) > 1)
        pull = np.vecdot(columns, (weight * misfit)[:, None]) - distance.reshape(len(guess), -1)
        information = np.matmul(columns * weight[:, None], columns.transpose(0, 2, 1))
        information = information + np.diag(np.tile(self._scale**-2, guess.shape[1]))
        penalty = 0.5 * (distance**2).sum((1, 2))
        return frame.likelihood(predicted, variance - frame.noise.floor) - penalty, pull, information

    def add(self, frame: Observation, guess: np.ndarray) -> "Addition":
        """Return what a further contact, beside a guess (n, P), would explain.

        The contacts of the guess may move, to first order. The further one has no friction.
        """
        predicted, columns = self.predict(guess[None])
        weight = frame.counts / self.variance(frame, predicted, columns)[0]
        scaled = columns[0] * weight
        information = scaled @ columns[0].T + np.diag(np.tile(self._scale**-2, len(guess)))
        projected = np.diag(weight) - scaled.T @ np.linalg.solve(information, scaled)
        left = (frame.readings - predicted[0]) * frame.counts
        mode, ratio = fit_residual(self.prior, self._lattice, left, projected)
        top = ratio.max()
        factor = float(top + np.log(np.exp(ratio - top).mean())) + math.log(len(guess) + 1)
        return Addition(mode, ratio, factor)

    def extend(self, guess: np.ndarray, addition: "Addition") -> np.ndarray:
        """Return guesses (M, n + 1, P) with the best further contacts."""
        best = self._apart(addition.ratio, self._positions, 3)
        scores = self.scores(self._positions[best, 2], np.exp(addition.mode[best]))
        new = self.without_friction(np.column_stack([self._positions[best, :2], *scores]))[:, None]
        return np.concatenate([np.repeat(guess[None], len(best), 0), new], axis=1)

    @staticmethod
    def _apart(score: np.ndarray, positions: np.ndarray, number: int) -> list[int]:
        """Return the best candidates that are not next to each other."""
        chosen = list[int]()
        for index in np.argsort(-score)[: 20 * number]:
            near = np.linalg.norm(positions[chosen, :2] - positions[index, :2], axis=1)
            if len(chosen) < number and (near > 2 * _LATTICE).all():
                chosen.append(int(index))
        return chosen

    def pairs(self, frame: Observation, predicted: np.ndarray) -> np.ndarray:
        """Return the pairs (M, 2, P) that explain best what contacts with readings (S,), N, leave over."""
        left = (frame.readings - predicted).astype(np.float32)
        weight = frame.counts / (frame.noise.floor + (_TOLERANCE * left) ** 2).astype(np.float32)
        scaled = self._lattice * weight
        along, gram = scaled @ left, scaled @ self._lattice.T
        square = np.diagonal(gram)
        determinant = square[:, None] * square - gram * gram
        first = along[:, None] * square - gram * along
        # Both forces are above 0, and the gain is that of the least squares.
        possible = (first > 0) & (first.T > 0) & (determinant > 1e-6 * square[:, None] * square)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(possible, (first * along[:, None] + first.T * along) / determinant, 0)
        rows, columns = np.triu_indices(len(along), 1)
        flat = gain[rows, columns]
        chosen = list[tuple[int, int]]()
        count = min(60 * _PAIRS, len(flat) - 1)
        best = np.argpartition(-flat, count)[:count]
        for index in best[np.argsort(-flat[best], kind="stable")]:
            pair = int(rows[index]), int(columns[index])
            if len(chosen) < _PAIRS and flat[index] > 0 and self._new(pair, chosen):
                chosen.append(pair)
        index = np.array(chosen, int).reshape(-1, 2)
        i, j = index.T
        force = np.stack([first[i, j], first[j, i]], 1) / np.maximum(determinant[i, j], 1e-30)[:, None]
        positions = self._positions[index]
        radius, score = self.scores(positions[..., 2], np.maximum(force, 1e-3 * self.prior.force))
        scores = np.stack([radius, score.clip(-4, 4)], -1)
        return self.without_friction(np.concatenate([positions[..., :2], scores], axis=2))

    def without_friction(self, guess: np.ndarray) -> np.ndarray:
        """Return guesses (..., 4) as (..., P)."""
        return np.pad(guess, [(0, 0)] * (guess.ndim - 1) + [(0, self._parameters - 4)])

    def _new(self, pair: tuple[int, int], chosen: list[tuple[int, int]]) -> bool:
        """Return whether a pair is not nearly one of those that are chosen."""
        positions = self._positions[:, :2]
        return all(
            max(
                np.abs(positions[pair[0]] - positions[a]).max(),
                np.abs(positions[pair[1]] - positions[b]).max(),
            )
            > 1.5 * _LATTICE
            for a, b in chosen
        )

    def sample(self, frame: Observation, modes: np.ndarray, score: np.ndarray) -> Mixture:
        """Return the posterior of contacts by importance samples around modes (M, n, P), and its evidence.

        Args:
            frame: the frame.
            modes: as of :meth:`refine`.
            score: (M,), their log posterior.
        """
        chosen = self._distinct(modes, score)
        modes, number = _order(modes[chosen], modes[chosen[0]]), modes.shape[1]
        size = self._parameters * number
        information = self._expand(frame, modes)[2]
        spread = np.linalg.cholesky(np.linalg.inv(information)) * _WIDER
        owner = np.arange(2**_SAMPLES) % len(modes)
        normal, stretch = self._normal[:, :size], self._stretch[:, None]
        moved = np.matmul(spread[owner], (normal * stretch)[..., None])
        guess = modes[owner] + moved.reshape(-1, *modes.shape[1:])
        flat, log_density = guess.reshape(len(guess), -1), list[np.ndarray]()
        for mode, lower in zip(modes.reshape(len(modes), -1), spread, strict=True):
            away = np.linalg.solve(lower, (flat - mode).T)
            tails = -0.5 * (_FREEDOM + size) * np.log1p((away**2).sum(0) / _FREEDOM)
            log_density.append(tails - np.log(np.diagonal(lower)).sum())
        top = np.max(log_density, axis=0)
        proposal = top + np.log(np.exp(log_density - top).mean(0)) + self._tail_constant(size)
        log_posterior, misfit = self._weigh(frame, guess)
        scores = size - 2 * number
        constant = -scores / 2 * math.log(2 * math.pi) + math.lgamma(number + 1) + number * self._density
        logs = log_posterior - proposal + constant
        highest = logs.max()
        weight = np.exp(logs - highest)
        evidence = float(highest + math.log(weight.mean()))
        weight /= weight.sum()
        return Mixture(
            guess, weight, evidence, float(weight @ misfit), modes[0], self.predict(modes[:1])[0][0]
        )

    @staticmethod
    def _tail_constant(size: int) -> float:
        """Return the log of the factor of Student's density in some dimensions."""
        gammas = math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2)
        return gammas - size / 2 * math.log(_FREEDOM * math.pi)

    @staticmethod
    def _distinct(modes: np.ndarray, score: np.ndarray) -> list[int]:
        """Return the modes that count, the best first: likely ones, each set of positions once."""
        chosen = list[int]()
        for index in np.argsort(-score, kind="stable"):
            likely = score[index] > score.max() - _UNLIKELY and len(chosen) < _MODES
            if likely and all(_differ(modes[index], modes[better]) for better in chosen):
                chosen.append(int(index))
        return chosen

    def _weigh(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the log posterior (M,) but for constants, and the squared misfit in variances."""
        inside = self._inside(guess)
        predicted, columns = self.predict(inside)
        variance = self.variance(frame, predicted, columns)
        density = -0.5 * (guess[..., 2:] ** 2).sum((1, 2))
        likelihood = frame.likelihood(predicted, variance - frame.noise.floor)
        misfit = ((frame.readings - predicted) ** 2 / variance) @ frame.counts
        return np.where((inside == guess).all((1, 2)), likelihood + density, -np.inf), misfit

    def walk(self, frame: Observation, mixture: Mixture) -> Mixture:
        """Return the posterior with samples that have walked, where those of importance are few.

        Differential evolution Markov chains (ter Braak 2006): each of half of the walkers tries a step along
        the difference of two of the other half.
        """
        rng = np.random.default_rng(0)
        start = np.searchsorted(
            np.cumsum(mixture.weight), (np.arange(_WALKERS) + 0.5) / _WALKERS * (1 - 1e-9)
        )
        guess = mixture.samples[rng.permutation(start)]
        score, misfit = self._weigh(frame, guess)
        size = guess[0].size
        samples, misfits, half = list[np.ndarray](), list[float](), _WALKERS // 2
        for step in range(_WALK):
            for mine, others in (
                (slice(None, half), slice(half, None)),
                (slice(half, None), slice(None, half)),
            ):
                first, second = rng.integers(0, half, (2, half))
                factor = 0.98 if step % 8 == 7 else 2.38 / math.sqrt(2 * size)
                difference = guess[others][first] - guess[others][second]
                jitter = rng.standard_normal(difference.shape) * self._scale * 1e-3
                tried = guess[mine] + factor * difference + jitter
                after, worse = self._weigh(frame, tried)
                taken = np.log(rng.random(half)) < after - score[mine]
                guess[mine] = np.where(taken[:, None, None], tried, guess[mine])
                score[mine], misfit[mine] = (
                    np.where(taken, after, score[mine]),
                    np.where(taken, worse, misfit[mine]),
                )
            if step >= _WALK // 3:
                samples.append(guess.copy())
                misfits.append(float(misfit.mean()))
        every = _order(np.concatenate(samples), mixture.mode)
        weight = np.full(len(every), 1 / len(every))
        return replace(mixture, samples=every, weight=weight, misfit=float(np.mean(misfits)))

    def contacts(self, samples: np.ndarray) -> np.ndarray:
        """Return x, y and radius, m, force and tangential forces, N, of samples (N, n, P)."""
        flat = samples.reshape(-1, self._parameters)
        positions, force, _ = self._positions_of(flat)
        tangential = self.candidates.friction * force[:, None] * flat[:, 4:]
        return np.column_stack([positions, force, tangential]).reshape(samples.shape)


def _order(guess: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """Return guesses (N, n, P) with each contact in the row of the contact of a mode (n, P) that it is near.

    Contacts have no order of their own: without one, two positions would be averaged.
    """
    orders = np.array(list(permutations(range(len(mode)))))
    away = ((guess[:, orders, :2] - mode[:, :2]) ** 2).sum((2, 3))
    return np.take_along_axis(guess, orders[away.argmin(1)][..., None], axis=1)


def _differ(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether contacts (n, P) are elsewhere than others, in whatever order."""
    away = np.linalg.norm(first[:, None, :2] - second[:, :2], axis=2)
    return bool(max(away.min(0).max(), away.min(1).max()) > _ALIKE)
