"""Is the skin touched at all? The simple threshold of the report's section 4.2."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from sklearn.metrics import roc_curve
from torch import Tensor

from skin.errors import InputError
from skin.labels import Task
from skin.recording import Touches

__all__ = ["Gate", "Threshold", "gates", "rise"]

Gate = Callable[[Touches, Tensor], Tensor]
"""From windows and their probabilities (B, L) to which of them are said to be touched, (B,), bool."""

_IDLE = 0.2  # a sensor rests for at least a fifth of a window: the longest press lasts 20 frames of 30


def rise(touches: Touches) -> Tensor:
    """Return how far the readings of each window rise above their running baseline, (B,), N.

    Each sensor's baseline is the level under which a fifth of the window's own readings lie, so it follows
    offset and drift with the window, needs no frame before it, and is not raised by a touch that lasts less
    than four fifths of it. Readings that are not valid rise by nothing.
    """
    readings = touches.readings.where(touches.valid, 0)
    rank = 1 + int(_IDLE * (readings.shape[1] - 1))
    baseline = readings.kthvalue(rank, dim=1, keepdim=True).values
    return ((readings - baseline) * touches.valid).flatten(1).amax(dim=1)


@dataclass(frozen=True)
class Threshold:
    """Says that a window is touched if a reading rises by ``least`` N or more above its baseline.

    Attributes:
        least: N.
    """

    least: float

    @classmethod
    def tuned(cls, rises: Tensor, touched: Tensor) -> "Threshold":
        """Return the threshold that tells best, by balanced accuracy.

        Args:
            rises: (B,), N, as :func:`rise` gives them, of windows that no test will see again.
            touched: (B,), bool.

        Raises:
            InputError: windows that are all touched, or none of them.
        """
        if touched.all() or not touched.any():
            raise InputError(
                f"{len(touched)} validation windows are all alike, with touch or all without: "
                "give more with data.gestures"
            )
        idle, found, levels = roc_curve(touched.numpy(), rises.numpy())
        return cls(float(levels[int((found - idle).argmax())]))

    def touched(self, touches: Touches) -> Tensor:
        """Return which windows are touched, (B,), bool."""
        return rise(touches) >= self.least


def gates(threshold: Threshold, task: Task) -> dict[str, Gate]:
    """Return the gates by name: ``none`` lets all through; ``learned`` only where the task has a gate."""
    found: dict[str, Gate] = {
        "none": lambda touches, chances: torch.ones(len(touches), dtype=torch.bool),
        "threshold": lambda touches, chances: threshold.touched(touches),
    }
    if task.gate is not None:
        gate = task.names.index(task.gate)
        found["learned"] = lambda touches, chances: chances[:, gate] > 0.5
    return found
