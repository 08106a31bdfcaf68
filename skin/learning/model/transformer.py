"""A transformer over the sensors."""

from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import PositiveInt
from torch import Tensor, nn

from skin.core.settings import checked
from skin.learning.model.base import AbstractModel, Kind, encoder

Pooling = Literal["mean", "max"]


@checked("model")
class Transformer(AbstractModel):
    """Self-attention between all sensors, and a pooling over them (report, section 3.2.2).

    Accepts any layout and number of sensors with the same weights. It does not use the edges of the graph.
    Add ``representation.coordinates=true`` to give it the positions.

    Args:
        kind: must be ``graph``.
        shape: (S, F).
        width: of a sensor's token and of the embedding.
        layers: number of encoder layers.
        heads: of attention in each layer; they share the width.
        feedforward: width of the hidden layer in each encoder layer.
        dropout: share of values dropped in training, as everywhere in torch's encoder layer.
        pooling: over the sensors: mean or max.

    Raises:
        InputError: not a graph, an unknown pooling, or a width that the heads cannot share.
    """

    takes: ClassVar[Kind] = "graph"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        width: PositiveInt = 64,
        layers: PositiveInt = 2,
        heads: PositiveInt = 4,
        feedforward: PositiveInt = 128,
        dropout: float = 0.1,
        pooling: Pooling = "mean",
    ) -> None:
        super().__init__(kind)
        self.tokens = nn.Linear(shape[-1], width)
        self.encoder = encoder(width, heads, layers, feedforward, dropout, "model.width")
        self.pooling, self.width = pooling, width

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of graphs x (N, S, F); the adjacency is not used."""
        tokens = self.encoder(self.tokens(x))
        return tokens.amax(dim=1) if self.pooling == "max" else tokens.mean(dim=1)
