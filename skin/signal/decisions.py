"""When the alarm is decided, and on which window: shared by the live view and its simulation."""

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


def longest_shown(held: int, recent: int, window: int) -> int:
    """Return the frames of a contact up to which the model sees its window as it is.

    A touch as long as the longest of the training lies across one more interval, and its contact ends some
    frames later.

    Args:
        held: as :func:`held_frames` gives it.
        recent: frames without a rise that end a contact.
        window: T, frames.
    """
    return min(held + recent + 1, max(1, window - 2))


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
