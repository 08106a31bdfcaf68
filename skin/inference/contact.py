"""One contact: boxes of places and radii, refined where the probability is."""

import math
from dataclasses import dataclass

import numpy as np

from skin.inference.candidates import Boxes, CandidateReadings, FingertipPrior
from skin.inference.likelihood import Forces, Observation, fit_force, integrate_force, relative_variance

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
        misfit: posterior mean of the squared misfit in variances.
    """

    boxes: Boxes
    force: np.ndarray
    weight: np.ndarray
    evidence: float
    misfit: float

    @property
    def mode(self) -> np.ndarray:
        """The most probable contact (1, 4): x, y and radius, m, and force, N."""
        box, force = np.unravel_index(self.weight.argmax(), self.weight.shape)
        return np.array([[*self.boxes.centre[box], self.force[box, force]]])


def one_contact(candidates: CandidateReadings, prior: FingertipPrior, frame: Observation) -> Cloud:
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
    return _weigh(candidates, frame, prior, boxes, readings, spread, forces)


def _blurred(boxes: Boxes, slopes: np.ndarray, spread: np.ndarray | None) -> np.ndarray:
    """Return the variance (N, S) per square newton with that over a box, which then speaks for all in it."""
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
    frame: Observation,
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
    candidates: CandidateReadings,
    frame: Observation,
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
    weight /= total
    middle = np.exp(fit.mode)[:, None]
    variance = frame.noise.floor + (0 if spread is None else middle * middle * spread)
    misfit = ((frame.readings - middle * readings) ** 2 / variance) @ frame.counts
    extent = float(np.prod(candidates.size) * (prior.radii[1] - prior.radii[0]))
    evidence = float(top + math.log(total) - math.log(extent))
    return Cloud(boxes, force, weight, evidence, float(weight.sum(1) @ misfit) + 1)
