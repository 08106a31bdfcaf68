"""Imperfections of a device: their settings, the constants of a device, and what it makes of true readings.

The report (2.1.4) clips the force and then adds noise and offset. Hysteresis, a first-order lag, the gain and
the curve of the sensor come before the clip; drift and rounding after the noise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from annotated_types import Ge, Gt, Le
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor

from skin.core.settings import RISING, checked
from skin.device.calibration import Calibration, Curves, Table, read_calibration
from skin.errors import InputError
from skin.mechanics.relaxation import apply_hysteresis, first_order_lag, quantize


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
        exponent, exponent_at: of the sensor's curve (:class:`skin.device.calibration.Curves`); 1, N: linear.
        rate: frames per second, Hz, one number per device.
        cross_talk: fractions of the forces along other axes that an axis of a site reads, (S / 3, 3, 3), or
            (B, 1, S / 3, 3, 3); 0: none, or sites with one axis.
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
    cross_talk: Tensor = torch.zeros(())

    def to(self, device: torch.device | str) -> "Constants":
        """Return these constants on ``device``."""
        return Constants(*(value.to(device) for value in self))


def convert(readings: Tensor, constants: Constants, time: Tensor, noise: Tensor | None) -> Tensor:
    """Return clipped readings (B, T, S), N, which are overwritten, behind the converter of a device.

    It adds noise, a constant offset less the baseline of a tare, and a drift from the first frame of a window
    or stream, and rounds: it measures before the device subtracts its baseline.

    Args:
        readings: (B, T, S), N.
        constants: of the device.
        time: of every frame, (T,), s.
        noise: (B, T, S), standard normal; None: it is in the readings already.
    """
    offset = constants.offset - constants.baseline
    readings = readings.add_(offset if noise is None else noise.mul_(constants.noise) + offset)
    if constants.drift.any():
        readings = readings.add_(constants.drift * time[:, None])
    if constants.quantum.any():
        readings = quantize(readings + constants.baseline, constants.quantum) - constants.baseline
    return readings


# Settings of all imperfections, and a device that has them.


_COMPARED = {
    "rate": ("rate", " Hz"),
    "time_constant": ("lag", " s"),
    "noise": ("noise", " N"),
    "gain_spread": ("spread of the gains", ""),
    "scale_spread": ("spread of the scale", ""),
    "drift": ("drift", " N/s"),
    "hysteresis": ("hysteresis", ""),
}
_AS_SET = ("hysteresis", "exponent", "exponent_at", "clip", "noise", "quantum")
"""Settings that are constants of a device without a draw."""
_SPREADS = ("gain_spread", "noise", "drift", "hysteresis", "time_constant", "exponent", "scale_spread")

Spread = NonNegativeFloat | Annotated[tuple[NonNegativeFloat, NonNegativeFloat], RISING]
"""A number, or a range (least, most) in which each device draws its own."""


@dataclass(kw_only=True)
class ImperfectionSettings:
    """Settings of a device's imperfections (``conf/device/simulated.yaml``).

    A :data:`Spread` is a number or [least, most]. A device draws one fraction from 0 to 1, uniformly, and
    takes that fraction of all its ranges: a device that drifts much is noisy, too. If ``independent``, it
    draws a fraction for each range.

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
        hysteresis: mean gap between unloading and loading, fraction of the peak. At a force x after a peak P
            the sensor measures x + 6 hysteresis x (P - x) / P: no gap at rest and none at the peak.
        time_constant: of a first-order lag behind the force, s.
        quantum: step of the converter, N.
        exponent: of the sensors' curve: a force F reads as ``exponent_at`` (F / ``exponent_at``) ^ exponent,
            before the clip; about 0.5 for force-sensitive resistors.
        exponent_at: N.
        table: another curve of all sensors: forces and readings, each rising from 0, N; None: the exponent's.
        polarity: -1: the values that the device sends fall with force.
        rate: frames per second, Hz, or [least, most], of which each device draws one on a logarithmic scale.
        independent: each range above has a fraction of its own.
        aligned: touches begin and end at the edges of the model's intervals; False: anywhere in them, as on
            a real skin.
        without_lag: fraction of devices without lag, whatever ``time_constant`` says.
        framed: fraction of devices that read the frames of the model whatever ``rate`` and ``aligned`` say.
        cross_talk: standard deviation of the fraction that an axis of a site reads of the force along each
            other one; sites with one axis have none.
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
    table: Table | None = None
    polarity: Literal[1, -1] = 1
    rate: PositiveFloat | Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = 10.0
    independent: bool = False
    aligned: bool = True
    without_lag: Annotated[float, Ge(0), Le(1)] = 0.0
    framed: Annotated[float, Ge(0), Le(1)] = 0.0
    cross_talk: Annotated[float, Ge(0), Le(0.5)] = 0.02

    @property
    def slowest(self) -> float:
        """Least rate of a device, Hz."""
        return float(self.rate if isinstance(self.rate, int | float) else self.rate[0])


@checked("device")
@dataclass(kw_only=True)
class Imperfection(ImperfectionSettings):
    """A device's imperfections: of sensors and converter, broken sensors and a tare.

    The report has gain, clip, noise and offset; the others are additions and off by default.

    Attributes:
        calibration: of a real device; replaces all settings but ``rate``, ``tare`` and ``dead``, which breaks
            further sensors. Constants drawn for ``gestures`` come from its ranges.
        cross_talk: above 0 only of sites with three axes.

    Raises:
        InputError: a setting of the wrong type or out of its range.
    """

    calibration: Calibration | None = None
    cross_talk: Annotated[float, Ge(0), Le(0.5)] = 0.0

    def signs(self, sensors: int) -> np.ndarray:
        """Return 1 or -1 per sensor, (S,): -1 where the values that the device sends fall with force."""
        return np.full(sensors, float(self.polarity)) if self.calibration is None else self.calibration.signs

    def curves(self, constants: Constants) -> Curves | None:
        """Return the curves of a device's sensors; None: all are linear."""
        tables = {} if self.calibration is None else self.calibration.tables
        if self.calibration is None and self.table is not None:
            tables = dict.fromkeys(range(constants.dead.shape[-1]), self.table)
        linear = not tables and bool((constants.exponent == 1).all())
        return None if linear else Curves(constants.exponent, constants.exponent_at, tables)

    @property
    def dead_range(self) -> tuple[int, int]:
        """Least and most sensors that are dead in a device."""
        return (self.dead, self.dead) if isinstance(self.dead, int) else (self.dead[0], self.dead[1])

    @classmethod
    def of(cls, settings: ImperfectionSettings, calibration: str | None, axes: int = 1) -> "Imperfection":
        """Return imperfections of these settings, and of a file of ``skin calibrate`` where one is given.

        Sites with one of the ``axes`` have no cross-talk.
        """
        own = {entry.name: getattr(settings, entry.name) for entry in fields(ImperfectionSettings)}
        own["cross_talk"] *= axes > 1
        return cls(**own, calibration=None if calibration is None else read_calibration(calibration))

    def constants(
        self,
        sensors: int,
        generator: np.random.Generator,
        gestures: int | None = None,
        idle_frames: int = 30,
    ) -> Constants:
        """Draw the constants of one device, or of one device per gesture.

        Args:
            sensors: S.
            generator: of random numbers.
            gestures: B; None: one device.
            idle_frames: whose mean a tare subtracts, with their noise.

        Raises:
            InputError: more broken sensors than would leave one alive, or a calibration of another number.
        """
        shape = (sensors,) if gestures is None else (gestures, 1, sensors)
        values = self._draw(shape, generator) if self.calibration is None else self._take(shape, generator)
        if values["dead"].all(axis=-1).any():
            raise InputError(
                f"device.dead={self.dead} of {sensors} sensors leaves none alive (those that are stuck, "
                "saturated or broken in a calibration count too): give fewer"
            )
        idle = values["offset"] + values["noise"] / np.sqrt(idle_frames) * values.pop("idle")
        values["baseline"] = idle if self.tare else np.zeros(shape)
        minimum, maximum = np.log(np.broadcast_to(self.rate, 2))
        values["rate"] = (
            np.asarray(self.slowest)
            if minimum == maximum
            else np.exp(generator.uniform(minimum, maximum, (*shape[:-1], 1)))
        )
        if self.cross_talk:
            drawn = generator.standard_normal((*shape[:-1], sensors // 3, 3, 3))
            values["cross_talk"] = self.cross_talk * drawn * (1 - np.eye(3))
        tensors = {name: torch.from_numpy(np.asarray(value)).float() for name, value in values.items()}
        rate = torch.from_numpy(values["rate"])
        return Constants(**tensors | {"dead": tensors["dead"].bool(), "rate": rate})

    def _draw(self, shape: tuple[int, ...], generator: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw random numbers in a fixed order, and from them the constants of a device.

        A neutral setting draws nothing, so that the constants of other settings stay the same.
        """
        each = (*shape[:-1], 1)
        ranges = {name: getattr(self, name) for name in _SPREADS}
        some = any(isinstance(bounds, list | tuple) for bounds in ranges.values())
        fractions = dict.fromkeys(ranges, generator.random(each) if some else np.zeros(()))
        if self.independent:
            fractions = {name: generator.random(each) for name in ranges}
        settings = {
            name: np.asarray(float(getattr(self, name)))
            for name in ("clip", "quantum", "exponent_at", "offset", "without_lag")
        }
        settings |= {name: _interpolate(bounds, fractions[name]) for name, bounds in ranges.items()}
        gain, offset = (generator.standard_normal(shape) for _ in range(2))
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        idle = generator.standard_normal(shape)
        drift = generator.standard_normal(shape) if settings["drift"].any() else np.zeros(shape)
        count = generator.integers(*self.dead_range, each, endpoint=True)
        level = np.where(rank < count, 0.0, self.clip)
        if self.stuck:
            stuck = (rank >= count) & (rank < count + self.stuck)
            level = np.where(stuck, generator.uniform(0, self.clip, shape), level)
        scale = generator.standard_normal(each) if settings["scale_spread"].any() else np.zeros(())
        lag = generator.random(each) if self.without_lag else np.zeros(())
        own, common = (
            np.exp(settings[f"{name}_spread"] * each) for name, each in (("gain", gain), ("scale", scale))
        )
        return {
            "dead": rank < count + self.stuck + self.saturated,
            "level": level,
            "idle": idle,
            "time_constant": settings["time_constant"] * (lag >= settings["without_lag"]),
            "gain": own * common,
            "offset": settings["offset"] * offset,
            "drift": settings["drift"] * drift,
            **{name: settings[name] for name in _AS_SET},
        }

    def _take(self, shape: tuple[int, ...], generator: np.random.Generator) -> dict[str, np.ndarray]:
        """Take the values of the calibration, or, a device per gesture, draw from its ranges."""
        calibration = self.calibration
        assert calibration is not None
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
        curves = None if self.calibration is None else self.curves(constants)
        return readings if curves is None else curves.straighten(readings)

    def sense(self, force: Tensor, constants: Constants, time: Tensor) -> Tensor:
        """Return the response of the sensors before the converter, (B, T, S), N.

        Cross-talk, hysteresis, a first-order lag, the gain, and the curve, in this order.

        Args:
            force: (B, T, S), true readings, N.
            constants: of this device.
            time: of every frame, (T,), s.
        """
        if constants.cross_talk.any():
            sites = force.unflatten(-1, (-1, 3))
            force = force + (constants.cross_talk @ sites[..., None]).flatten(-3)
        if constants.hysteresis.any():
            force = apply_hysteresis(force, constants.hysteresis)
        if constants.time_constant.any():
            force = first_order_lag(force, constants.time_constant, time)
        force, curves = force * constants.gain, self.curves(constants)
        return force if curves is None else curves.bend(force)

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
        output = self.sense(readings, constants, time)
        clipped = output.clamp(-constants.clip, constants.clip)
        saturated = output.abs() > constants.clip
        return convert(clipped, constants, time, noise.to(readings.device)), saturated


def outside(settings: Mapping[str, Any], ranges: Mapping[str, Any], rounding: float = 1e-6) -> list[str]:
    """Return the settings of a device outside the ranges of others, as "lag 0.2 s (0 to 0.12 s)".

    Args:
        settings: of the device (:class:`ImperfectionSettings`); missing ones are not compared.
        ranges: the same of devices that were drawn.
        rounding: relative tolerance.
    """
    compared = {
        name: [np.broadcast_to(values[name], 2) for values in (settings, ranges)]
        for name in _COMPARED
        if settings.get(name) is not None and ranges.get(name) is not None
    }
    return [
        f"{_COMPARED[name][0]} {' to '.join(f'{limit:g}' for limit in dict.fromkeys(given))}"
        f"{_COMPARED[name][1]} ({low:g} to {high:g}{_COMPARED[name][1]})"
        for name, (given, (low, high)) in compared.items()
        # A device with less noise, drift or lag is easier; a slower one is not.
        if given[1] > high * (1 + rounding) or (name == "rate" and given[0] < low * (1 - rounding))
    ]


def _interpolate(spread: Spread, fraction: np.ndarray) -> np.ndarray:
    """Interpolate between the limits of a range by a fraction, 0 to 1; a number is returned as it is."""
    minimum, maximum = spread if isinstance(spread, list | tuple) else (spread, spread)
    return np.asarray(minimum + (maximum - minimum) * fraction)
