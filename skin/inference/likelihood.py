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


# Friction. Readings (..., 3 S) hold those of the force into the skin, and of a tangential force of a standard
# deviation along x and along y. Given position and force, the tangential force is normal: it is integrated.


def sum_loads(squares: np.ndarray, sensors: int) -> np.ndarray:
    """Return the mean squares (..., S) over tangential forces, of squares (..., S) or (..., 3 S)."""
    return squares.reshape(*squares.shape[:-1], squares.shape[-1] // sensors, sensors).sum(-2)


def blend(readings: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return readings (..., S) under tangential forces (..., 2), in standard deviations, or (..., 0)."""
    if not tangent.shape[-1]:
        return readings
    inwards, x, y = np.moveaxis(readings.reshape(*readings.shape[:-1], 3, readings.shape[-1] // 3), -2, 0)
    return inwards + tangent[..., :1] * x + tangent[..., 1:] * y


def relative_variance(noise: Noise, readings: np.ndarray, slopes: np.ndarray, sensors: int) -> np.ndarray:
    """Return the variance (N, S) from gains, thickness and positions, per square newton of force."""
    moved = np.float32(noise.position**2) * sum_loads(slopes[:, 0] ** 2 + slopes[:, 1] ** 2, sensors)
    return np.float32(noise.relative**2) * sum_loads(readings**2, sensors) + moved


class Forces(NamedTuple):
    """Posterior of the force of each of N candidates, to second order.

    Attributes:
        mode: (N,), of the logarithm of the force.
        curvature: (N,), of the log posterior there.
        pull, cross: (N, 2), products of what a tangential force along x and y adds with the frame, and with
            the readings of the force into the skin, over the variance; (N, 0) without friction.
        square: (N, 3), the same of x and x, x and y, y and y; or (N, 0).
    """

    mode: np.ndarray
    curvature: np.ndarray
    pull: np.ndarray
    cross: np.ndarray
    square: np.ndarray

    def tangent(self, force: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | float]:
        """Return the tangential force, in standard deviations, for forces (N,) or (N, J), N.

        Returns:
            Mean (..., 2), covariance (..., 2, 2), and what its integral adds to the log likelihood with the
            mean, (...,). Without friction the first has no columns.
        """
        if not self.pull.shape[1]:
            return np.empty((*force.shape, 0)), np.empty((*force.shape, 0, 0)), 0.0
        more = (slice(None), *(None,) * (force.ndim - 1))
        pull, cross, (xx, xy, yy) = self.pull[more], self.cross[more], np.moveaxis(self.square[more], -1, 0)
        inverse, determinant = _invert(xx * force**2 + 1, xy * force**2, yy * force**2 + 1)
        left = force[..., None] * (pull - force[..., None] * cross)
        mean = (inverse @ left[..., None])[..., 0]
        return mean, inverse, -0.5 * ((mean**2).sum(-1) + np.log(determinant))


def _invert(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverses (..., 2, 2) of symmetric matrices, and their determinants (...,)."""
    determinant = xx * yy - xy * xy
    rows = np.stack([yy, -xy, -xy, xx], axis=-1) / determinant[..., None]
    return rows.reshape(*determinant.shape, 2, 2), determinant


def fit_force(
    frame: Observation, prior: FingertipPrior, readings: np.ndarray, spread: np.ndarray
) -> tuple[Forces, np.ndarray]:
    """Return the force of candidates, and the log of the likelihood (N,) integrated over its prior.

    Args:
        frame: the frame.
        prior: of the force.
        readings: (N, L S), N/N.
        spread: (N, S), further variance per square newton.
    """
    floor, values = np.float32(frame.noise.floor), frame.readings
    plain = frame.counts / (floor + (np.float32(frame.noise.relative) * values) ** 2)
    inwards = readings[:, : len(values)]
    squares = inwards * inwards
    mode = _mode(prior, inwards @ (plain * values), squares @ plain, None)[0]
    forces = refit_force(frame, prior, readings, spread, mode)
    force = np.exp(forces.mode)
    tangent, _, added = forces.tangent(force)
    force = force[:, None]
    variance = force * force * spread
    fit = frame.likelihood(force * blend(readings, tangent), variance) + added
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
    variance = force * force * spread + np.float32(frame.noise.floor)
    sensors, values = len(frame.readings), frame.counts * frame.readings
    inwards = readings[:, :sensors]
    weight = inwards / variance
    along = weight @ values
    square = (weight * inwards) @ frame.counts
    pull = cross = products = np.empty((len(mode), 0), np.float32)
    if readings.shape[1] > sensors:
        x, y = readings[:, sensors : 2 * sensors], readings[:, 2 * sensors :]
        pull = np.stack([(side / variance) @ values for side in (x, y)], axis=1)
        weight *= frame.counts
        cross = np.stack([np.vecdot(weight, side) for side in (x, y)], axis=1)
        x_weighed, y_weighed = (side * (frame.counts / variance) for side in (x, y))
        products = np.stack(
            [np.vecdot(x_weighed, x), np.vecdot(x_weighed, y), np.vecdot(y_weighed, y)], axis=1
        )
        # What a tangential force explains does not count for the force.
        xx, xy, yy = products.T * force[:, 0] ** 2
        inverse, _ = _invert(xx + 1, xy, yy + 1)
        shared = force * (inverse @ (force * cross)[..., None])[..., 0]
        along, square = along - np.vecdot(shared, pull), square - np.vecdot(shared, cross)
    return Forces(*_mode(prior, along, square, mode), pull, cross, products)


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

    With friction, the last results are mean and variance of the tangential force, (N, J, 2), in its standard
    deviations per newton.

    Args:
        frame, prior, readings: as of :func:`fit_force`.
        spread: (N, S), further variance per square newton.
        fit: where the forces are.
    """
    nodes, weights = _NODES[bool(len(frame.clipped))]
    deviation = 1 / np.sqrt(fit.curvature)
    logarithm = fit.mode[:, None] + nodes.astype(np.float32) * deviation[:, None]
    force = np.exp(logarithm)
    tangent, covariance, added = fit.tangent(force)
    further = (force * force)[..., None] * spread[:, None]
    likelihood = added + frame.likelihood(force[..., None] * blend(readings[:, None], tangent), further)
    factor = np.log(weights / math.sqrt(2 * math.pi)) + nodes**2 / 2 + np.log(deviation)[:, None]
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    return force, likelihood + _density(prior, logarithm) + factor, tangent, variances


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
