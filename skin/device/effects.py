"""Imperfections of sensors as a list of effects: each draws its constants and changes readings.

The report (2.1.4) clips the force and then adds noise and offset. Hysteresis, a first-order lag, the gain and
the curve of the sensor come before the clip; drift and rounding after the noise.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.device.curves import Curves, Table
from skin.mechanics.relaxation import apply_hysteresis, first_order_lag, quantize

Numbers = Mapping[str, np.ndarray]
"""Numbers by name, (S,), or (B, 1, S) where every gesture has a device of its own."""


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
        hysteresis: mean gap between unloading and loading, as a fraction of the touch's peak.
        time_constant: of a first-order lag, s; 0: none.
        quantum: step of the converter, N; 0: none.
        exponent, exponent_at: of the sensor's curve (:class:`skin.device.curves.Curves`); 1, N: linear.
        rate: frames per second, Hz, one number per device.
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
    exponent: Tensor
    exponent_at: Tensor
    rate: Tensor

    def to(self, device: torch.device | str) -> "Constants":
        """Return these constants on ``device``."""
        return Constants(*(value.to(device) for value in self))


class AbstractEffect(ABC):
    """One imperfection of the sensors.

    Attributes:
        constants: names of the settings that are its constants without a draw.
    """

    constants: tuple[str, ...] = ()

    def draw(self, values: Numbers, random: Numbers) -> Numbers:
        """Return the constants of the effect by name, as in :class:`Constants`.

        Args:
            values: of the settings by name; for a range, the value of the device.
            random: standard random numbers (:meth:`skin.device.imperfection.Imperfection.constants`).
        """
        return {name: values[name] for name in self.constants}

    @abstractmethod
    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings (B, T, S), N, with the effect; those given may be overwritten after the clip.

        Args:
            readings: (B, T, S), N.
            constants: of the device.
            time: of every frame, (T,), s.
            noise: (B, T, S), standard normal; None: it is in the readings already.
        """


class Hysteresis(AbstractEffect):
    """A gap between unloading and loading."""

    constants = ("hysteresis",)

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings with the gap; see :func:`skin.mechanics.relaxation.apply_hysteresis`."""
        gap = constants.hysteresis
        return apply_hysteresis(readings, gap) if gap.any() else readings


class Lag(AbstractEffect):
    """A first-order lag behind the force."""

    def draw(self, values: Numbers, random: Numbers) -> Numbers:
        """Return the time constant; a fraction ``without_lag`` of devices has none."""
        return {"time_constant": values["time_constant"] * (random["lag"] >= values["without_lag"])}

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings that lag."""
        constant = constants.time_constant
        return first_order_lag(readings, constant, time) if constant.any() else readings


class Gain(AbstractEffect):
    """A factor of each sensor, and one that all sensors of a device share."""

    def draw(self, values: Numbers, random: Numbers) -> Numbers:
        """Return the product of both factors."""
        own, common = (np.exp(values[f"{name}_spread"] * random[name]) for name in ("gain", "scale"))
        return {"gain": own * common}

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings times the factor."""
        return readings * constants.gain


@dataclass
class SensorCurve(AbstractEffect):
    """The curve of the sensors: a power law, or a table of some of them.

    Attributes:
        tables: by sensor, from 0.
        table: of all sensors; None: those of ``tables`` alone.
    """

    tables: Mapping[int, Table] = field(default_factory=dict)
    table: Table | None = None

    constants = ("exponent", "exponent_at")

    def curves(self, constants: Constants) -> Curves | None:
        """Return the curves of a device; None: all are linear."""
        tables = self.tables
        if self.table is not None:
            tables = dict.fromkeys(range(constants.dead.shape[-1]), self.table)
        linear = not tables and bool((constants.exponent == 1).all())
        return None if linear else Curves(constants.exponent, constants.exponent_at, tables)

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return the values of the curve."""
        curves = self.curves(constants)
        return readings if curves is None else curves.bend(readings)


class Clip(AbstractEffect):
    """The largest value of the sensors and of their converter."""

    constants = ("clip",)

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return clipped readings, which the further effects may overwrite."""
        return readings.clamp(-constants.clip, constants.clip)


class SensorNoise(AbstractEffect):
    """Noise in every frame, and a constant offset less the baseline of a tare."""

    def draw(self, values: Numbers, random: Numbers) -> Numbers:
        """Return standard deviation and offset."""
        return {"noise": values["noise"], "offset": values["offset"] * random["offset"]}

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings with noise and offset."""
        offset = constants.offset - constants.baseline
        return readings.add_(offset if noise is None else noise.mul_(constants.noise) + offset)


class Drift(AbstractEffect):
    """A drift of each sensor from the first frame of a window or stream."""

    def draw(self, values: Numbers, random: Numbers) -> Numbers:
        """Return the drift per second."""
        return {"drift": values["drift"] * random["drift"]}

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return readings with the drift."""
        return readings.add_(constants.drift * time[:, None]) if constants.drift.any() else readings


class Quantise(AbstractEffect):
    """The steps of the converter, which measures before the device subtracts its baseline."""

    constants = ("quantum",)

    def apply(self, readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
        """Return rounded readings."""
        if not constants.quantum.any():
            return readings
        return quantize(readings + constants.baseline, constants.quantum) - constants.baseline
