"""Is the skin touched? The simple threshold of the report's section 4.2."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from sklearn.metrics import roc_curve
from torch import Tensor

from skin.errors import InputError
from skin.labels import Task
from skin.recording import Touches

Gate = Callable[[Touches, Tensor], Tensor]
"""From windows and their probabilities (B, L) to which of them are said to be touched, (B,), bool."""


def rise(touches: Touches, idle: Tensor | float = 0.0) -> Tensor:
    """Return how far the readings of each window rise above the untouched skin's, (B,), N; at least 0.

    The baseline is not taken from the window: a touch that is held all through it would become the baseline.

    Args:
        touches: readings that are not valid rise by nothing.
        idle: (S,), N, what the untouched skin reads; 0 after a tare.
    """
    return ((touches.readings - idle) * touches.valid).flatten(1).amax(dim=1).clamp(min=0)


@dataclass(frozen=True)
class ContactThreshold:
    """Says that a window is touched if a reading rises by ``least`` N or more above its baseline.

    Attributes:
        least: N.
        idle: (S,), N, as in :func:`rise`.
    """

    least: float
    idle: Tensor | float = 0.0

    @classmethod
    def tuned(cls, rises: Tensor, touched: Tensor, idle: Tensor | float = 0.0) -> "ContactThreshold":
        """Return the threshold that tells best, by balanced accuracy.

        Args:
            rises: (B,), N, as :func:`rise` gives them, of windows that no test will see again.
            touched: (B,), bool.
            idle: (S,), N, as in :func:`rise`.

        Raises:
            InputError: windows that are all touched, or none of them.
        """
        if touched.all() or not touched.any():
            raise InputError(
                f"{len(touched)} validation windows are all alike, with touch or all without: "
                "give more with data.gestures"
            )
        alarms, found, levels = roc_curve(touched.numpy(), rises.numpy())
        return cls(float(levels[int((found - alarms).argmax())]), idle)

    def touched(self, touches: Touches) -> Tensor:
        """Return which windows are touched, (B,), bool."""
        return rise(touches, self.idle) >= self.least


def gates(threshold: ContactThreshold, task: Task) -> dict[str, Gate]:
    """Return the gates by name: ``none`` lets all through; ``learned`` only where the task has a gate."""
    found: dict[str, Gate] = {
        "none": lambda touches, chances: torch.ones(len(touches), dtype=torch.bool),
        "threshold": lambda touches, chances: threshold.touched(touches),
    }
    if task.gate is not None:
        gate = task.names.index(task.gate)
        found["learned"] = lambda touches, chances: chances[:, gate] > 0.5
    return found
