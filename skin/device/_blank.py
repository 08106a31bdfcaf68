"""A device of which only the shapes are known."""

from dataclasses import dataclass, replace

import torch

from skin.device.base import AbstractDevice, Split
from skin.labels import Task
from skin.recording import Touches


@dataclass
class Blank(AbstractDevice):
    """Yields the same touches for every split: enough to bring a run back, of no use to learn from."""

    task: Task
    size: tuple[float, float]
    example: Touches

    @classmethod
    def of(cls, task: Task, size: tuple[float, float], touches: Touches) -> "Blank":
        """Return one whose example is the first of some touches, labelled 0."""
        return cls(task, size, replace(touches[:1], labels=torch.zeros(1, len(task))))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the example."""
        return self.example
