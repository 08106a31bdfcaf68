"""The interface of fusions, which combine the frames of a window; models process single frames."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from torch import Tensor, nn

from skin.errors import InputError
from skin.learning.model.base import AbstractModel, Kind
from skin.learning.representation.base import Frames


class MakeModel(Protocol):
    """A model without the arguments that the data decide."""

    def __call__(self, kind: Kind, shape: Sequence[int]) -> AbstractModel: ...


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
