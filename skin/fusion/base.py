"""What a fusion is: it folds time, so that a model need not know of it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from torch import Tensor, nn

from skin.errors import InputError
from skin.model.base import AbstractModel, Kind
from skin.representation.base import Frames


class MakeModel(Protocol):
    """A model short of what the data decide."""

    def __call__(self, kind: Kind, shape: Sequence[int]) -> AbstractModel: ...


class AbstractFusion(nn.Module, ABC):
    """Makes one embedding of a window of frames.

    Built as ``cls(model, kind, shape, window, **options)``: the model short of its shapes, what the
    representation yields, the shape of one frame and the number of frames.

    Attributes:
        width: E, the width of the embedding.
    """

    width: int

    @staticmethod
    def common(adjacency: Tensor | None) -> Tensor | None:
        """Return the graph of all frames, (S, S), if there is one.

        Raises:
            InputError: every frame has its own.
        """
        if adjacency is not None and adjacency.ndim > 2:
            raise InputError("one graph per frame needs fusion=late, or representation.positions=layout")
        return adjacency

    @abstractmethod
    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows.

        Raises:
            InputError: the window has another length than the weights are made for.
        """
