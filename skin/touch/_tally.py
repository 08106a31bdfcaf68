"""Count the rejected draws of gestures."""

import warnings
from dataclasses import dataclass

import numpy as np

__all__ = ["Tally"]


@dataclass(frozen=True)
class Tally:
    """Counts per gesture (B,), which grow as the search goes on.

    Attributes:
        draws: how many paths were drawn.
        unconverged: frames whose pressure was not found.
        misfits: bodies that had no room on the sheet.
    """

    draws: np.ndarray
    unconverged: np.ndarray
    misfits: np.ndarray

    @classmethod
    def of(cls, count: int) -> "Tally":
        """Return one that begins at 0."""
        return cls(*np.zeros((3, count)))

    def warn(self) -> None:
        """Say how many frames were not found, if any."""
        lost = int(self.unconverged.sum())
        if lost:
            warnings.warn(
                f"{lost} frames were not found to contact.tolerance in contact.iterations; their gestures "
                "were drawn again: raise contact.iterations or contact.tolerance",
                RuntimeWarning,
                stacklevel=3,
            )
