"""When the alarm is decided, and which window it is decided on: shared by the live view and its simulation."""

import numpy as np

DECISIONS = 20.0
"""Decisions per second of device time; one per frame of a slower device."""

RELEASE = 0.3
"""s without a rise that end a contact."""


def held_frames(longest: float, rate: float, window: int) -> int:
    """Return the largest number of frames in contact that a model has seen in its training.

    Args:
        longest: touch of the training, s.
        rate: of the model, Hz.
        window: T, frames.
    """
    return min(max(1, round(longest * rate)), max(1, window - 2))


def as_press(idle: np.ndarray, present: np.ndarray, held: int) -> np.ndarray:
    """Return a window in which a contact that lasts too long appears as a press.

    A constant load would otherwise look like an untouched skin.

    Args:
        idle: (T, ...), the latest window without contact.
        present: (T, ...), the window that ends now.
        held: frames of contact that the result shows, from :func:`held_frames`.
    """
    before = (len(present) - held) // 2
    return np.concatenate([idle[:before], present[-held:], idle[before + held :]])
