"""The baseline of an untouched skin, and a test that it was untouched."""

import numpy as np

from skin.errors import InputError
from skin.wire.errors import SkinTouched

_FEWEST = 10  # frames
# As multiples of the noise and of the smallest step seen.
_MOVED = 8.0, 3.0  # within the frames
_SHIFTED = 20.0, 10.0  # against the old baseline, because offsets drift
_SMOOTH = 0.5  # von Neumann's ratio of successive differences to variance: 2 for noise, near 0 for a hand


def quiet_baseline(
    values: np.ndarray, valid: np.ndarray, before: np.ndarray | None = None, touch: float = 0.0
) -> np.ndarray:
    """Return the median of each channel over frames without touch, (S,).

    Touch is seen as a change: within the frames, or against the baseline before. A weight that lay there
    from the first moment on cannot be told from an offset.

    Args:
        values: (F, S).
        valid: (F, S); a channel that never means anything is not asked.
        before: the old baseline, (S,), if there is one.
        touch: smallest shift of the baseline that is taken for a touch, however small the noise.

    Raises:
        InputError: too few frames.
        SkinTouched: the skin was touched.
    """
    middle = median_baseline(values)
    asked = np.asarray(valid.any(axis=0))
    steps = np.abs(np.diff(values, axis=0))
    # From differences, because a touch that lasts half the time would pass for noise otherwise.
    noise = 1.4826 * np.median(steps, axis=0) / np.sqrt(2)
    smallest = np.where(steps > 0, steps, np.inf).min(axis=0)
    smallest[np.isinf(smallest)] = 0.0
    moved = np.abs(values - middle).max(axis=0)
    # A hand that strokes all the time steps as far as noise does, but its next step goes the same way.
    smooth = (steps**2).mean(axis=0) < _SMOOTH * values.var(axis=0)
    noise = np.where(smooth, 0.0, noise)
    _refuse("moved by", moved, np.maximum(_MOVED[0] * noise, _MOVED[1] * smallest), asked)
    if before is not None:
        limit = np.maximum(np.maximum(_SHIFTED[0] * noise, _SHIFTED[1] * smallest), touch)
        _refuse("rests away from its old baseline by", np.abs(middle - before), limit, asked)
    return middle


def median_baseline(values: np.ndarray) -> np.ndarray:
    """Return the median of each channel (S,) over frames (F, S), touched or not.

    Raises:
        InputError: too few frames.
    """
    if len(values) < _FEWEST:
        raise InputError(f"a baseline needs {_FEWEST} frames, got {len(values)}: give more seconds")
    return np.asarray(np.median(values, axis=0))


def _refuse(what: str, found: np.ndarray, limit: np.ndarray, asked: np.ndarray) -> None:
    beyond = np.where(asked, found - limit, -np.inf)
    channel = int(beyond.argmax())
    if beyond[channel] > 0:
        raise SkinTouched(
            f"the skin is touched: channel {channel} {what} {found[channel]:.4g}, noise explains "
            f"{limit[channel]:.4g}; let go and tare again, or tare(force=True) if nothing touches it"
        )
