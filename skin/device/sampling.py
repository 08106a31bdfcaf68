"""Simulated readings at the rate of a device, reduced to the rate of a model like those of a real one."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.special import ndtri
from torch import Tensor

from skin.device.imperfection import Constants, Imperfection, convert
from skin.device.resampling import frame_ages, highest_each, resample
from skin.device.touches import Recording

_NUMBERS = tuple(np.geomspace(1, 1000, 61).tolist())  # of frames in an interval; between them, 0.001 s.d.
_SENSED = 5  # times the model's rate, of hysteresis, lag and curve; odd, so that a frame of the model is one


def between_frames(force: Tensor, model_rate: float, rate: float, phase: np.ndarray | float = 0.5) -> Tensor:
    """Return true readings (B, F, S), N, at the rate of a device.

    A frame of the model is the force in the middle of its interval. Between two frames in contact the force
    changes linearly: a sliding touch goes at its speed from one position of its path to the next, and its
    force follows the profile. A touch begins and ends at the edges of its first and last interval, so it does
    not become longer. No reading exceeds the larger of its two frames, so a safe touch stays safe.

    Args:
        force: (B, T, S), true readings at the model's rate, N; a frame without contact is 0.
        model_rate: Hz.
        rate: of the device, Hz.
        phase: when the device reads, (B,) or one for all: fraction of its interval, from 0 to 1.
    """
    batch, window, _ = force.shape
    frames = round(window * rate / model_rate)
    row = np.arange(batch)[:, None]
    read = np.arange(frames) + np.reshape(phase, (-1, 1))
    position = np.broadcast_to(np.minimum(read * model_rate / rate, window), (batch, frames))
    now, neighbour, offset = _neighbours(position, window)
    padded = torch.nn.functional.pad(force, (0, 0, 1, 1))
    touched = (padded != 0).any(dim=2, keepdim=True)
    fraction = torch.from_numpy(np.abs(offset)).to(force)[..., None]
    current, neighbour_value = padded[row, now + 1], padded[row, neighbour + 1]
    # Towards a frame without contact the force is 0 at the edge, which is half an interval away.
    fraction = torch.where(touched[row, neighbour + 1], fraction, 2 * fraction)
    return torch.where(touched[row, now + 1], torch.lerp(current, neighbour_value, fraction), 0.0)


def _neighbours(position: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frames at positions and the nearest ones beside them, -1 to ``window``, and the distances.

    Places are in intervals from the begin of the window, 0 to ``window``; the distances are from the middle
    of the frame's interval, -0.5 to 0.5.
    """
    now = np.minimum(position.astype(int), window - 1)
    offset = position - now - 0.5
    return now, now + np.sign(offset).astype(int), offset


def measure(
    imperfection: Imperfection,
    constants: Constants,
    force: Tensor,
    model_rate: float,
    noise: np.random.Generator,
    ongoing: bool = False,
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
        ongoing: touches may go on after the window; otherwise they end in it, whatever the phase.

    Returns:
        readings (B, T, S), N, float32, valid and saturated (B, T, S), bool.
    """
    rate = imperfection.rate
    if not imperfection.aligned or imperfection.framed or not isinstance(rate, int | float):
        return _measure_each(imperfection, constants, force, model_rate, noise, ongoing)
    if rate <= model_rate:
        return imperfection.apply(force, constants, noise)
    fine = between_frames(force, model_rate, rate, noise.random(len(force)))
    return _reduce_rate(*imperfection.apply(fine, constants, noise), (rate, model_rate), force.shape[1])


def _measure_each(
    imperfection: Imperfection,
    constants: Constants,
    force: Tensor,
    model_rate: float,
    noise: np.random.Generator,
    ongoing: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what :func:`measure` does, each gesture read at the rate of its device and at a phase.

    Offset, drift in the middle of the interval, and rounding are added to the maximum of the interval.
    Hysteresis, lag and curve act before the converter and are computed at five times the model's rate.
    """
    batch, window, _ = force.shape
    ratios = np.maximum(np.broadcast_to(constants.rate.numpy().ravel(), batch) / model_rate, 1)
    shifts = noise.random(batch)
    if imperfection.aligned:
        shifts = (0.5 - shifts) / ratios
    else:
        # Later by part of an interval; earlier where the window ends with the touch. One that goes on is
        # shown to the middle of its last frame at least, which its labels count.
        shifts -= (force[:, -1] != 0).any(dim=1).cpu().numpy() * (0.5 if ongoing else 1)
    if imperfection.framed:
        framed = noise.random(batch) < imperfection.framed
        ratios, shifts = np.where(framed, 1, ratios), np.where(framed, 0, shifts)
    padded, fine = torch.nn.functional.pad(force, (0, 0, 0, 1)), 1
    in_time = constants.hysteresis.any() or constants.time_constant.any()
    if in_time or imperfection.curves(constants) is not None:
        fine = _SENSED
        padded = between_frames(padded, model_rate, fine * model_rate)
    time = torch.arange(padded.shape[1], device=force.device) / (fine * model_rate)
    sensed = imperfection.sense(padded, constants, time)
    highest, saturated = _read_each(sensed, fine, constants, ratios, shifts, window, noise)
    time = ((torch.arange(window) + 0.5) / model_rate).to(force)
    output = convert(highest.to(force), constants, time, None)  # it is clipped, with noise
    dead = constants.dead.expand(output.shape)
    return (
        imperfection.undo_curve(output, constants).masked_fill(dead, 0.0),
        ~dead,
        saturated.to(force.device) & ~dead,
    )


def _read_each(
    sensed: Tensor,
    fine: int,
    constants: Constants,
    ratios: np.ndarray,
    shifts: np.ndarray,
    window: int,
    noise: np.random.Generator,
    faint: float = 0.01,
    at_once: int = 2**19,
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
        faint: readings below this number of standard deviations of the noise are noise alone.
        at_once: readings computed at a time, which the cache holds.
    """
    batch, _, sensors = sensed.shape
    values = np.pad(sensed.cpu().numpy(), ((0, 0), (1, 1), (0, 0)))
    clip, deviation = (
        np.broadcast_to(value.numpy(), (batch, 1, sensors))[:, 0]
        for value in (constants.clip, constants.noise)
    )
    touched = (np.abs(values) > faint * deviation[:, None]).any(axis=2)
    highest, limited = (np.zeros((batch, window, sensors), kind) for kind in (np.float32, bool))
    frames = np.cumsum(np.ceil(window * ratios - 0.5))
    cuts = np.flatnonzero(np.diff(frames * sensors // at_once, prepend=0))
    for first, last in pairwise(np.unique([0, *cuts, batch])):
        part = slice(first, last)
        gesture, age = frame_ages(ratios[part], window)
        number = gesture * window + window - 1 - np.floor(age).astype(int)
        position = np.clip((window - age - shifts[part][gesture]) * fine, 0, values.shape[1] - 2)
        begins = np.flatnonzero(np.diff(number, prepend=-1))
        counts = np.diff(begins, append=len(number))
        rows = touched[part][gesture, np.minimum(position.astype(int) + 1, values.shape[1] - 2)]
        pressed = np.logical_or.reduceat(rows, begins)
        rows = np.repeat(pressed, counts)
        read = _interpolation(position[rows], gesture[rows], touched[part]) @ values[part].reshape(
            -1, sensors
        )
        if np.abs(values[part]).max() > clip[part].min():
            limit = clip[part][gesture[rows]]
            limited[part].reshape(-1, sensors)[pressed] = highest_each(np.abs(read) > limit, number[rows])
            read = np.clip(read, -limit, limit)
        read += noise.standard_normal(read.shape, dtype=np.float32) * deviation[part][gesture[rows]]
        result = highest[part].reshape(-1, sensors)
        result[pressed] = highest_each(read, number[rows])
        result[~pressed] = (
            _draw_highest(counts[~pressed], sensors, noise) * deviation[part][gesture[begins[~pressed]]]
        )
    return torch.from_numpy(highest), torch.from_numpy(limited)


def _draw_highest(
    counts: np.ndarray, sensors: int, noise: np.random.Generator, extreme: float = 1e-7
) -> np.ndarray:
    """Return the largest of ``counts`` (I,) standard normal values for each sensor, (I, S).

    Its probability to be below x is the normal one to the power of the count, and is itself uniform.
    """
    drawn = noise.standard_exponential((len(counts), sensors), dtype=np.float32)
    # One draw in some millions is 0 or rounds to a probability of 1, whose quantiles are infinite.
    drawn = np.clip(drawn, np.float32(extreme), -np.log(np.float32(extreme)))
    return -ndtri(-np.expm1(-drawn / counts[:, None].astype(np.float32)))


def _interpolation(position: np.ndarray, gesture: np.ndarray, touched: np.ndarray) -> csr_array:
    """Return the weights of frames at positions between them, as in :func:`between_frames`.

    Args:
        position: (N,), in frames from the begin of the window.
        gesture: (N,), of each position.
        touched: (B, F + 2), whether something touches in a frame; one more frame before the first and after
            the last.
    """
    size = touched.shape[1]
    now, neighbour, offset = _neighbours(position, size - 2)
    column = np.stack([now, neighbour], axis=1) + 1 + size * gesture[:, None]
    fraction = np.abs(offset) * np.where(touched.ravel()[column[:, 1]], 1, 2)
    weights = np.stack([1 - fraction, fraction], axis=1) * touched.ravel()[column[:, :1]]
    begins = np.arange(0, 2 * len(position) + 1, 2)
    return csr_array(
        (weights.ravel().astype(np.float32), column.ravel(), begins), (len(position), touched.size)
    )


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
    """Return the mean of idle readings above the offset, N: the mean of the largest noise of an interval.

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
def _highest_of(number: float, quantiles: int = 20_000) -> float:
    """Return the mean of the largest of so many standard normal values; the number need not be whole."""
    if number == 1:
        return 0.0
    probability = (np.arange(quantiles) + 0.5) / quantiles
    return float(ndtri(probability ** (1 / number)).mean())


def with_imperfections(
    true: Recording,
    imperfection: Imperfection,
    constants: Constants | None,
    noise: np.random.Generator,
    ongoing: bool = False,
) -> Recording:
    """Return true readings with the imperfections of a device.

    Args:
        true: touches without imperfections.
        imperfection: of the device.
        constants: of the device; None: another device, drawn, measures each touch.
        noise: source of the noise.
        ongoing: as in :func:`measure`.
    """
    force, rate = true.touches.readings, true.touches.rate
    if constants is None:
        constants = draw_constants(imperfection, force.shape[2], rate, noise, len(true))
    readings, valid, saturated = measure(imperfection, constants, force, rate, noise, ongoing)
    return replace(
        true,
        touches=replace(true.touches, readings=readings, valid=valid, saturated=saturated),
        parameters=true.parameters | {"clipped": saturated.flatten(1).any(1).float()},
    )
