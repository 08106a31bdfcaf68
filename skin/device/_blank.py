"""A device that yields placeholder touches of the right shapes."""

from dataclasses import dataclass, replace

import torch

from skin.device.base import AbstractDevice, Split
from skin.labels import Task
from skin.recording import Touches


@dataclass
class Blank(AbstractDevice):
    """Yields the same example for every split: enough to restore a trained run, not to train one."""

    task: Task
    size: tuple[float, float]
    example: Touches

    @classmethod
    def of(cls, task: Task, size: tuple[float, float], touches: Touches) -> "Blank":
        """Return a device whose example is the first of the touches, with labels 0."""
        return cls(task, size, replace(touches[:1], labels=torch.zeros(1, len(task))))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the example."""
        return self.example
