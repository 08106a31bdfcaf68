"""Trained networks as one torch module from readings to probabilities."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from skin.representation.base import AbstractRepresentation

if TYPE_CHECKING:
    from skin.classifier import TouchClassifier


class Pipeline(nn.Module):
    """The representation of one layout and a classifier."""

    def __init__(self, representation: AbstractRepresentation, classifier: "TouchClassifier") -> None:
        super().__init__()
        self.representation, self.task = representation, classifier.task
        # Not the LightningModule itself, whose properties need a trainer.
        self.fusion, self.summary, self.head = classifier.fusion, classifier.summary, classifier.head

    def forward(self, readings: Tensor, valid: Tensor) -> Tensor:
        """Return probabilities (B, L) of readings (B, T, S), N, and valid (B, T, S), bool."""
        from skin.classifier import probabilities

        frames = self.representation(readings, valid)
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
