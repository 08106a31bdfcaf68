"""What a representation is: a batched map from readings to what a network takes."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from skin.recording import Touches


class Frames(NamedTuple):
    """Touches as a network takes them.

    Attributes:
        x: images (B, T, C, H, W), graphs (B, T, S, F), plain readings (B, T, F).
        adjacency: (S, S) or (B, T, S, S), dense, normalised; None where there is no graph.
        summary: (B, D), numbers about the whole window, which go to the dense layers; None where the
            representation gives none.
    """

    x: Tensor
    adjacency: Tensor | None
    summary: Tensor | None = None


class AbstractRepresentation(nn.Module, ABC):
    """Maps readings (B, T, S) in N with their validity to :class:`Frames`.

    Built for one layout: ``cls(positions, size, **options)`` with positions (S, 3), m, and the sheet's size
    (x, y), m. Readings are divided by ``scale``, N; invalid ones become 0.

    Attributes:
        kind: what a model must take: images, graphs or plain readings.
        windowed: whether what a frame shows depends on the other frames of its window.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]]
    windowed: ClassVar[bool] = False

    @abstractmethod
    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return the frames of readings (B, T, S), N, and valid (B, T, S), bool."""

    def show(self, touches: Touches) -> Frames:
        """Return the frames of touches; what a touch tells beyond its readings is left aside."""
        return self(touches.readings, touches.valid)


def channels(readings: Tensor, valid: Tensor, scale: float, mask: bool) -> Tensor:
    """Return what every representation starts from.

    Args:
        readings: (B, T, S), N.
        valid: (B, T, S), bool; a reading that is not valid becomes 0, whatever it holds (NaN too).
        scale: N; readings are divided by it.
        mask: append a channel that is 1 where the reading means nothing, so that it is silent where all is
            well: a channel of ones beside small readings drowns them (docs/results/dead.csv).

    Returns:
        (B, T, S, C), with C = 2 under ``mask`` and else 1.
    """
    values = torch.where(valid, readings / scale, readings.new_zeros(()))
    return torch.stack([values, (~valid).to(values.dtype)] if mask else [values], dim=-1)
