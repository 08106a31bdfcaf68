"""A skin with the simplest simulator, and a device whose touches are drawn from no simulation."""

from typing import Any

import torch

from skin import Grid, Sheet
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated
from skin.device.touches import Touches
from skin.mechanics.simulator.naive import Naive
from skin.touch.labels import TOUCH

SHEET = Sheet((0.16, 0.16), (32, 32), [{"material": "EcoFlex 00-30", "thickness": 0.005}])
PERFECT = {"gain_spread": 0.0, "offset": 0.0, "noise": 0.0, "clip": 1e9}
"""Settings of a device that reads what its simulator answers."""


def naive_skin(**settings: Any) -> Simulated:
    """Return a simulated skin, by default of 3 x 3 sensors with ten gestures."""
    defaults = {"body": SHEET, "layout": Grid(3, 3), "simulator": Naive, "gestures": 10}
    return Simulated(**(defaults | settings))


class MadeUpDevice(AbstractDevice):
    """Yields random touches of 12 sensors and 10 frames whose labels a simple network can learn."""

    task, size, rate = TOUCH, (0.16, 0.12), 10.0

    def touches(self, split: str, epoch: int = 0) -> Touches:
        """Return 160 touches to train on, 40 else."""
        generator = torch.Generator().manual_seed(hash_of(split))
        count = 160 if split == "train" else 40
        labels = torch.rand(count, 4, generator=generator).round()
        readings = 0.05 * torch.randn(count, 10, 12, generator=generator)
        big, dynamic, press, dangerous = labels.T
        for sensor in range(12):
            # a press lasts 6 frames, a tap 2; a dynamic touch comes later to every further sensor
            first = 1 + (dynamic * (sensor % 3)).long()
            last = first + 2 + (4 * press).long()
            now = torch.arange(10)
            during = (now >= first[:, None]) & (now < last[:, None])
            reached = (sensor < 4) | (big == 1)
            force = reached * (1 + 4 * dangerous)
            readings[:, :, sensor] += force[:, None] * during
        grid = torch.cartesian_prod(torch.tensor([0.02, 0.06, 0.1]), torch.tensor([0.02, 0.06, 0.1, 0.14]))
        sites = grid.flip(1) + 0.004 * torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
        positions = torch.cat([sites, torch.full((12, 1), 0.005)], dim=1)
        return Touches(readings, torch.ones_like(readings, dtype=torch.bool), positions, labels, self.rate)


def hash_of(split: str) -> int:
    """Return a seed that does not change from one process to the next."""
    return sum(map(ord, split))
