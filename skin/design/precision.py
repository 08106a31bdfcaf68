"""The local precision of fingertips on a skin: how well readings tell a touch from its neighbours.

It is no limit for estimators; :mod:`skin.design.expected` computes what the posterior reaches.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from skin.inference.noise import Noise
from skin.mechanics.geometry import PARAMETERS, Fingertip
from skin.mechanics.simulator.base import AbstractSimulator

# Covariance of the parameters given the readings, to first order: (J' R^-1 J + P)^-1, with the slopes J, the
# variances R of the noise and the inverse variances P of the priors (Van Trees, Detection, Estimation, and
# Modulation Theory, 2.4). It is no limit for estimators: a silent sensor has no slope, yet tells that the
# touch is not near it. Above a single sensor the exact posterior is several times narrower.

_AT_ONCE = 64  # touches; their samples then take about 50 MB with all derivatives


@dataclass(frozen=True)
class Sensitivity:
    """Readings of touches, and their derivatives.

    Attributes:
        readings: (B, S), N.
        slopes: (B, S, 4), with respect to the parameters of :data:`skin.mechanics.geometry.PARAMETERS`.
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
        fingertip: the loads of a touch.
        touches: (B, 4).
    """
    simulator.double()
    parts = list(_parts(simulator, fingertip, touches.double()))
    return Sensitivity(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _parts(
    simulator: AbstractSimulator, fingertip: Fingertip, touches: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    for part in touches.split(_AT_ONCE):
        slopes = []
        for axis in range(len(PARAMETERS)):
            along = torch.zeros_like(part)
            along[:, axis] = 1
            # Touches do not influence each other, so one direction serves all of them.
            pair = torch.func.jvp(lambda touch: simulator.press(fingertip(touch)).readings, (part,), (along,))
            slopes.append(pair[1])
        yield pair[0], torch.stack(slopes, dim=-1)


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
