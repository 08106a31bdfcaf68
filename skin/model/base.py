"""What a model is: an encoder of frames that knows nothing of time."""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

from torch import Tensor, nn

from skin.errors import InputError

Kind = Literal["image", "graph", "readings"]


class AbstractModel(nn.Module, ABC):
    """Encodes frames one by one; how they follow each other is the matter of ``fusion``.

    Built as ``cls(kind, shape, **options)`` with the kind of frame and the shape of one frame, both known
    from the representation only.

    Args:
        kind: what the representation yields.

    Attributes:
        takes: the kind of frame that the model can encode.
        width: E, the width of the embedding.

    Raises:
        InputError: the model does not take this kind.
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
            adjacency: (S, S) or (N, S, S), normalised; None where there is no graph.
        """
