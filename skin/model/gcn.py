"""A graph convolutional network on the graph of sensors."""

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from skin.errors import InputError
from skin.model._activation import activation as activation_of
from skin.model.base import AbstractModel, Kind

__all__ = ["Gcn"]

Pooling = Literal["max", "mean", "attention"]
Norm = Literal["none", "layer", "batch"]


class _Convolution(nn.Module):
    """One graph convolution A x W + b (Kipf and Welling, 2017).

    Not PyTorch Geometric's DenseGCNConv: that copies and normalises the adjacency of every graph at every
    call, while here one matrix, normalised once, serves all frames in one product.
    """

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(features, width, bias=False)
        self.bias = nn.Parameter(torch.zeros(width))
        nn.init.xavier_uniform_(self.linear.weight)

    def forward(self, x: Tensor, adjacency: Tensor) -> Tensor:
        """Return nodes (S, N, width) of nodes x (S, N, features) and adjacency (S, S) or (N, S, S)."""
        # neighbours are mixed where there are fewer features; (A x) W = A (x W)
        if self.linear.out_features < self.linear.in_features:
            return _mix(adjacency, self.linear(x)) + self.bias
        return nn.functional.linear(_mix(adjacency, x), self.linear.weight, self.bias)


def _mix(adjacency: Tensor, x: Tensor) -> Tensor:
    """Return A x for nodes x (S, N, F): one large product where the graph is common to all."""
    if adjacency.ndim == 2:
        return (adjacency @ x.flatten(1)).view_as(x)
    return torch.einsum("nij,jnf->inf", adjacency, x)


class _Attention(nn.Module):
    """Global attention pooling: the mean of the nodes, weighted by a softmax over a learned gate."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, E) of nodes x (S, N, E)."""
        share = self.gate(x).softmax(dim=0)
        return torch.bmm(share.permute(1, 2, 0), x.transpose(0, 1)).squeeze(1)


class Gcn(AbstractModel):
    """Graph convolutions, then one vector per graph (report, sections 3.2.1, 3.2.2 and 3.2.4).

    Takes any layout and any number of sensors with the same weights.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        widths: of the graph convolutions; the last one is the embedding.
        activation: relu, elu or silu, after every convolution.
        norm: none, layer or batch; over the features, between convolutions.
        pooling: over the nodes. max (the report's choice for temporal_graph: many sensors are idle), mean, or
            attention (its choice for sequence_graph).

    Raises:
        InputError: not a graph, no layer, or an unknown option.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        widths: Sequence[int] = (32, 128),
        activation: str = "silu",
        norm: Norm = "none",
        pooling: Pooling = "max",
    ) -> None:
        super().__init__(kind)
        if not widths:
            raise InputError("model=gcn needs at least one layer, got none: set model.widths=[32,128]")
        sizes = [shape[-1], *widths]
        self.width = sizes[-1]
        self.convolutions = nn.ModuleList(_Convolution(*pair) for pair in pairwise(sizes))
        self.activation = activation_of(activation)
        self.norms = nn.ModuleList(_norm(norm, width) for width in widths[:-1])
        if pooling not in ("max", "mean", "attention"):
            raise InputError(f"unknown pooling {pooling!r}: set model.pooling=max, mean or attention")
        self.pooling = pooling
        self.attention = _Attention(self.width) if pooling == "attention" else None

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F) with their adjacency."""
        if adjacency is None:
            raise ValueError("a graph needs its adjacency, got None")
        nodes = x.transpose(0, 1).contiguous()  # nodes first: mixing them is then one product for all graphs
        for convolution, norm in zip(self.convolutions, [*self.norms, nn.Identity()], strict=True):
            nodes = self.activation(norm(convolution(nodes, adjacency)))
        if self.attention is not None:
            return self.attention(nodes)
        return nodes.amax(dim=0) if self.pooling == "max" else nodes.mean(dim=0)


class _BatchNorm(nn.BatchNorm1d):
    """Batch norm over the last axis of nodes (S, N, F)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.flatten(0, 1)).view_as(x)


def _norm(name: Norm, width: int) -> nn.Module:
    known = {"none": nn.Identity, "layer": nn.LayerNorm, "batch": _BatchNorm}
    if name not in known:
        raise InputError(f"unknown norm {name!r}: set model.norm=none, layer or batch")
    return known[name](width)
