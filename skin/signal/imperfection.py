"""Imperfections of a real device: lag, gain, clip, noise, offset, rounding, dead sensors, tare."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Gt
from pydantic import NonNegativeFloat
from torch import Tensor

from skin.errors import InputError
from skin.sensor_dynamics import apply_hysteresis, first_order_lag, quantize
from skin.settings import RISING, check_settings
from skin.signal.calibration import Calibration, read_calibration
from skin.signal.constants import Constants

_IDLE_FRAMES = 30

_SPREADS = ("gain_spread", "noise", "drift", "hysteresis", "time_constant")

Spread = NonNegativeFloat | Annotated[tuple[NonNegativeFloat, NonNegativeFloat], RISING]
"""A number, or a range (least, most) of which each device draws its own."""


@dataclass(kw_only=True)
class ImperfectionSettings:
    """Settings of a device's imperfections (``conf/device/simulated.yaml``).

    A :data:`Spread` is a number or [least, most]. A device draws one share from 0 to 1, uniformly, and takes
    that share of all its ranges: a device that drifts much is noisy, too.

    Attributes:
        gain_spread: standard deviation of the logarithm of each sensor's gain; the report gives none.
        offset: standard deviation of each sensor's offset, N, constant in a device.
        noise: standard deviation of the noise in every frame, N.
        clip: largest force that a sensor measures, N.
        dead: how many sensors are dead, or [least, most], of which each device draws its number: they read 0
            and are marked invalid.
        tare: subtract the idle baseline, the mean of 30 idle frames with their noise.
        stuck: number of further sensors with a constant reading between 0 and ``clip``; they are invalid.
        saturated: number of further sensors with the constant reading ``clip``; they are invalid.
        drift: standard deviation of each sensor's drift, N/s, from the first frame of a window or stream.
        hysteresis: mean gap between unloading and loading, share of the peak. At a force x after a peak P the
            sensor measures x + 6 hysteresis x (P - x) / P: no gap at rest and none at the peak.
        time_constant: of a first-order lag behind the force, s.
        quantum: step of the converter, N.
        rate: frames per second, Hz.
    """

    gain_spread: Spread = 0.05
    offset: Annotated[float, Ge(0)] = 0.1
    noise: Spread = 0.05
    clip: Annotated[float, Gt(0)] = 10.0
    dead: int | Sequence[int] = 0
    tare: bool = False
    stuck: Annotated[int, Ge(0)] = 0
    saturated: Annotated[int, Ge(0)] = 0
    drift: Spread = 0.0
    hysteresis: Spread = 0.0
    time_constant: Spread = 0.0
    quantum: Annotated[float, Ge(0)] = 0.0
    rate: Annotated[float, Gt(0)] = 10.0


@dataclass(kw_only=True)
class Imperfection(ImperfectionSettings):
    """A device's imperfections, in the report's order (2.1.4): clip the force, then add noise and offset.

    Hysteresis, a first-order lag and the gain of the sensor are applied before the clip; drift and rounding
    after the noise. These are additions to the report and are off by default.

    Attributes:
        calibration: of a real device; replaces all settings but ``rate``, ``tare`` and ``dead``, which breaks
            further sensors. Constants drawn for ``gestures`` come from its ranges.

    Raises:
        InputError: a setting of the wrong type or out of its range.
    """

    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        least, most = self.dead_range
        if not 0 <= least <= most:
            raise InputError(
                f"device.dead must be a number from 0 up or a range [least, most], got {self.dead}: as in "
                "device.dead=3 or device.dead=[0,5]"
            )
        check_settings(ImperfectionSettings, _settings(self), "device")

    @property
    def dead_range(self) -> tuple[int, int]:
        """Least and most sensors that are dead in a device; (0, -1) where that is no range."""
        ends = self.dead if isinstance(self.dead, (list, tuple)) else (self.dead, self.dead)
        whole = len(ends) == 2 and all(isinstance(number, int) for number in ends)
        return (ends[0], ends[1]) if whole else (0, -1)

    @classmethod
    def of(cls, settings: ImperfectionSettings, calibration: str | None) -> "Imperfection":
        """Return imperfections of these settings, and of a file of ``skin calibrate`` where one is given."""
        return cls(
            **_settings(settings), calibration=None if calibration is None else read_calibration(calibration)
        )

    def constants(
        self, sensors: int, generator: np.random.Generator, gestures: int | None = None
    ) -> Constants:
        """Draw the constants of one device, or of one device per gesture.

        Raises:
            InputError: more broken sensors than would leave one alive, or a calibration of another number.
        """
        shape = (sensors,) if gestures is None else (gestures, 1, sensors)
        if self.calibration is None:
            values = self._drawn(shape, generator)
        else:
            values = self._calibrated(self.calibration, shape, generator)
        if values["dead"].all(axis=-1).any():
            raise InputError(
                f"device.dead={self.dead} of {sensors} sensors leaves none alive (those that are stuck, "
                "saturated or broken in a calibration count too): give fewer"
            )
        idle = values["offset"] + values["noise"] / np.sqrt(_IDLE_FRAMES) * values.pop("idle")
        values["baseline"] = idle if self.tare else np.zeros(shape)
        tensors = {name: torch.from_numpy(value).float() for name, value in values.items()}
        return Constants(**tensors | {"dead": tensors["dead"].bool()})

    def _drawn(self, shape: tuple[int, ...], generator: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw from spreads. What is neutral draws nothing, so that other constants stay what they were."""
        ranges = {name: getattr(self, name) for name in _SPREADS}
        some = any(isinstance(bounds, list | tuple) for bounds in ranges.values())
        share = generator.random((*shape[:-1], 1)) if some else np.zeros(())
        spread = {name: _part(bounds, share) for name, bounds in ranges.items()}
        gain = np.exp(spread["gain_spread"] * generator.standard_normal(shape))
        offset = self.offset * generator.standard_normal(shape)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        idle = generator.standard_normal(shape)
        drifts = np.any(spread["drift"])
        drift = spread["drift"] * generator.standard_normal(shape) if drifts else np.zeros(shape)
        count = generator.integers(*self.dead_range, (*shape[:-1], 1), endpoint=True)
        level = np.where(rank < count, 0.0, self.clip)
        if self.stuck:
            stuck = (rank >= count) & (rank < count + self.stuck)
            level = np.where(stuck, generator.uniform(0, self.clip, shape), level)
        values = {name: np.asarray(float(getattr(self, name))) for name in ("clip", "quantum")}
        values |= {name: spread[name] for name in ("noise", "hysteresis", "time_constant")}
        dead = rank < count + self.stuck + self.saturated
        return values | {
            "gain": gain, "offset": offset, "dead": dead, "level": level, "drift": drift, "idle": idle
        }  # fmt: skip

    def _calibrated(
        self, calibration: Calibration, shape: tuple[int, ...], generator: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Take the values of a calibration, or, a device per gesture, draw from its ranges."""
        calibration.fits(shape[-1])
        values = calibration.values() if len(shape) == 1 else calibration.draw(shape, generator)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        also_dead = rank < generator.integers(*self.dead_range, (*shape[:-1], 1), endpoint=True)
        values["level"] = np.where(also_dead, 0.0, values["level"])
        values["dead"] = values["dead"] | also_dead
        return values | {"idle": generator.standard_normal(shape)}

    def apply(
        self,
        readings: Tensor,
        constants: Constants,
        generator: np.random.Generator,
        time: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the readings of the device, with masks of valid and of saturated ones.

        Args:
            readings: (B, T, S), true readings, N.
            constants: of this device.
            generator: source of the noise.
            time: of every frame, (T,), s, at which the drift has come; None: at ``rate`` from 0.

        Returns:
            readings (B, T, S), N, float32, valid and saturated (B, T, S), bool.
        """
        constants = constants.to(readings.device)
        dead = constants.dead.expand(readings.shape)
        output, saturated = self._measure(readings, constants, generator, time)
        return output.masked_fill(dead, 0.0), ~dead, saturated & ~dead

    def raw(
        self,
        readings: Tensor,
        constants: Constants,
        generator: np.random.Generator,
        time: Tensor | None = None,
    ) -> Tensor:
        """Return the output of the converter, (B, T, S), N: without a tare, broken sensors at their level.

        Args:
            readings: (B, T, S), true readings, N.
            constants: of this device.
            generator: source of the noise.
            time: of every frame, (T,), s; None: at ``rate`` from 0.
        """
        constants = constants._replace(baseline=torch.zeros(())).to(readings.device)
        output, _ = self._measure(readings, constants, generator, time)
        return torch.where(constants.dead, constants.level, output)

    def _measure(
        self,
        readings: Tensor,
        constants: Constants,
        generator: np.random.Generator,
        time: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        noise = torch.from_numpy(generator.standard_normal(readings.shape, dtype=np.float32))
        if time is None:
            time = torch.arange(readings.shape[1], device=readings.device) / self.rate
        force = readings
        if constants.hysteresis.any():
            force = apply_hysteresis(force, constants.hysteresis)
        if constants.time_constant.any():
            force = first_order_lag(force, constants.time_constant, time)
        scaled = force * constants.gain
        output, saturated = scaled.clamp(-constants.clip, constants.clip), scaled.abs() > constants.clip
        output += noise.to(readings.device).mul_(constants.noise) + (constants.offset - constants.baseline)
        if constants.drift.any():
            output += constants.drift * time[:, None]
        if constants.quantum.any():
            output = quantize(output + constants.baseline, constants.quantum) - constants.baseline
        return output, saturated


def _part(spread: Spread, share: np.ndarray) -> np.ndarray:
    """Return that share, 0 to 1, of a range; a number has none."""
    least, most = spread if isinstance(spread, list | tuple) else (spread, spread)
    return np.asarray(least + (most - least) * share)


def _settings(settings: ImperfectionSettings) -> dict[str, Any]:
    return {entry.name: getattr(settings, entry.name) for entry in fields(ImperfectionSettings)}
