"""First-order lag, hysteresis and rounding of readings in time."""

import torch
from torch import Tensor


def first_order_lag(readings: Tensor, time_constant: Tensor, time: Tensor) -> Tensor:
    """Return readings (B, T, S) after a first-order lag that starts at rest.

    The result is exact for a force that is constant between frames. The difference decays by
    exp(-dt / time_constant).

    Args:
        readings: N.
        time_constant: s, broadcast with (B, S) or (B, 1, S); 0: none.
        time: of every frame, (T,), s.
    """
    constant = time_constant.to(readings.dtype)
    constant = constant[:, 0] if constant.ndim == 3 else constant
    steps = time.diff(prepend=2 * time[:1] - time[1:2]).to(readings.dtype)
    state, output = torch.zeros_like(readings[:, 0]), torch.empty_like(readings)
    for number, frame in enumerate(readings.unbind(1)):
        # A constant of 0 gives exp(-inf) = 0; the clamp avoids 0 / 0.
        state = torch.lerp(frame, state, torch.exp(-steps[number] / constant.clamp(min=1e-9)))
        output[:, number] = state
    return output


def running_peak(readings: Tensor) -> Tensor:
    """Return the largest |reading| since a sensor was last at rest, (B, T, S), N."""
    size, found = readings.abs(), torch.empty_like(readings)
    peak = torch.zeros_like(size[:, 0])
    for number, frame in enumerate(size.unbind(1)):
        peak = torch.where(frame > 0, torch.maximum(peak, frame), 0)
        found[:, number] = peak
    return found


def apply_hysteresis(readings: Tensor, hysteresis: Tensor) -> Tensor:
    """Return readings (B, T, S), N, with hysteresis: larger on unloading, by a mean share of the peak.

    At a force x after a peak P that is x + 6 hysteresis x (P - x) / P: no gap at rest and none at the peak.
    """
    peak = running_peak(readings)
    left = torch.where(peak > 0, 1 - readings.abs() / torch.where(peak > 0, peak, 1), 0)
    return readings * (1 + 6 * hysteresis * left)


def quantize(readings: Tensor, quantum: Tensor) -> Tensor:
    """Return readings rounded to multiples of ``quantum``, N; 0: not rounded."""
    step = torch.where(quantum > 0, quantum, 1)
    return torch.where(quantum > 0, torch.round(readings / step) * step, readings)
