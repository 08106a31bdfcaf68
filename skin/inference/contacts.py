"""Several contacts: found one after the other on the residual, refined together, weighed by samples."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtri
from scipy.stats.qmc import Sobol

from skin.inference.candidates import Candidates, FingertipPrior
from skin.inference.likelihood import Frame, fit_residual

_STEPS = 12  # of Gauss-Newton
_LATTICE = 0.0064  # m, largest distance of places that are searched in pairs
_TOLERANCE = 0.2  # relative misfit of a pair of such places
_PAIRS = 8  # pairs that are refined
_SAMPLES = 11  # binary logarithm of the number of samples
_WIDER = 1.15  # spread of the samples' proposal, relative to the posterior's

# A guess is (M, n, 4): x, y, radius, m, and the logarithm of the force.


@dataclass(frozen=True)
class Mixture:
    """Posterior of n contacts as weighted samples.

    Attributes:
        samples: (N, n, 4), x, y, radius, m, and force, N.
        weight: (N,), probabilities that sum to 1.
        evidence: log of the likelihood integrated over the prior.
        misfit: posterior mean of the squared misfit in variances.
        mode: (n, 4), the most probable contacts, with the logarithm of the force.
        felt: (S,), readings at the mode, N.
    """

    samples: np.ndarray
    weight: np.ndarray
    evidence: float
    misfit: float
    mode: np.ndarray
    felt: np.ndarray


class Search:
    """Finds several contacts in a frame.

    Args:
        candidates: of the skin.
        prior: of each contact; contacts are independent.
    """

    def __init__(self, candidates: Candidates, prior: FingertipPrior) -> None:
        self.candidates, self.prior = candidates, prior
        size, radii = candidates.size, candidates.radii
        self._middle = np.array([*(size / 2), sum(radii) / 2, math.log(prior.force)])
        self._deviation = np.array([*size, radii[1] - radii[0], 0]) / math.sqrt(12)
        self._deviation[3] = prior.spread
        # Places are not drawn to the middle of the skin; radii are, so that the proposal lies within them.
        self._tight = np.array([0.0, 0.0, 1.0, 1.0]) / self._deviation**2
        self._density = -math.log(size[0] * size[1] * (radii[1] - radii[0]))
        counts = np.ceil(size / _LATTICE).astype(int)
        x, y = ((np.arange(count) + 0.5) * side / count for count, side in zip(counts, size, strict=True))
        self._places = np.stack(np.meshgrid(x, y, [sum(radii) / 2], indexing="ij"), -1).reshape(-1, 3)
        self._lattice = np.ascontiguousarray(candidates.at(self._places)[0])

    @cached_property
    def _normal(self) -> np.ndarray:
        """Normal points in twelve dimensions (2^11, 12)."""
        return ndtri(Sobol(12, rng=0).random_base2(_SAMPLES).clip(1e-9, 1 - 1e-9))

    def felt(self, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (M, S), N, and their derivatives (M, 4 n, S) by place, radius and log force."""
        count, number, _ = guess.shape
        flat = guess.reshape(-1, 4)
        readings, slopes = self.candidates.at(flat[:, :3])
        force = np.exp(flat[:, 3])[:, None]
        columns = np.concatenate([force * slopes, (force * readings)[None]]).transpose(1, 0, 2)
        return (force * readings).reshape(count, number, -1).sum(1), columns.reshape(count, 4 * number, -1)

    def variance(self, frame: Frame, felt: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the variance (M, S), N^2, of readings as of :meth:`felt`."""
        variance = frame.noise.floor + (frame.noise.gain * felt) ** 2
        if frame.noise.position:
            for axis in (0, 1):
                variance = variance + (frame.noise.position * columns[:, axis::4].sum(1)) ** 2
        return variance

    def refine(self, frame: Frame, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return guesses after steps of Gauss and Newton, and their log posterior (M,)."""
        guess, damping = self._inside(guess), np.full(len(guess), 1e-2)
        score, pull, information = self._expand(frame, guess)
        for _ in range(_STEPS):
            ridge = damping[:, None] * np.diagonal(information, axis1=1, axis2=2)
            step = np.linalg.solve(information + ridge[:, None] * np.eye(pull.shape[1]), pull[..., None])
            bounded = np.clip(step.reshape(guess.shape), [-0.01, -0.01, -0.004, -1], [0.01, 0.01, 0.004, 1])
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
        low = [0, 0, self.candidates.radii[0], -np.inf]
        return np.clip(guess, low, [*self.candidates.size, self.candidates.radii[1], np.inf])

    def _expand(self, frame: Frame, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the log posterior (M,), its gradient (M, 4 n) and information (M, 4 n, 4 n)."""
        felt, columns = self.felt(guess)
        variance = self.variance(frame, felt, columns)
        misfit = frame.readings - felt
        counts = np.broadcast_to(frame.counts, felt.shape)
        if len(frame.clipped):
            # A sensor that clips pulls upwards until it is predicted to do so.
            misfit, counts = misfit.copy(), counts.copy()
            short = frame.noise.clip - felt[:, frame.clipped]
            misfit[:, frame.clipped], counts[:, frame.clipped] = short, short > 0
        weight = counts / variance
        distance = (self._middle - guess) * self._tight
        pull = np.vecdot(columns, (weight * misfit)[:, None]) + distance.reshape(len(guess), -1)
        information = np.matmul(columns * weight[:, None], columns.transpose(0, 2, 1))
        tight = np.tile(1 / self._deviation**2, guess.shape[1])
        information = information + np.diag(tight)
        penalty = 0.5 * ((self._middle - guess) ** 2 * self._tight).sum((1, 2))
        return frame.likelihood(felt, variance - frame.noise.floor) - penalty, pull, information

    def add(self, frame: Frame, guess: np.ndarray) -> tuple[np.ndarray, float]:
        """Return guesses (M, n + 1, 4) with a further contact, and the log factor of the evidence.

        The contacts of the guess (n, 4) may move, to first order. The factor is the mean of the likelihood
        ratio over all places and forces of the new contact, times the orders that it can have among the
        others; it counts places that no sensor feels.
        """
        felt, columns = self.felt(guess[None])
        weight = frame.counts / self.variance(frame, felt, columns)[0]
        scaled = columns[0] * weight
        information = scaled @ columns[0].T + np.diag(np.tile(1 / self._deviation**2, len(guess)))
        projected = np.diag(weight) - scaled.T @ np.linalg.solve(information, scaled)
        mode, ratio = fit_residual(
            self.prior, self._lattice, (frame.readings - felt[0]) * frame.counts, projected
        )
        top = ratio.max()
        best = self._apart(ratio, self._places, 3)
        new = np.column_stack([self._places[best], mode[best]])[:, None]
        guesses = np.concatenate([np.repeat(guess[None], len(best), 0), new], axis=1)
        return guesses, float(top + np.log(np.exp(ratio - top).mean())) + math.log(len(guess) + 1)

    @staticmethod
    def _apart(score: np.ndarray, places: np.ndarray, number: int) -> list[int]:
        """Return the best candidates that are not next to each other."""
        chosen = list[int]()
        for index in np.argsort(-score)[: 20 * number]:
            near = np.linalg.norm(places[chosen, :2] - places[index, :2], axis=1)
            if len(chosen) < number and (near > 2 * _LATTICE).all():
                chosen.append(int(index))
        return chosen

    def pairs(self, frame: Frame, felt: np.ndarray) -> np.ndarray:
        """Return the pairs (M, 2, 4) that explain best what contacts that feel (S,), N, leave over."""
        left = (frame.readings - felt).astype(np.float32)
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
        logarithm = np.log(np.clip(force, 0.05 * self.prior.force, 20 * self.prior.force))
        return np.concatenate([self._places[index], logarithm[..., None]], axis=2)

    def _new(self, pair: tuple[int, int], chosen: list[tuple[int, int]]) -> bool:
        """Return whether a pair is not nearly one of those that are chosen."""
        places = self._places[:, :2]
        return all(
            max(np.abs(places[pair[0]] - places[a]).max(), np.abs(places[pair[1]] - places[b]).max())
            > 1.5 * _LATTICE
            for a, b in chosen
        )

    def sample(self, frame: Frame, mode: np.ndarray) -> Mixture:
        """Return the posterior around a mode (n, 4), by importance samples."""
        number = len(mode)
        _, _, information = self._expand(frame, mode[None])
        spread = np.linalg.cholesky(np.linalg.inv(information[0])) * _WIDER
        normal = self._normal[:, : 4 * number]
        guess = mode + (normal @ spread.T).reshape(-1, number, 4)
        clipped = self._inside(guess)
        inside = (clipped == guess).all((1, 2))
        felt, columns = self.felt(clipped)
        extra = self.variance(frame, felt, columns) - frame.noise.floor
        forces = -0.5 * ((guess[..., 3] - self._middle[3]) / self.prior.spread) ** 2
        density = (forces - math.log(self.prior.spread) + self._density).sum(1)
        proposal = -0.5 * (normal**2).sum(1) - np.log(np.diagonal(spread)).sum()
        # Of 2 pi, the force of the prior and the 4 n numbers of the proposal have a root each.
        constant = 1.5 * number * math.log(2 * math.pi) + math.lgamma(number + 1)
        likelihood = frame.likelihood(felt, extra)
        logs = np.where(inside, likelihood + density - proposal + constant, -np.inf)
        top = logs.max()
        weight = np.exp(logs - top)
        total = weight.sum()
        misfit = ((frame.readings - felt) ** 2 / (frame.noise.floor + extra)) @ frame.counts
        samples = np.concatenate([guess[..., :3], np.exp(guess[..., 3:])], axis=2)
        evidence = float(top + math.log(total / len(weight)))
        return Mixture(
            samples, weight / total, evidence, float(weight @ misfit / total), mode, self.felt(mode[None])[0][0]
        )
