"""How readings of a device differ from those of a simulator."""

from dataclasses import dataclass

import torch
from torch import Tensor

from skin.errors import InputError


@dataclass(frozen=True)
class Noise:
    """How readings differ from those of the model.

    Attributes:
        frame: standard deviation of the noise of a sensor in a frame, N.
        frames: number of frames that are averaged.
        gain: standard deviation of the unknown gain of each sensor, relative; 0: gains are known.
        clip: largest force that a sensor measures, N.
        offset: standard deviation of what the tare leaves of each sensor's offset, N.
        position: standard deviation of each sensor's position along x and along y, m.

    Raises:
        InputError: no noise, or a number that has no meaning.
    """

    frame: float
    frames: int = 1
    gain: float = 0.0
    clip: float = float("inf")
    offset: float = 0.0
    position: float = 0.0

    def __post_init__(self) -> None:
        if not self.frame > 0:
            raise InputError(
                f"noise needs a standard deviation above 0 N in a frame, got frame={self.frame:g}"
            )
        if self.frames < 1 or not self.clip > 0:
            raise InputError(
                f"noise needs frames >= 1 and clip > 0 N, got frames={self.frames} and clip={self.clip:g}"
            )
        if not min(self.gain, self.offset, self.position) >= 0:
            raise InputError(
                "noise needs gain, offset and position of 0 or more, got "
                f"gain={self.gain:g}, offset={self.offset:g} and position={self.position:g}"
            )

    @property
    def floor(self) -> float:
        """Variance of the reading of an unloaded sensor, N^2."""
        return self.frame**2 / self.frames + self.offset**2

    def variance(self, readings: Tensor) -> Tensor:
        """Return the variance (B, S), N^2, of the mean of the frames of readings (B, S), N.

        It is infinite where a sensor clips: its reading does not depend on the touch. Positions are left out.
        """
        variance = self.floor + (self.gain * readings).square()
        return variance.masked_fill(readings >= self.clip, torch.inf)

    def exceeds(self, readings: Tensor, sigmas: float = 3.0) -> Tensor:
        """Return which readings (B, S), N, exceed the noise of one frame, bool."""
        return readings > sigmas * self.frame
