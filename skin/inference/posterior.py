"""Posterior of one contact: boxes of places and radii, refined where the probability is."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from skin.inference.candidates import Boxes, Candidates, FingertipPrior
from skin.inference.noise import Noise

# A frame, and the likelihood of candidates. Forces are integrated around the most probable one.


_NEWTON = 5  # steps towards the most probable force; the last one changes it by less than 1 %
_NODES = {False: 3, True: 15}  # of the integral over forces, by whether a sensor clips


@dataclass(frozen=True)
class Frame:
    """A frame as the likelihood needs it.

    Attributes:
        readings: (S,), N; anything where they do not count.
        counts: (S,), 1 where the reading has a value, 0 where a sensor is invalid or clips.
        clipped: indices of sensors that clip.
        noise: of the readings.
    """

    readings: np.ndarray
    counts: np.ndarray
    clipped: np.ndarray
    noise: Noise

    @classmethod
    def of(cls, readings: np.ndarray, valid: np.ndarray, saturated: np.ndarray, noise: Noise) -> "Frame":
        """Return the frame of readings, valid and saturated, each (S,)."""
        values = np.where(valid & ~saturated, readings, 0.0)
        return cls(values, (valid & ~saturated).astype(float), np.flatnonzero(valid & saturated), noise)

    def empty(self) -> float:
        """Return the log likelihood of no contact at all."""
        floor = self.noise.floor
        values = self.readings * self.counts
        fit = -0.5 * (values @ values / floor + self.counts.sum() * math.log(2 * math.pi * floor))
        return float(fit + len(self.clipped) * log_ndtr(-self.noise.clip / math.sqrt(floor)))

    def likelihood(self, felt: np.ndarray, spread: np.ndarray | float) -> np.ndarray:
        """Return the log likelihood (...,) of true readings (..., S), N, with further variances, N^2."""
        variance = self.noise.floor + spread
        misfit = self.readings - felt
        terms = misfit * misfit / variance + np.log(2 * math.pi * variance)
        fit = -0.5 * (terms @ self.counts.astype(terms.dtype))
        if len(self.clipped):
            above = felt[..., self.clipped] - self.noise.clip
            deviation = np.sqrt(np.broadcast_to(variance, felt.shape)[..., self.clipped])
            fit = fit + log_ndtr(above / deviation).sum(-1)
        return fit


def relative_variance(noise: Noise, readings: np.ndarray, slopes: np.ndarray) -> np.ndarray | float:
    """Return the variance from gains and positions of sensors (N, S), per square newton of force."""
    spread: np.ndarray | float = 0.0
    if noise.gain:
        spread = (noise.gain * readings) ** 2
    if noise.position:
        spread = spread + noise.position**2 * (slopes[0] ** 2 + slopes[1] ** 2)
    return spread


@dataclass(frozen=True)
class Forces:
    """Posterior of the force of each of N candidates, to second order.

    Attributes:
        mode: (N,), of the logarithm of the force.
        curvature: (N,), of the log posterior there.
        evidence: (N,), log of the likelihood integrated over the prior of the force.
    """

    mode: np.ndarray
    curvature: np.ndarray
    evidence: np.ndarray


def fit_force(
    frame: Frame, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray | float
) -> Forces:
    """Return the force of candidates.

    Args:
        frame: the frame.
        prior: of the force.
        readings: (N, S), N/N.
        spread: (N, S), further variance per square newton.
    """
    kind = readings.dtype
    values, counts = frame.readings.astype(kind), frame.counts.astype(kind)
    plain = counts / (frame.noise.floor + (frame.noise.gain * values) ** 2).astype(kind)
    mode = _mode(prior, readings @ (plain * values), (readings * readings) @ plain)[0]
    force = np.exp(mode)[:, None]
    if isinstance(spread, np.ndarray):
        further = force * force * spread
        weight = readings / (frame.noise.floor + further)
        mode, curvature = _mode(prior, weight @ (counts * values), (weight * readings) @ counts)
        force = np.exp(mode)[:, None]
        further = force * force * spread
    else:
        further = np.zeros((1, 1), kind)
        mode, curvature = _mode(prior, readings @ (plain * values), (readings * readings) @ plain)
    density = -0.5 * ((mode - math.log(prior.force)) / prior.spread) ** 2 - math.log(prior.spread)
    evidence = frame.likelihood(force * readings, further) + density - 0.5 * np.log(curvature)
    return Forces(mode, curvature, evidence)


def _mode(prior: FingertipPrior, along: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable log force and the curvature of -(A F - B F^2 / 2) + prior there."""
    centre, tight = math.log(prior.force), 1 / prior.spread**2
    # Far above the noise the readings decide, else the prior.
    free = np.log(np.clip(along, 1e-12, None) / np.clip(square, 1e-12, None))
    mode = np.where(along * along > square, np.clip(free, centre - 9 * prior.spread, None), centre)
    for _ in range(_NEWTON):
        force = np.exp(mode)
        pull = force * (along - square * force) - tight * (mode - centre)
        curvature = np.maximum(force * (2 * square * force - along), 0.5 * square * force * force) + tight
        mode = mode + np.clip(pull / curvature, -1, 1)
    force = np.exp(mode)
    return mode, np.maximum(force * (2 * square * force - along), 0.0) + tight


def integrate_force(
    frame: Frame, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, J), N, and the log weight of each, whose sum is the integral over the prior."""
    fit = fit_force(frame, prior, readings, spread)
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES[bool(len(frame.clipped))])
    deviation = 1 / np.sqrt(fit.curvature)
    logarithm = fit.mode[:, None] + nodes * deviation[:, None]
    force = np.exp(logarithm)
    further = 0.0 if not isinstance(spread, np.ndarray) else (force * force)[..., None] * spread[:, None]
    likelihood = frame.likelihood(force[..., None] * readings[:, None], further)
    density = -0.5 * ((logarithm - math.log(prior.force)) / prior.spread) ** 2 - math.log(prior.spread)
    factor = np.log(weights / math.sqrt(2 * math.pi)) + nodes**2 / 2 + np.log(deviation)[:, None]
    return force, likelihood + density + factor


# Boxes, refined.


_LENGTH = 1.0  # a box is split along an axis that is longer, in standard deviations
_DROPPED = 1e-4  # probability that may be lost in a refinement
_MOST = 700  # boxes that are refined no further
_ROUNDS = 12


@dataclass(frozen=True)
class Cloud:
    """Posterior of one contact as weighted boxes.

    Attributes:
        boxes: N of them.
        force: (N, J), N.
        weight: (N, J), probabilities that sum to 1.
        evidence: log of the likelihood integrated over the prior.
    """

    boxes: Boxes
    force: np.ndarray
    weight: np.ndarray
    evidence: float


def one_contact(candidates: Candidates, prior: FingertipPrior, frame: Frame) -> Cloud:
    """Return the posterior of one contact."""
    boxes, readings, slopes = candidates.boxes, candidates.readings, candidates.slopes
    for _ in range(_ROUNDS):
        spread = relative_variance(frame.noise, readings, slopes)
        blur = (boxes.width**2 / 12).T.astype(np.float32)
        blurred = spread + np.einsum("kns,kns,kn->ns", slopes, slopes, blur)
        fit = fit_force(frame, prior, readings, blurred)
        kept = _probable(fit.evidence + np.log(boxes.width.prod(1)))
        boxes = Boxes(boxes.centre[kept], boxes.width[kept])
        readings, slopes = readings[kept], slopes[:, kept]
        spread = spread[kept] if isinstance(spread, np.ndarray) else spread
        force = np.exp(fit.mode[kept])
        along = _lengths(frame, prior, force, readings, slopes, spread) * boxes.width > _LENGTH
        if len(kept) > _MOST or not along.any():
            break
        boxes = boxes.split(along)
        readings, slopes = candidates.at(boxes.centre)
    return _weigh(frame, prior, boxes, readings, spread)


def _probable(evidence: np.ndarray) -> np.ndarray:
    """Return the indices of what holds nearly all probability, in their order."""
    chance = np.exp(evidence - evidence.max())
    order = np.argsort(chance)
    lost = np.cumsum(chance[order], dtype=float)
    return np.sort(order[lost > _DROPPED * lost[-1]])


def _lengths(
    frame: Frame,
    prior: FingertipPrior,
    force: np.ndarray,
    readings: np.ndarray,
    slopes: np.ndarray,
    spread: np.ndarray | float,
) -> np.ndarray:
    """Return standard deviations per m along place and radius (N, 3), with the force unknown."""
    variance = frame.noise.floor + (force**2)[:, None] * spread
    weight = frame.counts / variance
    if len(frame.clipped):
        # A sensor that clips tells about as much as its reading, near the limit.
        near = np.abs(force[:, None] * readings[:, frame.clipped] - frame.noise.clip)
        deviation = np.broadcast_to(np.sqrt(variance), readings.shape)[:, frame.clipped]
        weight = np.broadcast_to(weight, readings.shape).copy()
        weight[:, frame.clipped] = np.exp(-0.5 * (near / deviation) ** 2) / deviation**2
    square = (force**2)[:, None] * weight
    crossed = np.einsum("kns,ns,ns->kn", slopes, readings, square)
    own = np.einsum("kns,kns,ns->kn", slopes, slopes, square)
    whole = np.einsum("ns,ns,ns->n", readings, readings, square) + 1 / prior.spread**2
    return np.sqrt(np.maximum(own - crossed**2 / whole, 0)).T


def _weigh(
    frame: Frame,
    prior: FingertipPrior,
    boxes: Boxes,
    readings: np.ndarray,
    spread: np.ndarray | float,
) -> Cloud:
    precise = spread.astype(float) if isinstance(spread, np.ndarray) else spread
    force, logs = integrate_force(frame, prior, readings.astype(float), precise)
    logs = logs + np.log(boxes.width.prod(1))[:, None]
    top = logs.max()
    weight = np.exp(logs - top)
    total = weight.sum()
    return Cloud(boxes, force, weight / total, float(top + math.log(total)))
