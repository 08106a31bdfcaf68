"""A model on each frame, then a head over time."""

from collections.abc import Sequence

from pydantic import PositiveInt
from torch import Tensor

from skin.fusion._heads import HEADS, Head
from skin.fusion.base import AbstractFusion, MakeModel
from skin.model.base import Kind
from skin.representation.base import Frames
from skin.settings import checked


@checked("fusion")
class Late(AbstractFusion):
    """Encodes each frame with the same weights and combines the embeddings (report, 3.2.4 and 3.2.5).

    Accepts windows of any length. The model runs once per frame, so the cost is proportional to the window.

    Args:
        model: without its shapes.
        kind: kind of representation.
        shape: of one frame: (C, H, W), (S, F) or (F,).
        window: number of frames; any other length is accepted too.
        head: over time: mean, max, conv, lstm, gru, attention+gru or transformer.
        hidden: width of the head, where it has weights; of a transformer a multiple of 4.

    Raises:
        InputError: an unknown head, or a width that it cannot have.
    """

    def __init__(
        self,
        model: MakeModel,
        kind: Kind,
        shape: Sequence[int],
        window: int,
        head: Head = "gru",
        hidden: PositiveInt = 64,
    ) -> None:
        super().__init__()
        self.model = model(kind, shape)
        self.head = HEADS[head](self.model.width, hidden)
        self.width = int(self.head.width)  # type: ignore[arg-type]

    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows of any length."""
        x, adjacency = frames.x, frames.adjacency
        if adjacency is not None and adjacency.ndim > 2:
            adjacency = adjacency.flatten(0, 1)
        return self.head(self.model(x.flatten(0, 1), adjacency).unflatten(0, x.shape[:2]))
