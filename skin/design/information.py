"""The local precision: how precisely readings determine where and how hard a fingertip presses.

With independent noise of the readings and Gaussian priors, the inverse of J' R^-1 J + P is the covariance
of the parameters given the readings, to first order (Van Trees, Detection, Estimation, and Modulation
Theory, 2.4). J are the derivatives of the readings, R the variances of the noise, P the inverse variances
of the priors.

This is no limit for estimators. It describes touches near the true one, and only through the slopes of the
readings: a sensor that stays silent has no slope, yet it tells that the touch is not near it. The exact
posterior uses that. Above a single sensor it is several times narrower.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from skin.simulator.base import AbstractSimulator
from skin.touch.fingertip import PARAMETERS, Fingertip

_AT_ONCE = 64  # touches; their samples then take about 50 MB with all derivatives


@dataclass(frozen=True)
class Noise:
    """How readings differ from those of the model.

    Attributes:
        frame: standard deviation of the noise of a sensor in a frame, N.
        frames: number of frames that are averaged.
        gain: standard deviation of the unknown gain of each sensor, relative; 0: gains are known.
        clip: largest force that a sensor measures, N.
    """

    frame: float
    frames: int = 1
    gain: float = 0.0
    clip: float = float("inf")

    def variance(self, readings: Tensor) -> Tensor:
        """Return the variance (B, S), N^2, of the mean of the frames of readings (B, S), N.

        It is infinite where a sensor clips: its reading does not depend on the touch.
        """
        known = self.frame**2 / self.frames + (self.gain * readings).square()
        return known.masked_fill(readings >= self.clip, torch.inf)

    def felt(self, readings: Tensor, sigmas: float = 3.0) -> Tensor:
        """Return which readings (B, S), N, exceed the noise of one frame, bool."""
        return readings > sigmas * self.frame


@dataclass(frozen=True)
class Sensitivity:
    """Readings of touches, and their derivatives.

    Attributes:
        readings: (B, S), N.
        slopes: (B, S, 4), with respect to the parameters of :data:`skin.touch.fingertip.PARAMETERS`.
    """

    readings: Tensor
    slopes: Tensor

    def of_force(self, force: float) -> "Sensitivity":
        """Return the sensitivity to ``force`` times the force.

        A simulator is positively homogeneous: only the derivative with respect to the force stays.
        """
        factors = torch.tensor([force, force, force, 1.0]).to(self.slopes)
        return Sensitivity(self.readings * force, self.slopes * factors)


def sensitivity(simulator: AbstractSimulator, fingertip: Fingertip, touches: Tensor) -> Sensitivity:
    """Return readings and their derivatives, by forward-mode automatic differentiation.

    Args:
        simulator: maps pressure to readings; its buffers become float64.
        fingertip: the pressure of a touch.
        touches: (B, 4).
    """
    simulator.double()
    parts = list(_parts(simulator, fingertip, touches.double()))
    return Sensitivity(*(torch.cat(one) for one in zip(*parts, strict=True)))


def _parts(
    simulator: AbstractSimulator, fingertip: Fingertip, touches: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    for part in touches.split(_AT_ONCE):
        slopes = []
        for axis in range(len(PARAMETERS)):
            along = torch.zeros_like(part)
            along[:, axis] = 1
            # Touches do not influence each other, so one direction serves all of them.
            found = torch.func.jvp(lambda one: simulator(fingertip(one)).readings, (part,), (along,))
            slopes.append(found[1])
        yield found[0], torch.stack(slopes, dim=-1)


def local_covariance(sensitivity: Sensitivity, noise: Noise, priors: Tensor) -> Tensor:
    """Return the covariance of the parameters given the readings, to first order, (B, 4, 4), m and N.

    Args:
        sensitivity: of the touches.
        noise: of the readings.
        priors: standard deviation of each parameter before the touch, (4,) or (B, 4), m and N.
    """
    weights = 1 / noise.variance(sensitivity.readings)
    # Parameters in units of their priors: the matrix is then well conditioned.
    slopes = sensitivity.slopes * priors[..., None, :].to(sensitivity.slopes)
    information = torch.einsum("bsi,bs,bsj->bij", slopes, weights, slopes) + torch.eye(len(PARAMETERS))
    scales = priors.to(slopes)
    return torch.linalg.inv(information) * scales[..., :, None] * scales[..., None, :]
