"""A model on each frame, then a head over time."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from skin.core.settings import checked
from skin.learning.fusion.base import AbstractFusion, MakeModel
from skin.learning.model.base import Kind, Reduced, encoder
from skin.learning.representation.base import Frames

# Heads: modules that reduce a sequence of embeddings to one.


Head = Literal["mean", "max", "conv", "lstm", "gru", "attention+gru", "residual", "transformer"]


class Convolution(nn.Module):
    """A convolution over three frames, ReLU, and the maximum over time."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.layer = nn.Conv1d(width, hidden, 3, padding=1)
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        return self.layer(x.mT).relu().amax(dim=-1)


class Recurrent(nn.Module):
    """The last state of a recurrent layer."""

    def __init__(self, layer: nn.GRU | nn.LSTM) -> None:
        super().__init__()
        self.layer = layer
        self.width = layer.hidden_size

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        return self.layer(x)[0][:, -1]


class AttentionGru(nn.Module):
    """The mean of a GRU's states, weighted by a softmax over a learned score of each."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.layer = nn.GRU(width, hidden, batch_first=True)
        self.score = nn.Linear(hidden, 1)
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        states = self.layer(x)[0]
        return (self.score(states).softmax(dim=1) * states).sum(dim=1)


def positions(length: int, width: int) -> Tensor:
    """Return sinusoidal position encodings (length, width) (Vaswani et al., 2017, section 3.5).

    Column 2i of frame t is sin(t / 10000^(2i / width)), column 2i + 1 its cosine; ``width`` is even.
    """
    rates = 10_000 ** (-torch.arange(0, width, 2) / width)
    angles = torch.arange(length)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)


class TransformerHead(nn.Module):
    """Two layers of self-attention over the frames, and the mean over time.

    Position encodings are sinusoidal instead of learned, so that windows of any length are accepted. Three of
    five trainings with Adam at 1e-3 stayed at chance (study ``temporal_head_graph``): use 3e-4, a warm-up.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.tokens = nn.Linear(width, hidden)
        self.encoder = encoder(hidden, 4, 2, 2 * hidden, 0.1, "fusion.hidden")
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        return self.encoder(self.tokens(x) + positions(x.shape[1], self.width).to(x)).mean(dim=1)


class Residual(nn.Module):
    """Four residual convolutions over five frames each; the mean and the maximum over time.

    The receptive field is 19 frames. The output does not depend on the position in the window.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Conv1d(width, hidden, 3, padding=1)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.GroupNorm(1, hidden), nn.GELU(), nn.Conv1d(hidden, hidden, 5, padding=2))
            for _ in range(4)
        )
        self.width = 2 * hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, 2 hidden) of x (B, T, E)."""
        states = self.first(x.mT)
        for block in self.blocks:
            states = states + block(states)
        return torch.cat([states.amax(dim=-1), states.mean(dim=-1)], dim=1)


HEADS: dict[Head, Callable[[int, int], nn.Module]] = {
    "mean": lambda width, hidden: Reduced(width, torch.mean, 1),
    "max": lambda width, hidden: Reduced(width, torch.amax, 1),
    "conv": Convolution,
    "lstm": lambda width, hidden: Recurrent(nn.LSTM(width, hidden, batch_first=True)),
    "gru": lambda width, hidden: Recurrent(nn.GRU(width, hidden, batch_first=True)),
    "attention+gru": AttentionGru,
    "residual": Residual,
    "transformer": TransformerHead,
}
"""Name -> function of E and the hidden width that returns a module (B, T, E) -> (B, ``module.width``)."""


@checked("fusion")
class Late(AbstractFusion):
    """Encodes each frame with the same weights and combines the embeddings (report, 3.2.4 and 3.2.5).

    Accepts windows of any length. The model runs once per frame, so the cost is proportional to the window.

    Args:
        model: without its shapes.
        kind: kind of representation.
        shape: of one frame: (C, H, W), (S, F) or (F,).
        window: number of frames; any other length is accepted too.
        head: over time: mean, max, conv, lstm, gru, attention+gru or transformer.
        hidden: width of the head, where it has weights; of a transformer a multiple of 4.

    Raises:
        InputError: an unknown head, or a width that it cannot have.
    """

    def __init__(
        self,
        model: MakeModel,
        kind: Kind,
        shape: Sequence[int],
        window: int,
        head: Head = "gru",
        hidden: PositiveInt = 64,
    ) -> None:
        super().__init__()
        self.model = model(kind, shape)
        self.head = HEADS[head](self.model.width, hidden)
        self.width = int(self.head.width)  # type: ignore[arg-type]

    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows of any length."""
        x, adjacency = frames.x, frames.adjacency
        if adjacency is not None and adjacency.ndim > 2:
            adjacency = adjacency.flatten(0, 1)
        return self.head(self.model(x.flatten(0, 1), adjacency).unflatten(0, x.shape[:2]))
