"""Touches, the type that every device yields, and Recording, its stored form."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

__all__ = ["Touches"]


@dataclass(frozen=True)
class Touches:
    """A batch of touches as any device yields it.

    Attributes:
        readings: (B, T, S), N.
        valid: (B, T, S), bool: False where a reading means nothing (dead sensor, lost frame).
        positions: (S, 3) or (B, T, S, 3), m: x right and y down from the upper left corner, z depth.
        labels: (B, L), 0 or 1, float; or None.
        rate: frames per second, Hz.

    Raises:
        ValueError: shapes or types disagree.
    """

    readings: Tensor
    valid: Tensor
    positions: Tensor
    labels: Tensor | None
    rate: float

    def __post_init__(self) -> None:
        if self.readings.ndim != 3 or self.valid.shape != self.readings.shape:
            raise ValueError(
                f"readings and valid must both be (B, T, S), got {tuple(self.readings.shape)} "
                f"and {tuple(self.valid.shape)}"
            )
        if self.valid.dtype != torch.bool:
            raise ValueError(f"valid must be bool, got {self.valid.dtype}")
        batch, time, sensors = self.readings.shape
        if tuple(self.positions.shape) not in {(sensors, 3), (batch, time, sensors, 3)}:
            raise ValueError(f"positions must be (S, 3) or (B, T, S, 3) with S = {sensors}, got {tuple(self.positions.shape)}")
        if self.labels is not None and (self.labels.ndim != 2 or len(self.labels) != batch):
            raise ValueError(f"labels must be (B, L) with B = {batch}, got {tuple(self.labels.shape)}")

    def __len__(self) -> int:
        return len(self.readings)

    def __getitem__(self, index: Tensor | slice) -> "Touches":
        """Return the touches that ``index`` selects; positions common to all touches stay common."""
        return Touches(
            self.readings[index],
            self.valid[index],
            self.positions if self.positions.ndim == 2 else self.positions[index],
            None if self.labels is None else self.labels[index],
            self.rate,
        )

    def to(self, device: torch.device | str) -> "Touches":
        """Return these touches with every tensor on ``device``."""
        moved = (getattr(self, field.name) for field in fields(self))
        return Touches(*(value.to(device) if isinstance(value, Tensor) else value for value in moved))
