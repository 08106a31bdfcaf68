"""Likelihood of a frame: noise, gains, positions of sensors, clipping; the force integrated."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from skin.inference.candidates import FingertipPrior
from skin.inference.noise import Noise

_NEWTON = 3  # steps towards the most probable force; the last one changes it by less than 1 %
_NODES = {clips: np.polynomial.hermite_e.hermegauss(count) for clips, count in ((False, 5), (True, 15))}


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

    def misfit_empty(self) -> float:
        """Return the squared misfit of no contact, in variances."""
        return float(self.readings**2 @ self.counts / self.noise.floor)

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
            fit += self.clipping(predicted[..., self.clipped], variance)
        return fit

    def clipping(self, predicted: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Return the log probability (...,) that those sensors clip, from their readings (..., C), N."""
        deviation = np.sqrt(variance[..., self.clipped] if variance.ndim else variance)
        return log_ndtr((predicted - np.float32(self.noise.clip)) / deviation).sum(-1)


def relative_variance(noise: Noise, readings: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return the variance (N, S) from gains, thickness and positions, per square newton of force."""
    moved = slopes[:, 0] ** 2 + slopes[:, 1] ** 2
    return np.float32(noise.relative**2) * readings**2 + np.float32(noise.position**2) * moved


class Forces(NamedTuple):
    """Posterior of the force of each of N candidates, to second order.

    Attributes:
        mode: (N,), of the logarithm of the force.
        curvature: (N,), of the log posterior there.
    """

    mode: np.ndarray
    curvature: np.ndarray


def fit_force(
    frame: Observation, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray
) -> tuple[Forces, np.ndarray]:
    """Return the force of candidates, and the log of the likelihood (N,) integrated over its prior.

    Args:
        frame: the frame.
        prior: of the force.
        readings: (N, S), N/N.
        spread: (N, S), further variance per square newton.
    """
    floor, values = np.float32(frame.noise.floor), frame.readings
    plain = frame.counts / (floor + (np.float32(frame.noise.relative) * values) ** 2)
    squares = readings * readings
    mode = _mode(prior, readings @ (plain * values), squares @ plain, None).mode
    forces = refit_force(frame, prior, readings, spread, mode)
    force = np.exp(forces.mode)[:, None]
    variance = force * force * spread
    fit = frame.likelihood(force * readings, variance)
    return forces, fit + _density(prior, forces.mode) - np.float32(0.5) * np.log(forces.curvature)


def refit_force(
    frame: Observation,
    prior: FingertipPrior,
    readings: np.ndarray,
    spread: np.ndarray,
    mode: np.ndarray,
) -> Forces:
    """Return the force of candidates from that of a similar likelihood, (N,), its logarithm."""
    force = np.exp(mode)[:, None]
    weight = readings / (force * force * spread + np.float32(frame.noise.floor))
    along = weight @ (frame.counts * frame.readings)
    weight *= readings
    return _mode(prior, along, weight @ frame.counts, mode)


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
    frame: Observation, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray, fit: Forces
) -> tuple[np.ndarray, np.ndarray]:
    """Return forces (N, J), N, and the log weight of each, whose sum is the integral over the prior.

    Args:
        frame, prior, readings: as of :func:`fit_force`.
        spread: (N, S), further variance per square newton.
        fit: where the forces are.
    """
    nodes, weights = _NODES[bool(len(frame.clipped))]
    deviation = 1 / np.sqrt(fit.curvature)
    logarithm = fit.mode[:, None] + nodes.astype(np.float32) * deviation[:, None]
    force = np.exp(logarithm)
    further = (force * force)[..., None] * spread[:, None]
    likelihood = frame.likelihood(force[..., None] * readings[:, None], further)
    factor = np.log(weights / math.sqrt(2 * math.pi)) + nodes**2 / 2 + np.log(deviation)[:, None]
    return force, likelihood + _density(prior, logarithm) + factor


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
    fit = _mode(prior, along, square, None)
    force = np.exp(fit.mode)
    gain = force * (along - force * square / 2) + _density(prior, fit.mode) - 0.5 * np.log(fit.curvature)
    return fit.mode, gain
