"""The interface of representations: batched maps from readings to the input of a network."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from skin.device.touches import Touches


class Frames(NamedTuple):
    """The input of a network.

    Attributes:
        x: images (B, T, C, H, W), graphs (B, T, S, F), plain readings (B, T, F).
        adjacency: (S, S) or (B, T, S, S), dense, normalised; None without a graph.
        summary: (B, D), features of the whole window for the dense layers; None if there are none.
    """

    x: Tensor
    adjacency: Tensor | None
    summary: Tensor | None = None


class AbstractRepresentation(nn.Module, ABC):
    """Maps readings (B, T, S) in N with their validity to :class:`Frames`.

    Built for one layout: ``cls(positions, size, **options)`` with positions (S, 3), m, and the sheet's size
    (x, y), m. Readings are divided by ``scale``, N; invalid ones become 0.

    Attributes:
        kind: kind of input that a model must accept: images, graphs or plain readings.
        windowed: whether a frame depends on the other frames of its window.
        layout_free: whether one representation applies to touches of any layout.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]]
    windowed: ClassVar[bool] = False
    layout_free: ClassVar[bool] = False

    @abstractmethod
    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return the frames of readings (B, T, S), N, and valid (B, T, S), bool."""

    def show(self, touches: Touches) -> Frames:
        """Return the frames of touches; by default of their readings only."""
        return self(touches.readings, touches.valid)


def channels(readings: Tensor, valid: Tensor, scale: float, mask: bool) -> Tensor:
    """Return scaled readings and, optionally, a mask: the common input of all representations.

    Args:
        readings: (B, T, S), N.
        valid: (B, T, S), bool; a reading that is not valid becomes 0, also if it is NaN.
        scale: N; readings are divided by it.
        mask: append a channel that is 1 where the reading is not valid. It is 0 for valid readings, because
            a constant channel of ones is large beside small readings (docs/results/dead.csv).

    Returns:
        (B, T, S, C), with C = 2 under ``mask`` and else 1.
    """
    values = torch.where(valid, readings / scale, readings.new_zeros(()))
    return torch.stack([values, (~valid).to(values.dtype)] if mask else [values], dim=-1)
