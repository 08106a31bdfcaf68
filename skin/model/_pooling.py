"""Poolings: modules that reduce the nodes of a graph to one vector.

PyTorch Geometric's aggregations take 2.9 (max), 1.0 to 1.5 (mean), 1.1 to 1.2 (attention) and 1.0 to 1.3
(set2set) times as long as these, and 0.7 s to import.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

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
