"""All frames as one graph with edges in time."""

from collections.abc import Sequence

import torch
from torch import Tensor

from skin.errors import InputError
from skin.learning.fusion.base import AbstractFusion, MakeModel
from skin.learning.model.base import Kind
from skin.learning.representation.base import Frames


def link(adjacency: Tensor, window: int) -> Tensor:
    """Return the normalised adjacency (T S, T S) of a graph that holds one copy of a sensor graph per frame.

    Every sensor has an edge of weight 1 (that of distance 0) to itself in the following frame, directed: row
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
        if adjacency is None:
            raise ValueError("fusion=linked needs a graph, got frames without")
        return self.model(x.flatten(1, 2), link(adjacency, x.shape[1]))
