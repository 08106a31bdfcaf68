"""Baseline of an untouched skin, with a check that it was untouched."""

import numpy as np

from skin.errors import InputError
from skin.wire.errors import SkinTouched

FEWEST = 10
"""Frames that a baseline needs."""

# As multiples of the noise and of the smallest step seen.
_MOVED = 8.0, 3.0  # within the frames
_SHIFTED = 20.0, 10.0  # against the old baseline, because offsets drift
_SMOOTH = 0.5  # von Neumann ratio of successive differences to variance: 2 for noise, near 0 for a touch


def quiet_baseline(
    values: np.ndarray, valid: np.ndarray, before: np.ndarray | None = None, touch: float = 0.0
) -> np.ndarray:
    """Return the median of each channel over frames without touch, (S,).

    A touch is detected as a change, within the frames or against the previous baseline. A constant load
    cannot be distinguished from an offset.

    Args:
        values: (F, S).
        valid: (F, S); channels without a valid value are not checked.
        before: the previous baseline, (S,), or None.
        touch: smallest shift of the baseline that counts as a touch, however small the noise.

    Raises:
        InputError: too few frames.
        SkinTouched: the skin was touched.
    """
    middle = median_baseline(values)
    checked = np.asarray(valid.any(axis=0))
    steps = np.abs(np.diff(values, axis=0))
    # From differences: a touch that lasts half of the time would otherwise count as noise.
    noise = 1.4826 * np.median(steps, axis=0) / np.sqrt(2)
    smallest = np.where(steps > 0, steps, np.inf).min(axis=0)
    smallest[np.isinf(smallest)] = 0.0
    moved = np.abs(values - middle).max(axis=0)
    # A stroke changes by as much as noise does, but in a consistent direction.
    smooth = (steps**2).mean(axis=0) < _SMOOTH * values.var(axis=0)
    noise = np.where(smooth, 0.0, noise)
    _refuse("moved by", moved, np.maximum(_MOVED[0] * noise, _MOVED[1] * smallest), checked)
    if before is not None:
        limit = np.maximum(np.maximum(_SHIFTED[0] * noise, _SHIFTED[1] * smallest), touch)
        _refuse("differs from its old baseline by", np.abs(middle - before), limit, checked)
    return middle


def median_baseline(values: np.ndarray) -> np.ndarray:
    """Return the median of each channel (S,) over frames (F, S), touched or not.

    Raises:
        InputError: too few frames.
    """
    if len(values) < FEWEST:
        raise InputError(f"a baseline needs {FEWEST} frames, got {len(values)}: give more seconds")
    return np.asarray(np.median(values, axis=0))


def _refuse(what: str, found: np.ndarray, limit: np.ndarray, checked: np.ndarray) -> None:
    beyond = np.where(checked, found - limit, -np.inf)
    channel = int(beyond.argmax())
    if beyond[channel] > 0:
        raise SkinTouched(
            f"the skin is touched: channel {channel} {what} {found[channel]:.4g}, noise explains "
            f"{limit[channel]:.4g}; let go and tare again, or tare(force=True) if nothing touches it"
        )
