"""Simulated readings at the rate of a device, reduced to the rate of a model like those of a real one."""

import numpy as np
import torch
from scipy.special import ndtri
from torch import Tensor

from skin.signal.constants import Constants
from skin.signal.imperfection import Imperfection
from skin.signal.resampling import resample

_QUANTILES = 20000


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
    read = np.arange(frames) + np.reshape(phase, (-1, 1))
    place = np.broadcast_to(np.minimum(read * model_rate / rate, window), (batch, frames))
    now = np.minimum(place.astype(int), window - 1)
    offset = place - now - 0.5  # from the middle of the interval, in intervals
    neighbour = now + np.sign(offset).astype(int)
    padded = torch.nn.functional.pad(force, (0, 0, 1, 1))
    touched = (padded != 0).any(dim=2, keepdim=True)
    share = torch.from_numpy(np.abs(offset)).to(force)[..., None]
    row = np.arange(batch)[:, None]
    current, neighbour_value = padded[row, now + 1], padded[row, neighbour + 1]
    # Towards a frame without contact the force is 0 at the edge, which is half an interval away.
    share = torch.where(touched[row, neighbour + 1], share, 2 * share)
    return torch.where(touched[row, now + 1], torch.lerp(current, neighbour_value, share), 0.0)


def measure(
    imperfection: Imperfection,
    constants: Constants,
    force: Tensor,
    model_rate: float,
    noise: np.random.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what a device measures, at the rate of a model.

    Imperfections apply at the rate of the device. The maximum over each interval of the model is kept, as for
    a real device (:func:`skin.signal.resampling.resample`). A faster device reads each gesture, or each
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
    if imperfection.rate <= model_rate:
        return imperfection.apply(force, constants, noise)
    fine = between_frames(force, model_rate, imperfection.rate, noise.random(len(force)))
    readings, valid, saturated = imperfection.apply(fine, constants, noise)
    return _reduced(readings, valid, saturated, (imperfection.rate, model_rate), force.shape[1])


def _reduced(
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
    if not imperfection.tare or imperfection.rate <= model_rate:
        return constants
    return constants._replace(baseline=constants.baseline + idle_excess(imperfection, constants, model_rate))


def idle_excess(imperfection: Imperfection, constants: Constants, model_rate: float) -> Tensor:
    """Return the mean of idle readings above the offset, N: that of the maximum of the noise of an interval.

    Args:
        imperfection: of the device, with its rate.
        constants: of the device; the result has the shape of their noise.
        model_rate: Hz.
    """
    number = imperfection.rate / model_rate
    if number <= 1:
        return torch.zeros_like(constants.noise)
    chance = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    return constants.noise * float(ndtri(chance ** (1 / number)).mean())
