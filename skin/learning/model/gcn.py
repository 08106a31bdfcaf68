"""A graph convolutional network on the graph of sensors."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import MinLen
from pydantic import PositiveInt
from torch import Tensor, nn

from skin.core.settings import checked
from skin.learning.model.base import POOLINGS, AbstractModel, Kind, Pooling
from skin.learning.model.base import activation as activation_of

Norm = Literal["none", "layer", "batch", "instance"]


class _Convolution(nn.Module):
    """One graph convolution A x W + b (Kipf and Welling, 2017).

    One matrix, normalised once, serves all frames in one product. 1.5 to 3.0 times as fast as PyTorch
    Geometric's DenseGCNConv, 4 to 80 times as its GCNConv.
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


@checked("model")
class Gcn(AbstractModel):
    """Graph convolutions and a pooling over the nodes (report, sections 3.2.1, 3.2.2 and 3.2.4).

    Accepts any layout and number of sensors with the same weights.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        widths: of the graph convolutions; the last one is the embedding.
        activation: relu, elu or silu, after every convolution.
        norm: between convolutions: none, layer (over the features of a node), batch (over all nodes of all
            graphs) or instance (over the nodes of each graph).
        pooling: over the nodes. max (the report's choice for temporal_graph: many sensors are idle), mean,
            attention (its choice for sequence_graph) or set2set, which doubles the width of the embedding.

    Raises:
        InputError: not a graph, no layer, or an unknown option.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        widths: Annotated[Sequence[PositiveInt], MinLen(1)] = (32, 128),
        activation: str = "silu",
        norm: Norm = "none",
        pooling: Pooling = "max",
    ) -> None:
        super().__init__(kind)
        sizes = [shape[-1], *widths]
        self.convolutions = nn.ModuleList(_Convolution(*pair) for pair in pairwise(sizes))
        self.activation = activation_of(activation)
        self.norms = nn.ModuleList(_NORMS[norm](width) for width in widths[:-1])
        self.pooling = POOLINGS[pooling](sizes[-1])
        self.width = int(self.pooling.width)  # type: ignore[arg-type]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F) with their adjacency."""
        if adjacency is None:
            raise ValueError("a graph needs its adjacency, got None")
        nodes = x.transpose(0, 1).contiguous()  # nodes first: mixing them is then one product for all graphs
        for convolution, norm in zip(self.convolutions, [*self.norms, nn.Identity()], strict=True):
            nodes = self.activation(norm(convolution(nodes, adjacency)))
        return self.pooling(nodes)


class _BatchNorm(nn.BatchNorm1d):
    """Batch norm over the last axis of nodes (S, N, F)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.flatten(0, 1)).view_as(x)


class _InstanceNorm(nn.Module):
    """Instance norm (Ulyanov et al., 2016): over its nodes each feature of a graph has mean 0 and spread 1.

    Not torch's, which refuses a graph of one node.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Return nodes (S, N, F) of nodes x (S, N, F)."""
        variance, mean = torch.var_mean(x, dim=0, correction=0)
        return (x - mean) * (variance + 1e-5).rsqrt() * self.weight + self.bias


_NORMS: dict[Norm, Callable[[int], nn.Module]] = {
    "none": nn.Identity,
    "layer": nn.LayerNorm,
    "batch": _BatchNorm,
    "instance": _InstanceNorm,
}
