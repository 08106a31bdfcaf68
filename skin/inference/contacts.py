"""Several contacts: found one after the other on the residual, refined together, weighed by samples."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri, softmax
from scipy.stats.qmc import Sobol

from skin.inference.candidates import Boxes, CandidateReadings, FingertipPrior
from skin.inference.contact import Cloud
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
_WALKERS, _WALKS, _NARROWER = 64, 4, 0.9
"""Samples to start from, rounds, and spread relative to the first: at 0.6 / 0.9 / 1.2 regions of three
contacts contain 84 / 87 / 86 % (seed 7 of the contact study)."""

# A guess is (M, n, P): x, y, m, and scores whose prior is the standard normal distribution: of the radius,
# which is uniform, of the force, which is log-normal (P = 4), and with friction of the tangential force along
# x and y per newton (P = 6). Posteriors are then nearly Gaussian.


@dataclass(frozen=True)
class Mixture:
    """Posterior of n contacts as weighted samples.

    Attributes:
        samples: (N, n, P), x, y, m, with scores of radius and forces.
        weight: (N,), probabilities that sum to 1.
        owner: (N,), the distribution that each is from.
        spread: (M, P n, P n), roots of the covariances of these distributions.
        evidence: log of the likelihood integrated over the prior.
        misfit: posterior mean of the squared misfit in variances.
        mode: (n, P), the most probable contacts, with scores of radius and forces.
    """

    samples: np.ndarray
    weight: np.ndarray
    owner: np.ndarray
    spread: np.ndarray
    evidence: float
    misfit: float
    mode: np.ndarray


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

    def guess(self, contacts: np.ndarray) -> np.ndarray:
        """Return contacts (..., 4 or 6), as of :meth:`contacts`, as (..., P); without, friction is 0."""
        fraction, force = (contacts[..., 2:3] - self._minimum) / self._range, contacts[..., 3:4]
        scores = ndtri(fraction.clip(0.02, 0.98)), np.log(force / self.prior.force) / self.prior.spread
        sides = contacts[..., 4:] / (force * (self.candidates.friction or 1))
        guess = np.concatenate([contacts[..., :2], *scores, sides], axis=-1)
        return np.pad(guess, [(0, 0)] * (guess.ndim - 1) + [(0, self._parameters - guess.shape[-1])])

    def variance(self, frame: Observation, predicted: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the variance (M, S), N^2, of readings as of :meth:`predict`."""
        moved = columns.reshape(len(columns), -1, self._parameters, columns.shape[2])[:, :, :2].sum(1)
        further = (frame.noise.relative * predicted) ** 2 + np.square(frame.noise.position * moved).sum(1)
        return frame.noise.floor + further

    def refine(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return guesses after steps of Gauss and Newton, and their log posterior (M,)."""
        guess, damping = self._inside(guess), np.full(len(guess), 1e-2)
        best = self._expand(frame, guess)
        for _ in range(_STEPS):
            score, pull, information = best
            ridge = damping[:, None] * np.diagonal(information, axis1=1, axis2=2)
            step = np.linalg.solve(information + ridge[:, None] * np.eye(pull.shape[1]), pull[..., None])
            longest = np.array(_LONGEST[: self._parameters])
            tried = self._inside(guess + np.clip(step.reshape(guess.shape), -longest, longest))
            after = self._expand(frame, tried)
            better = after[0] > score
            best = tuple(
                np.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
                for new, old in zip(after, best, strict=True)
            )
            guess = np.where(better[:, None, None], tried, guess)
            damping = np.where(better, damping / 5, damping * 5).clip(1e-6, 1e3)
            if better.any() and (best[0] - score).max() < 1e-2:
                break
        return guess, best[0]

    def _inside(self, guess: np.ndarray) -> np.ndarray:
        free = [np.inf] * (self._parameters - 3)
        return np.clip(guess, [0, 0, -4, *np.negative(free)], [*self.candidates.size, 4, *free])

    def _expand(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the log posterior (M,), its gradient (M, P n) and information (M, P n, P n)."""
        score, _, predicted, columns, variance = self._weigh(frame, guess)
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
        return score, pull, information

    def extend(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, float]:
        """Return guesses (M, n + 1, P) that have the best further contacts beside a guess (n, P).

        The contacts of the guess may move, to first order. The further one has no friction.

        Returns:
            The guesses, and the log factor of the evidence: the mean of the likelihood ratio to no further
            contact over all positions, also where no sensor responds, times the orders that the contact can
            have among the others.
        """
        predicted, columns = self.predict(guess[None])
        weight = frame.counts / self.variance(frame, predicted, columns)[0]
        scaled = columns[0] * weight
        information = scaled @ columns[0].T + np.diag(np.tile(self._scale**-2, len(guess)))
        projected = np.diag(weight) - scaled.T @ np.linalg.solve(information, scaled)
        left = (frame.readings - predicted[0]) * frame.counts
        mode, ratio = fit_residual(self.prior, self._lattice, left, projected)
        factor = float(logsumexp(ratio)) + math.log((len(guess) + 1) / len(ratio))
        best = np.argsort(-ratio)[:60]
        new = self.guess(np.column_stack([self._positions[best], np.exp(mode[best])]))[:, None]
        new = new[_distinct(new, ratio[best], 2 * _LATTICE, 3)]
        return np.concatenate([np.repeat(guess[None], len(new), 0), new], axis=1), factor

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
        gain = np.triu(gain, 1)
        best = np.argpartition(-gain, min(60 * _PAIRS, gain.size) - 1, axis=None)[: 60 * _PAIRS]
        i, j = np.unravel_index(best[gain.flat[best] > 0], gain.shape)
        force = np.stack([first[i, j], first[j, i]], 1) / determinant[i, j, None]
        force = force.clip(*self.prior.force * np.exp(np.array([-4, 4]) * self.prior.spread))
        pairs = np.concatenate([self._positions[np.stack([i, j], 1)], force[..., None]], axis=2)
        return self.guess(pairs[_distinct(pairs, gain[i, j], 1.5 * _LATTICE, _PAIRS)])

    def sample(self, frame: Observation, modes: np.ndarray, score: np.ndarray) -> Mixture:
        """Return the posterior of contacts by importance samples around modes (M, n, P), and its evidence.

        Args:
            frame: the frame.
            modes: as of :meth:`refine`.
            score: (M,), their log posterior.
        """
        likely = score > score.max() - _UNLIKELY
        modes = modes[likely][_distinct(modes[likely], score[likely], _ALIKE, _MODES)]
        modes = _order(modes, modes[0])
        spread = np.linalg.cholesky(np.linalg.inv(self._expand(frame, modes)[2])) * _WIDER
        return self._draw(frame, modes, spread, modes[0])

    def _draw(self, frame: Observation, middles: np.ndarray, spread: np.ndarray, mode: np.ndarray) -> Mixture:
        """Return weighted samples of Student's distributions around guesses (M, n, P).

        ``spread`` (M, P n, P n) holds the roots of their covariances. Each has a block of the points: every
        fourth one of Sobol's lies in one half of the first axis.
        """
        number, size = middles.shape[1], spread.shape[1]
        owner = np.arange(2**_SAMPLES) * len(middles) // 2**_SAMPLES
        moved = np.matmul(spread[owner], (self._normal[:, :size] * self._stretch[:, None])[..., None])
        guess = middles[owner] + moved.reshape(-1, *middles.shape[1:])
        away = (guess - middles[:, None]).reshape(len(middles), -1, size).transpose(0, 2, 1)
        squares = np.square(np.linalg.solve(spread, away)).sum(1)
        tails = -0.5 * (_FREEDOM + size) * np.log1p(squares / _FREEDOM)
        volume = np.log(np.diagonal(spread, axis1=1, axis2=2)).sum(1, keepdims=True)
        constant = math.lgamma((_FREEDOM + size) / 2) - math.lgamma(_FREEDOM / 2)
        constant -= size / 2 * math.log(_FREEDOM * math.pi) + math.log(len(middles))
        logs, misfit, *_ = self._weigh(frame, guess)
        scores = -(size - 2 * number) / 2 * math.log(2 * math.pi)
        logs = logs - logsumexp(tails - volume, axis=0) - constant
        evidence = float(logsumexp(logs)) - _SAMPLES * math.log(2)
        evidence += scores + math.lgamma(number + 1) + number * self._density
        weight = softmax(logs)
        return Mixture(_order(guess, mode), weight, owner, spread, evidence, float(weight @ misfit), mode)

    def _weigh(self, frame: Observation, guess: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the log posterior (M,) but for constants, and the squared misfit in variances.

        The further results are readings and derivatives as of :meth:`predict`, and variances.
        """
        inside = self._inside(guess)
        predicted, columns = self.predict(inside)
        variance = self.variance(frame, predicted, columns)
        misfit = ((frame.readings - predicted) ** 2 / variance) @ frame.counts
        score = frame.likelihood(predicted, variance - frame.noise.floor) - 0.5 * (guess[..., 2:] ** 2).sum(
            (1, 2)
        )
        return np.where((inside == guess).all((1, 2)), score, -np.inf), misfit, predicted, columns, variance

    def walk(self, frame: Observation, mixture: Mixture) -> Mixture:
        """Return the posterior by samples around samples, which follow it where it is not Gaussian.

        Population Monte Carlo (Cappe 2004): each round proposes from narrow distributions around samples that
        are drawn by their weights.
        """
        edges, rounds = (np.arange(_WALKERS) + 0.5) / _WALKERS * (1 - 1e-9), list[Mixture]()
        last = replace(mixture, spread=_NARROWER * mixture.spread)
        for _ in range(_WALKS):
            chosen = np.searchsorted(np.cumsum(last.weight), edges)
            spread = last.spread[last.owner[chosen]]
            last = self._draw(frame, last.samples[chosen], spread, mixture.mode)
            rounds.append(last)
        weight = np.concatenate([each.weight for each in rounds]) / _WALKS
        return replace(last, samples=np.concatenate([each.samples for each in rounds]), weight=weight)

    def contacts(self, guess: np.ndarray) -> np.ndarray:
        """Return x, y and radius, m, force and tangential forces, N, of guesses (N, n, P)."""
        flat = guess.reshape(-1, self._parameters)
        positions, force, _ = self._positions_of(flat)
        tangential = self.candidates.friction * force[:, None] * flat[:, 4:]
        return np.column_stack([positions, force, tangential]).reshape(guess.shape)

    def clouds(self, mixture: Mixture) -> Iterator[Cloud]:
        """Yield the posterior of each contact; a sample is a box a standard deviation wide."""
        weight, modes = mixture.weight[:, None], self.contacts(mixture.mode[None])
        for contact, mode in zip(self.contacts(mixture.samples).swapaxes(0, 1), modes[0], strict=True):
            moved = contact[:, :2] - mixture.weight @ contact[:, :2]
            width = np.sqrt(np.maximum(mixture.weight @ moved**2, 1e-12))
            boxes = Boxes(contact[:, :3], np.tile([*width, 0], (len(contact), 1)))
            sides = contact[:, None, 4:]
            yield Cloud(
                boxes, contact[:, 3:4], weight, mixture.evidence, mixture.misfit, sides, 0 * sides, mode
            )


def _order(guess: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """Return guesses (N, n, P) with each contact in the row of the contact of a mode (n, P) that it is near.

    Contacts have no order of their own: without one, two positions would be averaged.
    """
    orders = np.array(list(permutations(range(len(mode)))))
    away = ((guess[:, orders, :2] - mode[:, :2]) ** 2).sum((2, 3))
    return np.take_along_axis(guess, orders[away.argmin(1)][..., None], axis=1)


def _distinct(guess: np.ndarray, score: np.ndarray, apart: float, most: int) -> list[int]:
    """Return which guesses (M, n, P) are best, the best first; each has a contact apart, m, in any order."""
    chosen, left = list[int](), np.argsort(-score, kind="stable")
    while len(left) and len(chosen) < most:
        chosen.append(int(left[0]))
        away = np.linalg.norm(guess[left][:, :, None, :2] - guess[left[0], :, :2], axis=3)
        left = left[np.maximum(away.min(1).max(1), away.min(2).max(1)) > apart]
    return chosen
