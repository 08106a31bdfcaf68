"""Likelihood of a frame: noise, gains, positions of sensors, clipping; the force integrated."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from skin.inference.candidates import FingertipPrior
from skin.inference.noise import Noise

NEGLIGIBLE = 1e-4
"""N/N, a reading so small that a sensor of it never clips."""

_NEWTON = 3  # steps towards the most probable force; the last one changes it by less than 1 %
_NODES, _CUT_NODES = np.polynomial.hermite_e.hermegauss(5), np.polynomial.legendre.leggauss(20)


@dataclass(frozen=True)
class Observation:
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
    def of(
        cls, readings: np.ndarray, valid: np.ndarray, saturated: np.ndarray, noise: Noise
    ) -> "Observation":
        """Return the frame of readings, valid and saturated, each (S,)."""
        valued = valid & ~saturated
        values = np.where(valued, readings, 0.0).astype(np.float32)
        return cls(values, valued.astype(np.float32), np.flatnonzero(valid & saturated), noise)

    def empty(self) -> float:
        """Return the log likelihood of no contact at all."""
        nothing = np.zeros((1, len(self.readings)), np.float32)
        return float(self.likelihood(nothing, nothing)[0])

    def likelihood(self, predicted: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Return the log likelihood (...,) of true readings (..., S), N, with further variances, N^2."""
        variance = spread + np.float32(self.noise.floor)
        terms = self.readings - predicted
        terms *= terms
        terms /= variance
        fit = terms @ self.counts
        fit += np.log(np.float32(2 * math.pi) * variance) @ self.counts
        fit *= np.float32(-0.5)
        if len(self.clipped):
            above = predicted[..., self.clipped] - np.float32(self.noise.clip)
            fit += log_ndtr(above / np.sqrt(variance[..., self.clipped])).sum(-1)
        return fit


# Friction. Readings (..., L, S) are those of the force into the skin (L = 1) and, with friction (L = 3), of a
# tangential force of a standard deviation along x and along y. Given position and force, the tangential force
# is normal: it is integrated.


def blend(readings: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return readings of (N, L, S) under tangential forces (N, J, L - 1), in their deviations.

    Their shape is (N, J, S), or without friction (N, 1, S), as all tangential forces are 0.
    """
    return (
        readings[:, :1] + tangent.astype(readings.dtype) @ readings[:, 1:] if tangent.shape[2] else readings
    )


def spread_readings(noise: Noise, rows: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return variances (N, S) per square newton of force, of candidates with rows (N, 4, L, S).

    The first is that of gains, thickness and positions; the second adds that over boxes of a width (N, 3), m,
    which a box then represents.
    """
    own = np.array([noise.relative, noise.position, noise.position, 0]) ** 2
    boxes = own + np.pad(width**2 / 12, [(0, 0), (1, 0)])
    squares = np.einsum("nkls,nkls->nks", rows, rows)
    both = np.stack(np.broadcast_arrays(own, boxes), axis=1).astype(np.float32) @ squares
    return both[:, 0], both[:, 1]


class Forces(NamedTuple):
    """Posterior of the force of each of N candidates, to second order, without the sensors that clip.

    Attributes:
        mode: (N,), of the logarithm of the force.
        curvature: (N,), of the log posterior there.
        pull: (N, L), products of the readings of each load with the frame, over the variance.
        gram: (N, L, L), the same with each other.
    """

    mode: np.ndarray
    curvature: np.ndarray
    pull: np.ndarray
    gram: np.ndarray

    def tangent(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the tangential force, in standard deviations, for forces (N, J), N.

        Returns:
            Mean (N, J, L - 1), covariance (N, J, L - 1, L - 1), and what its integral adds to the log
            likelihood with the mean, (N, J).
        """
        pull, gram, scale = self.pull[:, None], self.gram[:, None], force[..., None]
        inverse, determinant = invert_on_prior(gram[..., 1:, 1:] * scale[..., None] ** 2)
        left = scale * (pull[..., 1:] - scale * gram[..., 0, 1:])
        mean = (inverse @ left[..., None])[..., 0]
        return mean, inverse, -0.5 * (np.vecdot(mean, mean) + np.log(determinant))


def invert_on_prior(information: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
    """Return the inverses of information (..., L - 1, L - 1) on a standard normal prior, and determinants."""
    if not information.shape[-1]:
        return information, 1.0
    xx, xy, yy = information[..., 0, 0] + 1, information[..., 0, 1], information[..., 1, 1] + 1
    determinant = xx * yy - xy * xy
    rows = np.stack([yy, -xy, -xy, xx], axis=-1) / determinant[..., None]
    return rows.reshape(information.shape), determinant


def fit_force(
    frame: Observation, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray
) -> tuple[Forces, np.ndarray]:
    """Return the force of candidates, and the log of the likelihood (N,) integrated over its prior.

    Of the sensors that clip, the one counts that needs the largest force.

    Args:
        frame: the frame.
        prior: of the force.
        readings: (N, L, S), N/N.
        spread: (N, S), further variance per square newton.
    """
    floor, values = np.float32(frame.noise.floor), frame.readings
    plain = frame.counts / (floor + (np.float32(frame.noise.relative) * values) ** 2)
    inwards = readings[:, 0]
    mode = _mode(prior, inwards @ (plain * values), np.square(inwards) @ plain, None)[0]
    forces = refit_force(frame, prior, readings, spread, mode)
    force = np.exp(forces.mode)[:, None]
    tangent, _, added = forces.tangent(force)
    predicted, further = force * blend(readings, tangent)[:, 0], force * force * spread
    fit = replace(frame, clipped=frame.clipped[:0]).likelihood(predicted, further) + added[:, 0]
    fit += _density(prior, forces.mode) - np.float32(0.5) * np.log(forces.curvature)
    if len(frame.clipped):
        needed, _, width, _ = needed_force(frame, readings, spread, forces)
        fit += log_ndtr((forces.mode - needed) / width)
    return forces, fit


def needed_force(
    frame: Observation, readings: np.ndarray, spread: np.ndarray, fit: Forces
) -> tuple[np.ndarray, ...]:
    """Return the log force (N,) at which all sensors that clip do so.

    The further results are its standard deviation (N,), that of its difference to the log force of a
    candidate (N,), and the index (N,) of the sensor that needs it.
    """
    needed = math.log(frame.noise.clip) - np.log(np.maximum(readings[:, 0, frame.clipped], NEGLIGIBLE))
    own = (frame.noise.floor + np.exp(2 * needed) * spread[:, frame.clipped]) / frame.noise.clip**2
    width = np.sqrt(own + 1 / fit.curvature[:, None])
    largest = range(len(needed)), ((fit.mode[:, None] - needed) / width).argmin(1)
    return needed[largest], np.sqrt(own[largest]), width[largest], frame.clipped[largest[1]]


def refit_force(
    frame: Observation,
    prior: FingertipPrior,
    readings: np.ndarray,
    spread: np.ndarray,
    mode: np.ndarray,
) -> Forces:
    """Return the force of candidates from that of a similar likelihood, (N,), its logarithm."""
    force = np.exp(mode)[:, None]
    weight = frame.counts / (force * force * spread + np.float32(frame.noise.floor))
    weighted = readings * weight[:, None]
    # Matrices are so small that calls of BLAS take longer than the products.
    pull, gram = np.vecdot(weighted, frame.readings), np.vecdot(weighted[:, :, None], readings[:, None])
    # What a tangential force explains does not count for the force.
    inverse, _ = invert_on_prior(gram[:, 1:, 1:] * force[..., None] ** 2)
    cross = gram[:, 0, 1:]
    shared = force * (inverse @ (force * cross)[..., None])[..., 0]
    along, square = pull[:, 0] - np.vecdot(shared, pull[:, 1:]), gram[:, 0, 0] - np.vecdot(shared, cross)
    return Forces(*_mode(prior, along, square, mode), pull, gram)


def _density(prior: FingertipPrior, mode: np.ndarray) -> np.ndarray:
    """Return the log of the prior of a log force, but for the root of 2 pi."""
    return -0.5 * ((mode - math.log(prior.force)) / prior.spread) ** 2 - math.log(prior.spread)


def _mode(
    prior: FingertipPrior, along: np.ndarray, square: np.ndarray, start: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable log force, that of A F - B F^2 / 2 and the prior, and the curvature there."""
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
    return mode, _push(mode, along, square)[1] + tight


def _push(mode: np.ndarray, along: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope of A F - B F^2 / 2 along log F, and its curvature or a part of it that is positive."""
    force = np.exp(mode)
    rising, falling = along * force, square * force
    falling *= force
    return rising - falling, np.maximum(2 * falling - rising, 0.5 * falling)


def integrate_force(
    frame: Observation, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray, fit: Forces
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return forces (N, J), N, and the log weight of each, whose sum is the integral over the prior.

    The last results are mean and variance of the tangential force, (N, J, L - 1), in its standard deviations
    per newton.

    Args:
        frame, prior, readings: as of :func:`fit_force`.
        spread: (N, S), further variance per square newton.
        fit: where the forces are.
    """
    deviation, mode = 1 / np.sqrt(fit.curvature)[:, None], fit.mode[:, None]
    nodes, weights = _CUT_NODES if len(frame.clipped) else _NODES
    if len(frame.clipped):
        # What is probable is cut off where a sensor would not clip yet.
        needed, own, *_ = (each[:, None] for each in needed_force(frame, readings, spread, fit))
        needed = np.minimum(needed, mode + 8 * deviation)
        low = np.maximum(mode - 4 * deviation, needed - 4 * own)
        half = (np.maximum(mode + 4 * deviation, needed + deviation) - low) / 2
        logarithm, factor = low + half * (1 + nodes), np.log(weights * half)
    else:
        logarithm = mode + nodes.astype(np.float32) * deviation
        factor = np.log(weights * deviation) + nodes**2 / 2
    force = np.exp(logarithm)
    tangent, covariance, added = fit.tangent(force)
    further = (force * force)[..., None] * spread[:, None]
    likelihood = added + frame.likelihood(force[..., None] * blend(readings, tangent), further)
    logs = likelihood + _density(prior, logarithm) + factor - math.log(2 * math.pi) / 2
    return force, logs, tangent, np.diagonal(covariance, axis1=-2, axis2=-1)


def fit_residual(
    prior: FingertipPrior, readings: np.ndarray, residual: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the log force (N,) of candidates that explain a residual, and their log likelihood ratio.

    The ratio is that to no further contact, integrated over the prior of the force.

    Args:
        prior: of the force.
        readings: (N, S), N/N.
        residual: (S,), N.
        weight: (S, S), inverse of the covariance of the residual.
    """
    weighted = readings @ weight.astype(np.float32)
    along, square = weighted @ residual.astype(np.float32), np.vecdot(weighted, readings)
    mode, curvature = _mode(prior, along, square, None)
    force = np.exp(mode)
    gain = force * (along - force * square / 2) + _density(prior, mode) - 0.5 * np.log(curvature)
    return mode, gain
