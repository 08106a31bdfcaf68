"""Posterior of one contact: boxes of places and radii, refined where the probability is."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from skin.inference.candidates import Boxes, Candidates, FingertipPrior
from skin.inference.noise import Noise

# A frame, and the likelihood of candidates. Forces are integrated around the most probable one.


_NEWTON = 3  # steps towards the most probable force; the last one changes it by less than 1 %
_NODES = {False: 3, True: 15}  # of the integral over forces, by whether a sensor clips


@dataclass(frozen=True)
class Frame:
    """A frame as the likelihood needs it.

    Attributes:
        readings: (S,), N, float32; 0 where they do not count.
        counts: (S,), float32: 1 where the reading has a value, 0 where a sensor is invalid or clips.
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
        valued = valid & ~saturated
        values = np.where(valued, readings, 0.0).astype(np.float32)
        return cls(values, valued.astype(np.float32), np.flatnonzero(valid & saturated), noise)

    def empty(self) -> float:
        """Return the log likelihood of no contact at all."""
        return float(self.likelihood(np.zeros((1, len(self.readings)), np.float32), np.float32(0))[0])

    def likelihood(self, felt: np.ndarray, spread: np.ndarray | np.float32) -> np.ndarray:
        """Return the log likelihood (...,) of true readings (..., S), N, with further variances, N^2."""
        variance = spread + np.float32(self.noise.floor)
        terms = self.readings - felt
        terms *= terms
        terms /= variance
        fit = terms @ self.counts
        fit += np.log(np.float32(2 * math.pi) * variance) @ self._each(variance)
        fit *= np.float32(-0.5)
        if len(self.clipped):
            fit += self.clipping(felt[..., self.clipped], variance)
        return fit

    def _each(self, variance: np.ndarray) -> np.ndarray:
        return self.counts if variance.ndim else self.counts.sum()[None]

    def clipping(self, felt: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Return the log probability (...,) that the sensors that clip do so, from their readings (..., C)."""
        deviation = np.sqrt(variance[..., self.clipped] if variance.ndim else variance)
        return log_ndtr((felt - np.float32(self.noise.clip)) / deviation).sum(-1)


def relative_variance(noise: Noise, readings: np.ndarray, slopes: np.ndarray) -> np.ndarray | None:
    """Return the variance from gains and positions of sensors (N, S), per square newton of force, or None."""
    spread = None
    if noise.gain:
        spread = (np.float32(noise.gain) * readings) ** 2
    if noise.position:
        moved = np.float32(noise.position**2) * (slopes[0] ** 2 + slopes[1] ** 2)
        spread = moved if spread is None else spread + moved
    return spread


class Forces(NamedTuple):
    """Posterior of the force of each of N candidates, to second order.

    Attributes:
        mode: (N,), of the logarithm of the force.
        curvature: (N,), of the log posterior there.
    """

    mode: np.ndarray
    curvature: np.ndarray


def fit_force(
    frame: Frame, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray
) -> tuple[Forces, np.ndarray]:
    """Return the force of candidates, and the log of the likelihood (N,) integrated over its prior.

    Args:
        frame: the frame.
        prior: of the force.
        readings: (N, S), N/N.
        spread: (N, S), further variance per square newton.
    """
    floor, values = np.float32(frame.noise.floor), frame.readings
    plain = frame.counts / (floor + (np.float32(frame.noise.gain) * values) ** 2)
    squares = readings * readings
    mode = _mode(prior, readings @ (plain * values), squares @ plain, None).mode
    force = np.exp(mode)[:, None]
    variance = force * force * spread
    variance += floor
    squares /= variance
    along = (readings / variance) @ (frame.counts * values)
    forces = _mode(prior, along, squares @ frame.counts, mode)
    force = np.exp(forces.mode)[:, None]
    variance = force * force * spread
    fit = frame.likelihood(force * readings, variance)
    return forces, fit + _density(prior, forces.mode) - np.float32(0.5) * np.log(forces.curvature)


def _density(prior: FingertipPrior, mode: np.ndarray) -> np.ndarray:
    """Return the log of the prior of a log force, but for the root of 2 pi."""
    return -0.5 * ((mode - math.log(prior.force)) / prior.spread) ** 2 - math.log(prior.spread)


def _mode(prior: FingertipPrior, along: np.ndarray, square: np.ndarray, start: np.ndarray | None) -> Forces:
    """Return the most probable log force, that of A F - B F^2 / 2 and the prior."""
    centre, tight = math.log(prior.force), 1 / prior.spread**2
    if start is None:
        # Far above the noise the readings decide, else the prior.
        free = np.log(np.maximum(along, np.float32(1e-12)) / np.maximum(square, np.float32(1e-12)))
        start = np.where(along * along > square, np.maximum(free, centre - 9 * prior.spread), centre)
    mode = start.astype(np.float32)
    for _ in range(_NEWTON):
        pull, curvature = _push(mode, along, square)
        pull -= tight * (mode - centre)
        curvature += tight
        pull /= curvature
        mode += np.minimum(np.maximum(pull, -1), 1)
    return Forces(mode, _push(mode, along, square)[1] + tight)


def _push(mode: np.ndarray, along: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope of A F - B F^2 / 2 along log F, and its curvature or a part of it that is positive."""
    force = np.exp(mode)
    rising, falling = along * force, square * force
    falling *= force
    return rising - falling, np.maximum(2 * falling - rising, 0.5 * falling)


def integrate_force(
    frame: Frame, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray | None, fit: Forces
) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, J), N, and the log weight of each, whose sum is the integral over the prior.

    Args:
        frame, prior, readings: as of :func:`fit_force`.
        spread: (N, S), further variance per square newton; None: none.
        fit: where the forces are.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES[bool(len(frame.clipped))])
    deviation = 1 / np.sqrt(fit.curvature)
    logarithm = fit.mode[:, None] + nodes.astype(np.float32) * deviation[:, None]
    force = np.exp(logarithm)
    if spread is None:
        likelihood = _quadratic(frame, readings, force)
    else:
        felt, further = force[..., None] * readings[:, None], (force * force)[..., None] * spread[:, None]
        likelihood = frame.likelihood(felt, further)
    factor = np.log(weights / math.sqrt(2 * math.pi)) + nodes**2 / 2 + np.log(deviation)[:, None]
    return force, likelihood + _density(prior, logarithm) + factor


def _quadratic(frame: Frame, readings: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the log likelihood of forces (N, J) where the variance does not depend on them."""
    floor = frame.noise.floor
    precise = readings.astype(float)
    values, counts = frame.readings.astype(float), frame.counts.astype(float)
    along, square = precise @ (counts * values), (precise * precise) @ counts
    misfit = values @ values - force * (2 * along[:, None] - force * square[:, None])
    fit = -0.5 * (misfit / floor + counts.sum() * math.log(2 * math.pi * floor))
    if len(frame.clipped):
        fit += frame.clipping(force[..., None] * precise[:, None, frame.clipped], np.asarray(floor))
    return fit


# Boxes, refined.


_LENGTH = 1.0  # a box is split along an axis that is longer, in standard deviations
_DROPPED = 1e-4  # probability that may be lost in a refinement
_MOST = 700  # boxes that are refined no further
_ROUNDS = 12
_RADIUS_STEP = 0.3  # largest share of the radii in a box


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
        forces, evidence = fit_force(frame, prior, readings, _blurred(boxes, slopes, spread))
        kept = _probable(evidence + np.log(boxes.width.prod(1)))
        boxes = Boxes(boxes.centre[kept], boxes.width[kept])
        readings, slopes = readings[kept], slopes[:, kept]
        spread = None if spread is None else spread[kept]
        forces = Forces(forces.mode[kept], forces.curvature[kept])
        along = _lengths(frame, prior, forces, readings, slopes, spread) * boxes.width > _LENGTH
        along[:, 2] |= boxes.width[:, 2] > _RADIUS_STEP * (prior.radii[1] - prior.radii[0])
        if len(kept) > _MOST or not along.any():
            break
        boxes = boxes.split(along)
        readings, slopes = candidates.at(boxes.centre)
    return _weigh(frame, prior, boxes, readings, spread, forces)


def _blurred(boxes: Boxes, slopes: np.ndarray, spread: np.ndarray | None) -> np.ndarray:
    """Return the variance (N, S) per square newton with that over a box, so that a box speaks for all in it."""
    scaled = slopes * (boxes.width * math.sqrt(1 / 12)).T.astype(np.float32)[..., None]
    scaled *= scaled
    blurred = scaled[0]
    blurred += scaled[1]
    blurred += scaled[2]
    return blurred if spread is None else blurred + spread


def _probable(evidence: np.ndarray) -> np.ndarray:
    """Return the indices of what holds nearly all probability, in their order."""
    chance = np.exp(evidence - evidence.max())
    order = np.argsort(chance)
    lost = np.cumsum(chance[order], dtype=float)
    return np.sort(order[lost > _DROPPED * lost[-1]])


def _lengths(
    frame: Frame,
    prior: FingertipPrior,
    fit: Forces,
    readings: np.ndarray,
    slopes: np.ndarray,
    spread: np.ndarray | None,
) -> np.ndarray:
    """Return standard deviations per m along place and radius (N, 3), with the force unknown."""
    force = np.exp(fit.mode)[:, None]
    square = force * force
    variance = np.float32(frame.noise.floor) + (0 if spread is None else square * spread)
    weight = np.broadcast_to(frame.counts / variance, readings.shape)
    if len(frame.clipped):
        # A sensor that clips tells about as much as its reading, near the limit.
        near = np.abs(force * readings[:, frame.clipped] - frame.noise.clip)
        deviation = np.broadcast_to(np.sqrt(variance), readings.shape)[:, frame.clipped]
        weight = weight.copy()
        weight[:, frame.clipped] = np.exp(-0.5 * (near / deviation) ** 2) / deviation**2
    square = square * weight
    felt = readings * square
    whole = np.vecdot(felt, readings) + 1 / prior.spread**2
    crossed = np.vecdot(slopes, felt)
    return np.sqrt(np.maximum(np.vecdot(slopes * square, slopes) - crossed**2 / whole, 0)).T


def _weigh(
    frame: Frame,
    prior: FingertipPrior,
    boxes: Boxes,
    readings: np.ndarray,
    spread: np.ndarray | None,
    fit: Forces,
) -> Cloud:
    force, logs = integrate_force(frame, prior, readings, spread, fit)
    logs = logs + np.log(boxes.width.prod(1))[:, None]
    top = logs.max()
    weight = np.exp(logs - top)
    total = weight.sum()
    return Cloud(boxes, force, weight / total, float(top + math.log(total)))
