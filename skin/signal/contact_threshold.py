"""Contact detection by a threshold (report, section 4.2)."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from sklearn.metrics import roc_curve
from torch import Tensor

from skin.errors import InputError
from skin.labels import Task
from skin.recording import Touches

Gate = Callable[[Touches, Tensor], Tensor]
"""Maps windows and their probabilities (B, L) to predicted contact, (B,), bool."""


def rise(touches: Touches, idle: Tensor | float = 0.0) -> Tensor:
    """Return the largest rise of each window above the untouched skin, (B,), N; at least 0.

    The baseline is not taken from the window: a touch held throughout it would become the baseline.

    Args:
        touches: invalid readings are ignored.
        idle: (S,), N, readings of the untouched skin; 0 after a tare.
    """
    return ((touches.readings - idle) * touches.valid).flatten(1).amax(dim=1).clamp(min=0)


@dataclass(frozen=True)
class ContactThreshold:
    """Predicts contact if a reading rises by ``least`` N or more above its baseline.

    Attributes:
        least: N.
        idle: (S,), N, as in :func:`rise`.
    """

    least: float
    idle: Tensor | float = 0.0

    @classmethod
    def tuned(cls, rises: Tensor, touched: Tensor, idle: Tensor | float = 0.0) -> "ContactThreshold":
        """Return the threshold of the highest balanced accuracy.

        Args:
            rises: (B,), N, from :func:`rise`, of windows that are not used for testing.
            touched: (B,), bool.
            idle: (S,), N, as in :func:`rise`.

        Raises:
            InputError: all windows are touched, or none is.
        """
        if touched.all() or not touched.any():
            raise InputError(
                f"{len(touched)} validation windows are all alike, with touch or all without: "
                "give more with data.gestures"
            )
        alarms, detected, levels = roc_curve(touched.numpy(), rises.numpy())
        return cls(float(levels[int((detected - alarms).argmax())]), idle)

    def touched(self, touches: Touches) -> Tensor:
        """Return which windows are touched, (B,), bool."""
        return rise(touches, self.idle) >= self.least


def gates(threshold: ContactThreshold, task: Task) -> dict[str, Gate]:
    """Return the gates by name: ``none`` lets all through; ``learned`` only where the task has a gate."""
    gates: dict[str, Gate] = {
        "none": lambda touches, chances: torch.ones(len(touches), dtype=torch.bool),
        "threshold": lambda touches, chances: threshold.touched(touches),
    }
    if task.gate is not None:
        gate = task.names.index(task.gate)
        gates["learned"] = lambda touches, chances: chances[:, gate] > 0.5
    return gates
