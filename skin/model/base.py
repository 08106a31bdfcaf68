"""The interface of models: encoders of single frames."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

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
