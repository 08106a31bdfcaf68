"""Skins that relax: elastic answers at several speeds, joined by first-order lags."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from skin.body.base import AbstractBody
from skin.sensor_dynamics import first_order_lag
from skin.sensors import Sensors
from skin.simulator.base import AbstractSimulator, Response

_APART = 1.2


def relaxes(body: AbstractBody) -> bool:
    """Return whether some material of a body relaxes."""
    return any(layer.material.relaxation for layer in body.layers)


def elastic(body: AbstractBody, speed: float) -> AbstractBody:
    """Return the elastic body that answers a load like exp(``speed`` t), 1/s, as the relaxing one does."""
    return replace(
        body, layers=tuple(replace(layer, material=layer.material.elastic(speed)) for layer in body.layers)
    )


def times(body: AbstractBody) -> list[float]:
    """Return the times of the lags, s, ascending: both ends of each material's range, where they differ.

    All times of the exact answer lie between tau and tau (1 + g) of some material: a layer whose strain is
    held relaxes with the first, one whose stress is held creeps with the second. Ends of a range, or of two
    ranges, that are closer than a factor of 1.2 count as one; those of creep have precedence.
    """
    branches = [one for layer in body.layers if (one := layer.material.relaxation) is not None]
    creep = [one.time * (1 + one.strength) for one in branches]
    kept: list[float] = []
    for time in [*creep, *(one.time for one in branches)]:
        if all(max(time / other, other / time) >= _APART for other in kept):
            kept.append(time)
    return sorted(kept)


def speeds(lags: Sequence[float]) -> list[float]:
    """Return where the fit is exact, 1/s, one speed per lag: 0, and between each lag and the next."""
    return [0.0, *(1 / math.sqrt(one * other) for one, other in pairwise(lags))]


class Relaxing(AbstractSimulator):
    """Answers movies of pressure as a body does whose materials relax: E(t) = E (1 + g exp(-t / tau)).

    By the correspondence principle the answer to exp(s t) is that of the elastic body with the moduli E (1 +
    g s tau / (1 + s tau)). As a function of s it is met by R_inf + sum_j D_j / (1 + s theta_j), whose terms
    are lags in time: exact for ever slow and ever fast loads, and at as many speeds between as there are
    lags left (Schapery's collocation). What a nonlinear reading is made of (equation 10: D_s, D_t and F_in)
    goes through the lags, and the reading is made of what comes out: the skin's motion of the moment.

    Between frames a load is held as it is at the later one.

    Args:
        simulator: ``simulator(body, sensors)`` of an elastic body.
        body: with a material that relaxes.
        sensors: where the sensors are.
        rate: frames per second, Hz.

    Raises:
        InputError: a simulator without mechanics.

    Attributes:
        lags: theta_j, s.
    """

    shares: Tensor

    def __init__(
        self,
        simulator: Callable[[AbstractBody, Sensors], AbstractSimulator],
        body: AbstractBody,
        sensors: Sensors,
        rate: float,
    ) -> None:
        super().__init__()
        self.lags, self.rate = times(body), float(rate)
        at = speeds(self.lags)
        self.models = nn.ModuleList(simulator(elastic(body, speed), sensors) for speed in [*at, math.inf])
        self._relaxed.linear(torch.zeros(body.shape))  # refused at the door rather than in the first batch
        terms = 1 / (1 + np.outer(at, self.lags))
        self.register_buffer("shares", torch.from_numpy(np.linalg.inv(terms)))

    @property
    def feels_shear(self) -> bool:  # type: ignore[override]
        """As the elastic body's."""
        return self._relaxed.feels_shear

    @property
    def _relaxed(self) -> AbstractSimulator:
        return self.models[0]  # type: ignore[return-value]

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa, that has always been there."""
        return self._relaxed(pressure, shear)

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return how far sensors move under pressure that has always been there, (..., S, 3), m."""
        return self._relaxed.motion(pressure, shear)

    def compliance(self) -> Tensor:
        """Return the compliance for pressure that has always been there, (H*W, H*W), m/Pa."""
        return self._relaxed.compliance()

    def strain(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor | None:
        """Return the largest strain under pressure that has always been there, (U,): no load has a larger."""
        return self._relaxed.strain(pressure, shear)

    def play(
        self,
        frames: Tensor,
        index: Tensor,
        scale: Tensor,
        shear: Tensor | None = None,
        displacement: bool = True,
    ) -> Response:
        """Return the response to movies that begin at rest."""
        parts = [model.linear(frames, shear)[index] * scale[..., None] for model in self.models]  # type: ignore[operator]
        time = torch.arange(index.shape[1], device=scale.device) / self.rate
        felt = parts[-1]
        # A difference of operators that are alike; in float32 the lags' shares would magnify its rounding.
        slow = torch.stack(parts[:-1]).double() - felt.double()
        for lag, share in zip(self.lags, self.shares, strict=True):
            term = torch.einsum("i,i...->...", share, slow)
            constant = torch.full_like(term[:, 0], lag)
            felt = felt + first_order_lag(term, constant, time).to(felt)
        response = self._relaxed.read(felt)
        return response if displacement else Response(response.readings, None)
