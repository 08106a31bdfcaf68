"""How readings of a device differ from those of a simulator."""

import math
from dataclasses import dataclass

import numpy as np

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
        thickness: least and largest thickness that the skin may have, relative to the described one; all its
            layers and the depths of sensors are scaled alike.

    Raises:
        InputError: no noise, a number that has no meaning, or a thickness that is not the described one.
    """

    frame: float
    frames: int = 1
    gain: float = 0.0
    clip: float = float("inf")
    offset: float = 0.0
    position: float = 0.0
    thickness: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        known = all(value >= 0 for value in (self.gain, self.offset, self.position))  # NaN is not
        if not (self.frame > 0 and self.frames >= 1 and self.clip > 0 and known):
            raise InputError(
                "noise needs a standard deviation above 0 N in a frame, frames >= 1, clip > 0 N, and gain, "
                f"offset and position of 0 or more, got frame={self.frame:g}, frames={self.frames}, "
                f"clip={self.clip:g}, gain={self.gain:g}, offset={self.offset:g} and "
                f"position={self.position:g}"
            )
        low, high = self.thickness
        if not 0 < low <= 1 <= high < math.inf:
            raise InputError(
                "a range of thickness is relative to the described one and includes it, as "
                f"thickness=[0.75,1.3] does, got thickness=[{low:g},{high:g}]"
            )

    @property
    def floor(self) -> float:
        """Variance of the reading of an unloaded sensor, N^2."""
        return self.frame**2 / self.frames + self.offset**2

    @property
    def relative(self) -> float:
        """Standard deviation of readings, relative, from gains and thickness.

        Thickness changes readings near and far from a contact differently, by about as much as itself, and
        counts as gains. Of a thickness that may be 15 % off and is by 0 / 10 / 20 %, 90 % regions then hold
        98 / 97 / 85 % of the truth; with the derivatives of the readings, 98 / 97 / 88 %.
        """
        return math.hypot(self.gain, math.log(self.thickness[1] / self.thickness[0]) / math.sqrt(12))

    def exceeds(self, readings: np.ndarray, sigmas: float = 3.0) -> np.ndarray:
        """Return which readings (B, S), N, exceed the noise of one frame, bool."""
        return readings > sigmas * self.frame
