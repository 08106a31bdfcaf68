"""From the frames of a device to the fewer frames of a model."""

from collections.abc import Sequence

import numpy as np

from skin.errors import InputError
from skin.port.frame import Frame

__all__ = ["check_rate", "highest", "rate_of", "reduced"]

_SLACK = 1e-6  # of a frame: clocks count in whole microseconds
_SLOWER = 0.95  # of the model's rate: a resonator may be that wrong, and a frame may be lost


def reduced(frames: Sequence[Frame], begin: float, rate: float, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what :func:`highest` makes of frames of one segment."""
    t, values, valid = zip(*((frame.t, frame.values, frame.valid) for frame in frames), strict=True)
    return highest(np.array(t), np.stack(values), np.stack(valid), begin, rate, window)


def highest(
    time: np.ndarray, values: np.ndarray, valid: np.ndarray, begin: float, rate: float, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum of each channel over each interval of the model, and whether it means something.

    A value means something if every frame of its interval says so: the maximum without a saturated frame
    would hide the largest force. An interval without frames has zeros, invalid: nothing is interpolated.

    Args:
        time: (F,), s.
        values: (F, S).
        valid: (F, S), bool.
        begin: s, the device's clock at which the window begins.
        rate: of the model, Hz.
        window: T, frames of the model.

    Returns:
        values (T, S) in the device's unit and valid (T, S), bool.
    """
    sensors = values.shape[1]
    place = np.floor((time - begin) * rate + _SLACK).astype(int)
    inside = (place >= 0) & (place < window)
    most = np.full((window, sensors), -np.inf)
    np.maximum.at(most, place[inside], values[inside])
    good = np.ones((window, sensors), dtype=bool)
    np.logical_and.at(good, place[inside], valid[inside])
    seen = np.isfinite(most)
    return np.where(seen, most, 0.0), good & seen


def rate_of(frames: Sequence[Frame]) -> float:
    """Return the rate of a device by its clock, Hz, lost frames counted in; 0 if it cannot be told."""
    passed = frames[-1].t - frames[0].t
    count = len(frames) - 1 + sum(frame.lost for frame in frames[1:])
    return count / passed if passed > 0 else 0.0


def check_rate(found: float, rate: float) -> None:
    """Raise InputError where a device is slower than a model."""
    if found < _SLOWER * rate:
        raise InputError(
            f"the device sends {found:.4g} frames a second, the model needs {rate:g}: let the firmware send "
            "faster, or train a model at the device's rate, as in device.rate=5"
        )
