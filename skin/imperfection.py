"""What a real device does to true readings: gain, clip, noise, offset, dead sensors, tare."""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.errors import InputError

__all__ = ["Constants", "Imperfection"]

_IDLE_FRAMES = 30


class Constants(NamedTuple):
    """What is fixed in a device; (S,), or (B, 1, S) where every gesture has a device of its own.

    Attributes:
        gain: factor on the true force.
        offset: N.
        baseline: what the device subtracts as its idle reading, N; 0 without tare.
        dead: bool, sensors that say nothing.
    """

    gain: Tensor
    offset: Tensor
    baseline: Tensor
    dead: Tensor


@dataclass(frozen=True)
class Imperfection:
    """A device's imperfections, in the report's order (2.1.4): clip the force, then add noise and offset.

    Attributes:
        gain_spread: standard deviation of the logarithm of each sensor's gain. Our choice: the report speaks
            of absorption but gives no spread.
        offset: standard deviation of each sensor's offset, N, constant in a device.
        noise: standard deviation of the noise in every frame, N.
        clip: largest force that a sensor tells, N.
        dead: how many sensors are dead: they read 0 and are marked invalid.
        tare: subtract the idle baseline, the mean of 30 idle frames with their noise.

    Raises:
        InputError: a negative number, or a clip that is not above 0.
    """

    gain_spread: float = 0.05
    offset: float = 0.1
    noise: float = 0.05
    clip: float = 10.0
    dead: int = 0
    tare: bool = False

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value >= 0:
                raise InputError(f"device.{entry.name} must be at least 0, got {value}")
        if self.clip == 0:
            raise InputError("device.clip must be above 0 N, got 0: as in device.clip=10")

    def constants(
        self, sensors: int, generator: np.random.Generator, gestures: int | None = None
    ) -> Constants:
        """Draw the constants of one device, or of one device per gesture.

        Raises:
            InputError: more dead sensors than would leave one alive.
        """
        if self.dead >= sensors:
            raise InputError(f"device.dead={self.dead} of {sensors} sensors leaves none alive: give fewer")
        shape = (sensors,) if gestures is None else (gestures, 1, sensors)
        gain = np.exp(self.gain_spread * generator.standard_normal(shape))
        offset = self.offset * generator.standard_normal(shape)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        idle = offset + self.noise / np.sqrt(_IDLE_FRAMES) * generator.standard_normal(shape)
        baseline = idle if self.tare else np.zeros(shape)
        return Constants(
            gain=torch.from_numpy(gain).float(),
            offset=torch.from_numpy(offset).float(),
            baseline=torch.from_numpy(baseline).float(),
            dead=torch.from_numpy(rank < self.dead),
        )

    def apply(
        self, readings: Tensor, constants: Constants, generator: np.random.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return what the device says and which of it is valid.

        Args:
            readings: (B, T, S), true readings, N.
            constants: of this device.
            generator: where the noise comes from.

        Returns:
            readings (B, T, S), N, float32, and valid (B, T, S), bool.
        """
        noise = torch.from_numpy(generator.standard_normal(readings.shape, dtype=np.float32))
        constants = Constants(*(value.to(readings.device) for value in constants))
        said = (readings * constants.gain).clamp(-self.clip, self.clip)
        said += noise.to(readings.device).mul_(self.noise) + (constants.offset - constants.baseline)
        dead = constants.dead.expand(readings.shape)
        return said.masked_fill(dead, 0.0), ~dead

    def clipped(self, readings: Tensor, constants: Constants) -> Tensor:
        """Return which gestures have a reading that is clipped, (B,), bool."""
        force = (readings * constants.gain.to(readings.device)).abs() > self.clip
        return (force & ~constants.dead.to(readings.device)).flatten(1).any(1)
