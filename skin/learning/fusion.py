"""Fusions: how the embeddings of the frames of a window become one."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from skin.core.settings import checked
from skin.errors import InputError
from skin.learning.model import AbstractModel, Kind, Reduced, encoder
from skin.learning.representation import Frames

MakeModel = Callable[[Kind, Sequence[int]], AbstractModel]
"""A model without the arguments that the data decide: kind and shape."""


class AbstractFusion(nn.Module, ABC):
    """Computes one embedding of a window of frames.

    Built as ``cls(model, kind, shape, window, **options)``: the model without its shapes, the kind of
    representation, the shape of one frame and the number of frames.

    Attributes:
        width: E, the width of the embedding.
    """

    width: int

    @staticmethod
    def common(adjacency: Tensor | None) -> Tensor | None:
        """Return the graph that all frames share, (S, S), if there is one.

        Raises:
            InputError: each frame has its own graph.
        """
        if adjacency is not None and adjacency.ndim > 2:
            raise InputError("one graph per frame needs fusion=late, or representation.positions=layout")
        return adjacency

    @abstractmethod
    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows.

        Raises:
            InputError: the length of the window does not fit the weights.
        """


# Time as channels.


class Early(AbstractFusion):
    """Stacks the frames as channels of one image or as features of one graph (report, 3.2.2 and 3.2.3).

    It is fast, because the model runs once per window. Each frame has its own weights, so the length of the
    window is fixed, and the model is not invariant to shifts in time.

    Args:
        model: without its shapes.
        kind: kind of representation.
        shape: of one frame: (C, H, W), (S, F) or (F,).
        window: number of frames.
    """

    def __init__(self, model: MakeModel, kind: Kind, shape: Sequence[int], window: int) -> None:
        super().__init__()
        stacked = (shape[0], window * shape[1]) if kind == "graph" else (window * shape[0], *shape[1:])
        self.kind, self.window = kind, window
        self.model = model(kind, stacked)
        self.width = self.model.width

    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows of the length given at construction."""
        x, adjacency = frames.x, self.common(frames.adjacency)
        if x.shape[1] != self.window:
            raise InputError(
                f"fusion=early is made for windows of {self.window} frames, got {x.shape[1]}: "
                "train with fusion=late, which takes any length"
            )
        stacked = x.transpose(1, 2).flatten(2) if self.kind == "graph" else x.flatten(1, 2)
        return self.model(stacked, adjacency)


# All frames as one graph with edges in time.


def link(adjacency: Tensor, window: int) -> Tensor:
    """Return the normalised adjacency (T S, T S) of a graph that holds one copy of a sensor graph per frame.

    Every sensor has an edge of weight 1 (as at distance 0) to itself in the following frame, directed: row
    (t, s) gathers from (t - 1, s). Normalised with the rows' sums D as D^-1/2 (A + I) D^-1/2.

    Args:
        adjacency: (S, S), normalised with self-loops of weight 1.
        window: T, number of frames.
    """
    sensors = len(adjacency)
    degree = 1 / adjacency.diagonal()  # since the self-loops have weight 1
    within = adjacency * (degree[:, None] * degree).sqrt()
    big = torch.block_diag(*[within] * window)
    later = torch.arange(sensors, window * sensors, device=adjacency.device)
    big[later, later - sensors] = 1
    root = big.sum(dim=1).sqrt()
    return big / (root[:, None] * root)


class Linked(AbstractFusion):
    """Connects each sensor to itself in the following frame and encodes one graph (report, 3.2.1).

    Accepts windows of any length. Information moves one frame per convolution, so a shallow network has a
    small receptive field in time.

    Args:
        model: without its shapes.
        kind: must be ``graph``.
        shape: of one frame: (S, F).
        window: number of frames; any other length is accepted too.

    Raises:
        InputError: not a graph.
    """

    def __init__(self, model: MakeModel, kind: Kind, shape: Sequence[int], window: int) -> None:
        super().__init__()
        if kind != "graph":
            raise InputError(
                f"fusion=linked needs representation=graph, got {kind}: add representation=graph model=gcn"
            )
        self.model = model(kind, (window * shape[0], shape[1]))
        self.width = self.model.width

    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows of any length."""
        x, adjacency = frames.x, self.common(frames.adjacency)
        assert adjacency is not None  # of a graph
        return self.model(x.flatten(1, 2), link(adjacency, x.shape[1]))


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
    """The last state of a recurrent layer.

    With attention the mean of its states, weighted by a softmax over a learned score of each.
    """

    def __init__(self, layer: type[nn.GRU | nn.LSTM], width: int, hidden: int, attention: bool) -> None:
        super().__init__()
        self.layer = layer(width, hidden, batch_first=True)
        self.score = nn.Linear(hidden, 1) if attention else None
        self.width = hidden

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, hidden) of x (B, T, E)."""
        states = self.layer(x)[0]
        if self.score is None:
            return states[:, -1]
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
    "lstm": partial(Recurrent, nn.LSTM, attention=False),
    "gru": partial(Recurrent, nn.GRU, attention=False),
    "attention+gru": partial(Recurrent, nn.GRU, attention=True),
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
