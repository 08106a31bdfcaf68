"""The interface of models: encoders of single frames."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from skin.errors import InputError

Kind = Literal["image", "graph", "readings"]


class AbstractModel(nn.Module, ABC):
    """Encodes single frames; the fusion combines them over time.

    Built as ``cls(kind, shape, **options)`` with the kind and the shape of one frame, which the
    representation decides.

    Args:
        kind: kind of representation.

    Attributes:
        takes: the kind of frame that the model encodes.
        width: E, the width of the embedding.

    Raises:
        InputError: the model does not accept this kind.
    """

    takes: ClassVar[Kind]
    width: int

    def __init__(self, kind: Kind) -> None:
        super().__init__()
        if kind != self.takes:
            name = type(self).__module__.rpartition(".")[2]
            raise InputError(
                f"model={name} needs representation={self.takes}, got {kind}: add representation={self.takes}"
            )

    @abstractmethod
    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of frames.

        Args:
            x: images (N, C, H, W), graphs (N, S, F) or readings (N, F).
            adjacency: (S, S) or (N, S, S), normalised; None without a graph.
        """


# The activations that the report compares, by name.


def activation(name: str) -> nn.Module:
    """Return relu, elu or silu as a module.

    Raises:
        InputError: another name.
    """
    activations = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
    if name not in activations:
        raise InputError(f"unknown activation {name!r}: set activation=relu, elu or silu")
    return activations[name]()


# The transformer encoder that models and heads over time share.


def encoder(
    width: int, heads: int, layers: int, feedforward: int, dropout: float, setting: str
) -> nn.TransformerEncoder:
    """Return layers of self-attention (Vaswani et al., 2017) on (N, tokens, width), normed before each part.

    Normed before (Xiong et al., 2020), so that it trains with Adam at 1e-3 without a warm-up.

    Args:
        width: of a token.
        heads: of attention in each layer; they share the width.
        layers: their number.
        feedforward: width of the hidden layer in each of them.
        dropout: share of values dropped in training.
        setting: the override that sets the width, named where it does not fit.

    Raises:
        InputError: a width that the heads cannot share.
    """
    if width % heads:
        raise InputError(
            f"{heads} heads of attention must share the width equally, got {setting}={width}: "
            f"set {setting}={-(-width // heads) * heads}"
        )
    layer = nn.TransformerEncoderLayer(
        width, heads, feedforward, dropout, activation="gelu", batch_first=True, norm_first=True
    )
    result = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
    for parameter in result.parameters():
        if parameter.ndim > 1:  # torch copies the first layer: without this all would start the same
            nn.init.xavier_uniform_(parameter)
    return result


# Poolings of the nodes of a graph to one vector. PyTorch Geometric's take 2.9 (max), 1.0 to 1.5 (mean), 1.1
# to 1.2 (attention) and 1.0 to 1.3 (set2set) times as long, and 0.7 s to import.

Pooling = Literal["max", "mean", "attention", "set2set"]

STEPS = 3  # of Set2Set


class Reduced(nn.Module):
    """A reduction over one dimension, such as ``torch.amax``, without weights.

    Args:
        width: E, of the last dimension.
        reduce: as ``torch.amax``.
        dim: the dimension.
    """

    def __init__(self, width: int, reduce: Callable[..., Tensor], dim: int) -> None:
        super().__init__()
        self.width, self._reduce, self._dim = width, reduce, dim

    def forward(self, x: Tensor) -> Tensor:
        """Return x without the dimension."""
        return self._reduce(x, dim=self._dim)


class Attention(nn.Module):
    """Global attention pooling: the mean of the nodes, weighted by a softmax over a learned gate."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, 1)
        self.width = width

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, E) of nodes x (S, N, E)."""
        share = self.gate(x).softmax(dim=0)
        return torch.bmm(share.permute(1, 2, 0), x.transpose(0, 1)).squeeze(1)


class Set2Set(nn.Module):
    """A recurrent query that reads the nodes by attention, step after step (Vinyals et al., 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.lstm = nn.LSTMCell(2 * width, width)
        self.width = 2 * width

    def forward(self, x: Tensor) -> Tensor:
        """Return the last query and what it read, (N, 2 E), of nodes x (S, N, E)."""
        nodes = x.transpose(0, 1)
        query = memory = x.new_zeros(x.shape[1:])
        read = query
        for _ in range(STEPS):
            query, memory = self.lstm(torch.cat([query, read], dim=-1), (query, memory))
            share = torch.bmm(nodes, query[:, :, None]).softmax(dim=1)
            read = torch.bmm(share.mT, nodes).squeeze(1)
        return torch.cat([query, read], dim=-1)


POOLINGS: dict[Pooling, Callable[[int], nn.Module]] = {
    "max": partial(Reduced, reduce=torch.amax, dim=0),
    "mean": partial(Reduced, reduce=torch.mean, dim=0),
    "attention": Attention,
    "set2set": Set2Set,
}
"""Name -> function of E that returns a module (S, N, E) -> (N, ``module.width``)."""
