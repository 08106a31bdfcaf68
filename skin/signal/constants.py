"""What is fixed in a device: gains, offsets, broken sensors, and the like."""

from typing import NamedTuple

import torch
from torch import Tensor


class Constants(NamedTuple):
    """What is fixed in a device; (S,), or (B, 1, S) where every gesture has a device of its own.

    Attributes:
        gain: factor on the true force.
        offset: N.
        baseline: what the device subtracts as its idle reading, N; 0 without tare.
        dead: bool, sensors whose readings mean nothing: dead, stuck or saturated.
        noise: standard deviation in every frame, N.
        clip: largest force that a sensor measures, N.
        level: constant reading of the sensors in ``dead``, N.
        drift: N/s.
        hysteresis: mean gap between unloading and loading, share of the touch's peak.
        time_constant: of a first-order lag, s; 0: none.
        quantum: step of the converter, N; 0: none.
    """

    gain: Tensor
    offset: Tensor
    baseline: Tensor
    dead: Tensor
    noise: Tensor
    clip: Tensor
    level: Tensor
    drift: Tensor
    hysteresis: Tensor
    time_constant: Tensor
    quantum: Tensor

    def to(self, device: torch.device | str) -> "Constants":
        """Return these constants on ``device``."""
        return Constants(*(value.to(device) for value in self))
