"""Imperfections of a real device: lag, gain, curve, clip, noise, offset, rounding, dead sensors, tare."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from annotated_types import Ge, Gt, Le
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor

from skin.core.settings import RISING, checked
from skin.device.calibration import Calibration, read_calibration
from skin.device.curves import Curves, check_table
from skin.errors import InputError
from skin.mechanics.relaxation import apply_hysteresis, first_order_lag, quantize

# What is fixed in a device: gains, offsets, broken sensors, and the like.


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


_IDLE_FRAMES = 30

_EQUAL = 1e-6
_COMPARED = {
    "rate": ("rate", " Hz"),
    "time_constant": ("lag", " s"),
    "noise": ("noise", " N"),
    "gain_spread": ("spread of the gains", ""),
    "scale_spread": ("spread of the scale", ""),
    "drift": ("drift", " N/s"),
    "hysteresis": ("hysteresis", ""),
}
_SPREADS = ("gain_spread", "noise", "drift", "hysteresis", "time_constant", "exponent", "scale_spread")

Spread = NonNegativeFloat | Annotated[tuple[NonNegativeFloat, NonNegativeFloat], RISING]
"""A number, or a range (least, most) of which each device draws its own."""


@dataclass(kw_only=True)
class ImperfectionSettings:
    """Settings of a device's imperfections (``conf/device/simulated.yaml``).

    A :data:`Spread` is a number or [least, most]. A device draws one share from 0 to 1, uniformly, and takes
    that share of all its ranges: a device that drifts much is noisy, too. If ``independent``, it draws a
    share for each range.

    Attributes:
        gain_spread: standard deviation of the logarithm of each sensor's gain; the report gives none.
        scale_spread: of the logarithm of a factor that all gains of a device share.
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
        exponent: of the sensors' curve: a force F reads as ``exponent_at`` (F / ``exponent_at``) ^ exponent,
            before the clip; about 0.5 for force-sensitive resistors.
        exponent_at: N.
        table: another curve of all sensors: forces and readings, each rising from 0, N; None: the exponent's.
        polarity: -1: the values that the device sends fall with force.
        rate: frames per second, Hz, or [least, most], of which each device draws one on a logarithmic scale.
        independent: each range above has a share of its own.
        aligned: touches begin and end at the edges of the model's intervals; False: anywhere in them, as on
            a real skin.
        without_lag: share of devices without lag, whatever ``time_constant`` says.
        framed: share of devices that read the frames of the model whatever ``rate`` and ``aligned`` say.
    """

    gain_spread: Spread = 0.05
    scale_spread: Spread = 0.0
    offset: Annotated[float, Ge(0)] = 0.1
    noise: Spread = 0.05
    clip: Annotated[float, Gt(0)] = 10.0
    dead: NonNegativeInt | Annotated[tuple[NonNegativeInt, NonNegativeInt], RISING] = 0
    tare: bool = False
    stuck: Annotated[int, Ge(0)] = 0
    saturated: Annotated[int, Ge(0)] = 0
    drift: Spread = 0.0
    hysteresis: Spread = 0.0
    time_constant: Spread = 0.0
    quantum: Annotated[float, Ge(0)] = 0.0
    exponent: Annotated[float, Gt(0)] | Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = 1.0
    exponent_at: Annotated[float, Gt(0)] = 2.0
    table: list[list[float]] | None = None
    polarity: Literal[1, -1] = 1
    rate: PositiveFloat | Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = 10.0
    independent: bool = False
    aligned: bool = True
    without_lag: Annotated[float, Ge(0), Le(1)] = 0.0
    framed: Annotated[float, Ge(0), Le(1)] = 0.0

    @property
    def slowest(self) -> float:
        """Least rate of a device, Hz."""
        return float(self.rate if isinstance(self.rate, int | float) else self.rate[0])


@checked("device")
@dataclass(kw_only=True)
class Imperfection(ImperfectionSettings):
    """A device's imperfections, in the report's order (2.1.4): clip the force, then add noise and offset.

    Hysteresis, a first-order lag, the gain and the curve of the sensor are applied before the clip; drift and
    rounding after the noise. These are additions to the report and are off by default.

    Attributes:
        calibration: of a real device; replaces all settings but ``rate``, ``tare`` and ``dead``, which breaks
            further sensors. Constants drawn for ``gestures`` come from its ranges.

    Raises:
        InputError: a setting of the wrong type or out of its range.
    """

    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        if self.table is not None:
            check_table(self.table)

    def signs(self, sensors: int) -> np.ndarray:
        """Return 1 or -1 per sensor, (S,): -1 where the values that the device sends fall with force."""
        return np.full(sensors, float(self.polarity)) if self.calibration is None else self.calibration.signs

    def _curves(self, constants: Constants, sensors: int) -> Curves | None:
        """Return the curves of the sensors; None: all are linear."""
        if self.calibration is not None:
            tables = self.calibration.tables
        else:
            tables = {} if self.table is None else dict.fromkeys(range(sensors), self.table)
        if not tables and (constants.exponent == 1).all():
            return None
        return Curves(constants.exponent, constants.exponent_at, tables)

    @property
    def dead_range(self) -> tuple[int, int]:
        """Least and most sensors that are dead in a device."""
        return (self.dead, self.dead) if isinstance(self.dead, int) else (self.dead[0], self.dead[1])

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
            values = self._draw_constants(shape, generator)
        else:
            values = self._draw_calibrated(self.calibration, shape, generator)
        if values["dead"].all(axis=-1).any():
            raise InputError(
                f"device.dead={self.dead} of {sensors} sensors leaves none alive (those that are stuck, "
                "saturated or broken in a calibration count too): give fewer"
            )
        idle = values["offset"] + values["noise"] / np.sqrt(_IDLE_FRAMES) * values.pop("idle")
        values["baseline"] = idle if self.tare else np.zeros(shape)
        least, most = np.log(np.broadcast_to(self.rate, 2))
        values["rate"] = (
            np.asarray(self.slowest)
            if least == most
            else np.exp(generator.uniform(least, most, (*shape[:-1], 1)))
        )
        tensors = {name: torch.from_numpy(value).float() for name, value in values.items()}
        rate = torch.from_numpy(values["rate"])
        return Constants(**tensors | {"dead": tensors["dead"].bool(), "rate": rate})

    def _draw_constants(
        self, shape: tuple[int, ...], generator: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Draw from spreads. What is neutral draws nothing, so that other constants stay what they were."""
        ranges = {name: getattr(self, name) for name in _SPREADS}
        some = any(isinstance(bounds, list | tuple) for bounds in ranges.values())
        shares = dict.fromkeys(ranges, generator.random((*shape[:-1], 1)) if some else np.zeros(()))
        if self.independent:
            shares = {name: generator.random((*shape[:-1], 1)) for name in ranges}
        spread = {name: _part(bounds, shares[name]) for name, bounds in ranges.items()}
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
        if np.any(spread["scale_spread"]):
            gain = gain * np.exp(spread["scale_spread"] * generator.standard_normal((*shape[:-1], 1)))
        if self.without_lag:
            lags = generator.random((*shape[:-1], 1)) >= self.without_lag
            spread["time_constant"] = spread["time_constant"] * lags
        values = {name: np.asarray(float(getattr(self, name))) for name in ("clip", "quantum", "exponent_at")}
        values |= {name: spread[name] for name in ("noise", "hysteresis", "time_constant", "exponent")}
        dead = rank < count + self.stuck + self.saturated
        return values | {
            "gain": gain, "offset": offset, "dead": dead, "level": level, "drift": drift, "idle": idle
        }  # fmt: skip

    def _draw_calibrated(
        self, calibration: Calibration, shape: tuple[int, ...], generator: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Take the values of a calibration, or, a device per gesture, draw from its ranges."""
        calibration.fits(shape[-1])
        values = calibration.values() if len(shape) == 1 else calibration.draw(shape, generator)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        also_dead = rank < generator.integers(*self.dead_range, (*shape[:-1], 1), endpoint=True)
        values["level"] = np.where(also_dead, 0.0, values["level"])
        values["dead"] = values["dead"] | also_dead
        values["exponent_at"] = np.asarray(calibration.exponent_at)
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
        return self.undo_curve(output, constants).masked_fill(dead, 0.0), ~dead, saturated & ~dead

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

    def undo_curve(self, readings: Tensor, constants: Constants) -> Tensor:
        """Return readings (B, T, S), N, without the curves of a calibration, as a live view gives them."""
        curves = None if self.calibration is None else self._curves(constants, readings.shape[-1])
        return readings if curves is None else curves.straighten(readings)

    def is_static(self, constants: Constants, sensors: int) -> bool:
        """Return whether the sensors follow the force at once and in proportion to it."""
        in_time = constants.hysteresis.any() or constants.time_constant.any()
        return not in_time and self._curves(constants, sensors) is None

    def sense(self, force: Tensor, constants: Constants, time: Tensor) -> Tensor:
        """Return what the sensors respond before the converter, (B, T, S), N: hysteresis, lag, gain, curve.

        Args:
            force: (B, T, S), true readings, N.
            constants: of this device.
            time: of every frame, (T,), s.
        """
        if constants.hysteresis.any():
            force = apply_hysteresis(force, constants.hysteresis)
        if constants.time_constant.any():
            force = first_order_lag(force, constants.time_constant, time)
        scaled = force * constants.gain
        curves = self._curves(constants, force.shape[-1])
        return scaled if curves is None else curves.bend(scaled)

    def _measure(
        self,
        readings: Tensor,
        constants: Constants,
        generator: np.random.Generator,
        time: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        noise = torch.from_numpy(generator.standard_normal(readings.shape, dtype=np.float32))
        if time is None:
            time = torch.arange(readings.shape[1], device=readings.device) / self.slowest
        scaled = self.sense(readings, constants, time)
        output, saturated = scaled.clamp(-constants.clip, constants.clip), scaled.abs() > constants.clip
        output += noise.to(readings.device).mul_(constants.noise) + (constants.offset - constants.baseline)
        if constants.drift.any():
            output += constants.drift * time[:, None]
        if constants.quantum.any():
            output = quantize(output + constants.baseline, constants.quantum) - constants.baseline
        return output, saturated


def outside(settings: Mapping[str, Any], ranges: Mapping[str, Any]) -> list[str]:
    """Return what of a device lies outside the ranges of others, as "lag 0.2 s (0 to 0.12 s)".

    Args:
        settings: of the device (:class:`ImperfectionSettings`); what it does not name is not compared.
        ranges: the same of devices that were drawn.
    """
    texts = list[str]()
    for name, (text, unit) in _COMPARED.items():
        if settings.get(name) is None or ranges.get(name) is None:
            continue
        (least, most), (low, high) = (np.broadcast_to(values[name], 2) for values in (settings, ranges))
        # A device with less noise, drift or lag is easier; a slower one is not.
        if most > high * (1 + _EQUAL) or (name == "rate" and least < low * (1 - _EQUAL)):
            value = f"{least:g}" if least == most else f"{least:g} to {most:g}"
            texts.append(f"{text} {value}{unit} ({low:g} to {high:g}{unit})")
    return texts


def _part(spread: Spread, share: np.ndarray) -> np.ndarray:
    """Return that share, 0 to 1, of a range; a number has none."""
    least, most = spread if isinstance(spread, list | tuple) else (spread, spread)
    return np.asarray(least + (most - least) * share)


def _settings(settings: ImperfectionSettings) -> dict[str, Any]:
    return {entry.name: getattr(settings, entry.name) for entry in fields(ImperfectionSettings)}
