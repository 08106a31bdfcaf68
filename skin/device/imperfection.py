"""Imperfections of a real device: lag, gain, curve, clip, noise, offset, rounding, dead sensors, tare."""

from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from annotated_types import Ge, Gt
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from scipy.sparse import csr_array
from scipy.special import ndtri
from torch import Tensor

from skin.core.settings import RISING, checked
from skin.device.calibration import Calibration, read_calibration
from skin.device.curves import Curves, check_table
from skin.device.resampling import frame_ages, highest_each, resample
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


def _part(spread: Spread, share: np.ndarray) -> np.ndarray:
    """Return that share, 0 to 1, of a range; a number has none."""
    least, most = spread if isinstance(spread, list | tuple) else (spread, spread)
    return np.asarray(least + (most - least) * share)


def _settings(settings: ImperfectionSettings) -> dict[str, Any]:
    return {entry.name: getattr(settings, entry.name) for entry in fields(ImperfectionSettings)}


# Simulated readings at the rate of a device, reduced to the rate of a model like those of a real one.


_QUANTILES = 20000
_NUMBERS = tuple(np.geomspace(1, 1000, 61).tolist())  # of frames in an interval; between them, 0.001 s.d.
_SENSED = 10  # times the model's rate at which hysteresis, lag and curve are computed before the converter
_ELEMENTS = 2**19  # frames times sensors at a time, which the cache holds


def between_frames(force: Tensor, model_rate: float, rate: float, phase: np.ndarray | float = 0.5) -> Tensor:
    """Return true readings (B, F, S), N, at the rate of a device.

    A frame of the model is the force in the middle of its interval. Between two frames in contact the force
    changes linearly: a sliding touch goes at its speed from one place of its path to the next, and its force
    follows the profile. A touch begins and ends at the edges of its first and last interval, so it does not
    become longer. No reading exceeds the larger of its two frames, so a safe touch stays safe.

    Args:
        force: (B, T, S), true readings at the model's rate, N; a frame without contact is 0.
        model_rate: Hz.
        rate: of the device, Hz.
        phase: when the device reads, (B,) or one for all: share of its interval, from 0 to 1.
    """
    batch, window, _ = force.shape
    frames = round(window * rate / model_rate)
    row = np.arange(batch)[:, None]
    read = np.arange(frames) + np.reshape(phase, (-1, 1))
    place = np.broadcast_to(np.minimum(read * model_rate / rate, window), (batch, frames))
    now, neighbour, offset = _neighbours(place, window)
    padded = torch.nn.functional.pad(force, (0, 0, 1, 1))
    touched = (padded != 0).any(dim=2, keepdim=True)
    share = torch.from_numpy(np.abs(offset)).to(force)[..., None]
    current, neighbour_value = padded[row, now + 1], padded[row, neighbour + 1]
    # Towards a frame without contact the force is 0 at the edge, which is half an interval away.
    share = torch.where(touched[row, neighbour + 1], share, 2 * share)
    return torch.where(touched[row, now + 1], torch.lerp(current, neighbour_value, share), 0.0)


def _neighbours(place: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frames at places and the nearest ones beside them, -1 to ``window``, and the distances.

    Places are in intervals from the begin of the window, 0 to ``window``; the distances are from the middle
    of the frame's interval, -0.5 to 0.5.
    """
    now = np.minimum(place.astype(int), window - 1)
    offset = place - now - 0.5
    return now, now + np.sign(offset).astype(int), offset


def measure(
    imperfection: Imperfection,
    constants: Constants,
    force: Tensor,
    model_rate: float,
    noise: np.random.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what a device measures, at the rate of a model.

    Imperfections apply at the rate of the device. The maximum over each interval of the model is kept, as for
    a real device (:func:`skin.device.resampling.resample`). A faster device reads each gesture, or each
    stream, at a random phase of its interval, since no touch waits for the device. One at the model's rate,
    or slower by up to 5 %, gives the frames of the model.

    Args:
        imperfection: of the device, with its rate.
        constants: of the device.
        force: (B, T, S), true readings, N, at the model's rate.
        model_rate: Hz.
        noise: source of the noise and of the phases.

    Returns:
        readings (B, T, S), N, float32, valid and saturated (B, T, S), bool.
    """
    rate = imperfection.rate
    if not imperfection.aligned or not isinstance(rate, int | float):
        return _measure_each(imperfection, constants, force, model_rate, noise)
    if rate <= model_rate:
        return imperfection.apply(force, constants, noise)
    fine = between_frames(force, model_rate, rate, noise.random(len(force)))
    readings, valid, saturated = imperfection.apply(fine, constants, noise)
    return _reduce_rate(readings, valid, saturated, (rate, model_rate), force.shape[1])


def _measure_each(
    imperfection: Imperfection,
    constants: Constants,
    force: Tensor,
    model_rate: float,
    noise: np.random.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what :func:`measure` does, each gesture read at the rate of its device and at a phase.

    Offset, drift in the middle of the interval, and rounding are added to the maximum of the interval.
    Hysteresis, lag and curve act before the converter and are computed at ten times the model's rate.
    """
    batch, window, sensors = force.shape
    ratios = np.maximum(np.broadcast_to(constants.rate.numpy().ravel(), batch) / model_rate, 1)
    shifts = noise.random(batch)
    if imperfection.aligned:
        shifts = (0.5 - shifts) / ratios
    else:
        # Later by part of an interval; earlier where the window ends with the touch.
        shifts -= (force[:, -1] != 0).any(dim=1).cpu().numpy()
    padded, fine = torch.nn.functional.pad(force, (0, 0, 0, 1)), 1
    if not imperfection.is_static(constants, sensors):
        fine = _SENSED
        padded = between_frames(padded, model_rate, fine * model_rate)
    time = torch.arange(padded.shape[1], device=force.device) / (fine * model_rate)
    sensed = imperfection.sense(padded, constants, time)
    highest, saturated = _read_each(sensed, fine, constants, ratios, shifts, window, noise)
    output = highest.to(force.device) + (constants.offset - constants.baseline)
    if constants.drift.any():
        output += constants.drift * ((torch.arange(window)[:, None] + 0.5) / model_rate).to(output)
    if constants.quantum.any():
        output = quantize(output + constants.baseline, constants.quantum) - constants.baseline
    dead = constants.dead.expand(output.shape)
    return output.masked_fill(dead, 0.0), ~dead, saturated.to(force.device) & ~dead


def _read_each(
    sensed: Tensor,
    fine: int,
    constants: Constants,
    ratios: np.ndarray,
    shifts: np.ndarray,
    window: int,
    noise: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Return the largest reading of every interval, N, and whether it is saturated, (B, window, S).

    Args:
        sensed: (B, F, S), what the sensors respond, N, ``fine`` times per interval of the model.
        fine: see above.
        constants: of the devices; clip and noise are used.
        ratios: (B,), frames of the device per interval.
        shifts: (B,), by which touches are later, intervals.
        window: number of intervals.
        noise: source of the noise.
    """
    batch, _, sensors = sensed.shape
    values = np.pad(sensed.cpu().numpy(), ((0, 0), (1, 1), (0, 0)))
    touched = (values != 0).any(axis=2)
    clip, deviation = (
        np.broadcast_to(value.numpy(), (batch, 1, sensors))[:, 0]
        for value in (constants.clip, constants.noise)
    )
    highest, limited = (
        np.empty((batch, window, sensors), np.float32),
        np.zeros((batch, window, sensors), bool),
    )
    frames = np.cumsum(np.ceil(window * ratios - 0.5))
    parts = np.flatnonzero(np.diff(frames * sensors // _ELEMENTS, prepend=0))
    for rows in map(slice, [0, *parts], [*parts, batch]):
        if rows.start == rows.stop:
            continue
        gesture, age = frame_ages(ratios[rows], window)
        place = (window - age - shifts[rows][gesture]) * fine
        read = _interpolation(place, gesture, touched[rows]) @ values[rows].reshape(-1, sensors)
        number = gesture * window + window - 1 - np.floor(age).astype(int)
        over = np.abs(values[rows]).max() > clip[rows].min()
        if over:
            limit = clip[rows][gesture]
            strongest = highest_each(np.abs(read) > limit, number)
            limited[rows] = strongest.reshape(-1, window, sensors)
            read = np.clip(read, -limit, limit)
        error = noise.standard_normal(read.shape, dtype=np.float32)
        error *= deviation[rows][gesture]
        read += error
        highest[rows] = highest_each(read, number).reshape(-1, window, sensors)
    return torch.from_numpy(highest), torch.from_numpy(limited)


def _interpolation(place: np.ndarray, gesture: np.ndarray, touched: np.ndarray) -> csr_array:
    """Return the weights of frames at places between them, as in :func:`between_frames`.

    Args:
        place: (N,), in frames from the begin of the window; outside of it nothing touches.
        gesture: (N,), of each place.
        touched: (B, F + 2), whether something touches in a frame; one more frame before the first and after
            the last.
    """
    size = touched.shape[1]
    place = np.clip(place, 0, size - 2)
    now, neighbour, offset = _neighbours(place, size - 2)
    column = np.stack([now, neighbour], axis=1) + 1 + size * gesture[:, None]
    share = np.abs(offset) * np.where(touched.ravel()[column[:, 1]], 1, 2)
    weights = np.stack([1 - share, share], axis=1) * touched.ravel()[column[:, :1]]
    begins = np.arange(0, 2 * len(place) + 1, 2)
    return csr_array((weights.ravel().astype(np.float32), column.ravel(), begins), (len(place), touched.size))


def _reduce_rate(
    readings: Tensor, valid: Tensor, saturated: Tensor, rates: tuple[float, float], window: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return readings and masks (B, F, S) at the first of two rates as (B, window, S) at the second, Hz."""
    batch, frames, sensors = readings.shape
    values, works, limits = (
        tensor.transpose(0, 1).flatten(1).cpu().numpy() for tensor in (readings, valid, saturated)
    )
    time = (np.arange(frames) + 0.5) / rates[0]
    resampled = resample(time, values, works, limits, window / rates[1], 1 / rates[1], window)
    tensors = (
        torch.from_numpy(tensor).unflatten(1, (batch, sensors)).transpose(0, 1) for tensor in resampled[:3]
    )
    highest, known_frames, limited = (tensor.contiguous().to(readings.device) for tensor in tensors)
    return highest.to(readings.dtype), known_frames, limited


def draw_constants(
    imperfection: Imperfection,
    sensors: int,
    model_rate: float,
    drawn: np.random.Generator,
    gestures: int | None = None,
) -> Constants:
    """Draw the constants of a device, or of one per gesture, with a baseline of resampled readings.

    The maximum of noise is not 0, so a tare of a real device takes its baseline from resampled readings, too.

    Args:
        imperfection, sensors, drawn, gestures: as in :meth:`Imperfection.constants`.
        model_rate: Hz.
    """
    constants = imperfection.constants(sensors, drawn, gestures)
    if not imperfection.tare:
        return constants
    return constants._replace(baseline=constants.baseline + idle_excess(constants, model_rate))


def idle_excess(constants: Constants, model_rate: float) -> Tensor:
    """Return the mean of idle readings above the offset, N: that of the maximum of the noise of an interval.

    Args:
        constants: of the device, with its rate; the result has the shape of their noise.
        model_rate: Hz.
    """
    numbers = np.maximum(constants.rate.numpy() / model_rate, 1)
    if numbers.size == 1:
        return constants.noise * _highest_of(numbers.item())
    highest = np.interp(np.log(numbers), np.log(_NUMBERS), [_highest_of(number) for number in _NUMBERS])
    return constants.noise * torch.from_numpy(highest).to(constants.noise)


@cache
def _highest_of(number: float) -> float:
    """Return the mean of the largest of so many standard normal values; the number need not be whole."""
    if number == 1:
        return 0.0
    chance = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    return float(ndtri(chance ** (1 / number)).mean())
