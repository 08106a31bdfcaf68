"""The interface of a device: a source of touches."""

from abc import ABC, abstractmethod
from typing import Literal

from skin.labels import Task
from skin.recording import Touches

__all__ = ["AbstractDevice", "Split"]

Split = Literal["train", "validation", "holdout", "test"]


class AbstractDevice(ABC):
    """Yields touches; nothing downstream knows where they come from.

    Attributes:
        task: what the labels mean.
        size: extent (x, y) of the sheet, m.
    """

    task: Task
    size: tuple[float, float]

    @abstractmethod
    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split.

        ``train``, ``validation`` and ``holdout`` share the training budget 80/10/10 by gesture; ``test``
        comes from gestures that no training can draw, where the device has such. ``epoch`` matters to devices
        that draw fresh gestures.
        """
