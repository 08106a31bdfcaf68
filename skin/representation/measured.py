"""Readings above their idle level, and what one would measure on the window."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from skin.recording import Touches
from skin.representation.base import AbstractRepresentation, Frames, channels
from skin.signal.features import measurements

_IDLE = 8


class Measured(AbstractRepresentation):
    """Shows every sensor's excess over its idle level twice, and adds engineered measurements as a summary.

    What a boosted tree is told, a network is told too, beside the readings. The idle level of a sensor, the
    mean of its eight lowest frames, is subtracted: a constant offset, which is another one in every device,
    then cannot be learnt by heart. The second view is logarithmic, so that faint touches are seen.

    Args:
        positions: (S, 3), m; the measurements need them.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; the linear view is divided by it.
        finest: N; the logarithmic view asinh(x / finest) is linear below it.
        mask: append one feature per sensor that tells whether its reading is valid.
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
        summary = torch.stack([value.to(raw) for value in measurements(touches).values()], dim=1)
        return Frames(torch.cat(views, dim=-1), None, summary.asinh())
