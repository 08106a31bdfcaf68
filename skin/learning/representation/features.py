"""Readings above their idle level, with engineered features of the window."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from skin.device.touches import Touches
from skin.learning.features import feature_blocks
from skin.learning.representation.base import AbstractRepresentation, Frames, channels

_IDLE = 8


class Features(AbstractRepresentation):
    """Gives readings above their idle level on two scales, and engineered features as a summary.

    A network then sees the readings and the features that boosted trees are trained on. The idle level of a
    sensor is the mean of its eight lowest frames. It is subtracted, so that a network cannot learn the
    constant offsets of one device. The second scale is logarithmic, which resolves weak touches.

    Args:
        positions: (S, 3), m; the features depend on them.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; readings on the linear scale are divided by it.
        finest: N; the logarithmic scale asinh(x / finest) is linear below it.
        mask: append one feature per sensor that is 1 where its reading is not valid.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"
    windowed: ClassVar[bool] = True
    positions: Tensor

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        scale: float = 3.0,
        finest: float = 0.2,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.scale, self.finest, self.mask = scale, finest, mask
        self.register_buffer("positions", positions)

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, 2 S), or (B, T, 3 S) with the mask, and the summary (B, D), as asinh.

        The window should hold at least eight frames without touch.
        """
        values = channels(readings, valid, 1.0, self.mask)
        raw = values[..., 0]
        idle = raw.topk(min(_IDLE, raw.shape[1]), dim=1, largest=False).values.mean(dim=1, keepdim=True)
        excess = (raw - idle) * valid
        views = [excess / self.scale, torch.asinh(excess / self.finest) / 2, *values.unbind(-1)[1:]]
        touches = Touches(readings, valid, self.positions, None, 1.0)
        summary = torch.cat([values.to(raw) for _, values in feature_blocks(touches)], dim=1)
        return Frames(torch.cat(views, dim=-1), None, summary.asinh())
