"""Graph networks of PyTorch Geometric."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from pydantic import PositiveInt
from torch import Tensor
from torch_geometric.nn.models.basic_gnn import BasicGNN
from torch_geometric.utils import dense_to_sparse

from skin.errors import InputError
from skin.learning.model import POOLINGS, AbstractModel, Kind, Pooling


class Pyg(AbstractModel):
    """A network of PyTorch Geometric on the graph of sensors, and a pooling over the nodes.

    Accepts any layout and number of sensors with the same weights. Networks with edge weights (GCN) use those
    of the graph; the others use only which sensors are neighbours.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        network: a subclass of ``torch_geometric.nn.models.basic_gnn.BasicGNN`` with settings of its own.
        width: of the hidden layers and the embedding.
        layers: number of convolutions.
        pooling: over the nodes: max, mean, attention, or set2set, which doubles the width of the embedding.
        degree: typical number of neighbours; only PNA uses it.

    Raises:
        InputError: not a graph, an unknown pooling, or settings that the network does not take.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        network: Callable[..., BasicGNN],
        width: PositiveInt = 64,
        layers: PositiveInt = 2,
        pooling: Pooling = "attention",
        degree: PositiveInt = 7,
    ) -> None:
        super().__init__(kind)
        given = network if isinstance(network, partial) else partial(network)
        self._weighted = bool(getattr(given.func, "supports_edge_weight", False))
        # The adjacency is normalised already.
        defaults: dict[str, Any] = {"normalize": False, "add_self_loops": False} if self._weighted else {}
        if "scalers" in given.keywords:
            defaults["deg"] = torch.nn.functional.one_hot(torch.tensor(degree), degree + 1)
        try:
            self.network = network(shape[-1], width, layers, **defaults)
        except (TypeError, ValueError, AssertionError) as error:
            raise InputError(f"model.network refuses its settings: {error}") from error
        self.pooling = POOLINGS[pooling](width)
        self.width = int(self.pooling.width)  # type: ignore[arg-type]

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F) with their adjacency."""
        assert adjacency is not None  # of a graph
        count, sensors, _ = x.shape
        edges, weights = self._edges(adjacency, count)
        extra = {"edge_weight": weights} if self._weighted else {}
        nodes = self.network(x.flatten(0, 1), edges, **extra)
        return self.pooling(nodes.view(count, sensors, -1).transpose(0, 1).contiguous())

    def _edges(self, adjacency: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the edges (2, E) of all graphs as one, and their weights (E,)."""
        if not self._weighted:  # the others count a node itself by themselves
            loops = torch.eye(adjacency.shape[-1], dtype=torch.bool, device=adjacency.device)
            adjacency = adjacency.masked_fill(loops, 0)
        edges, weights = dense_to_sparse(adjacency.contiguous())
        if adjacency.ndim == 3:
            return edges, weights
        offsets = adjacency.shape[-1] * torch.arange(count, device=adjacency.device)
        return (edges[:, None] + offsets[:, None]).flatten(1), weights.repeat(count)
