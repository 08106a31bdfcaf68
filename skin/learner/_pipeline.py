"""Trained networks as one torch module from readings to probabilities."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from skin.recording import Touches
from skin.representation.base import AbstractRepresentation

if TYPE_CHECKING:
    from skin.classifier import TouchClassifier


class Pipeline(nn.Module):
    """The representation of one layout and a classifier.

    Args:
        representation: of the layout.
        classifier: trained.
        positions: (S, 3), m.
        geometry: (S, G) of the sensors (:data:`skin.recording.GEOMETRY`); None if not needed.
    """

    positions: Tensor
    geometry: Tensor | None

    def __init__(
        self,
        representation: AbstractRepresentation,
        classifier: "TouchClassifier",
        positions: Tensor,
        geometry: Tensor | None,
    ) -> None:
        super().__init__()
        self.representation, self.task = representation, classifier.task
        self.register_buffer("positions", positions)
        self.register_buffer("geometry", geometry)
        # Not the LightningModule itself, whose properties need a trainer.
        self.fusion, self.summary, self.head = classifier.fusion, classifier.summary, classifier.head

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""
        from skin.classifier import probabilities

        touches = Touches(readings, valid, self.positions, None, 1.0, geometry=self.geometry)
        frames = self.representation.show(touches)
        embedding = self.fusion(frames)
        if self.summary is not None:
            embedding = torch.cat([embedding, self.summary(frames.summary)], dim=1)
        return probabilities(self.head(embedding), self.task)


class Mean(nn.Module):
    """The mean of several pipelines."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""
        return torch.stack([member(readings, valid) for member in self.members]).mean(dim=0)
