"""Time as channels."""

from collections.abc import Sequence

from torch import Tensor

from skin.errors import InputError
from skin.learning.fusion.base import AbstractFusion, MakeModel
from skin.learning.model.base import Kind
from skin.learning.representation.base import Frames


class Early(AbstractFusion):
    """Stacks the frames as channels of one image or as features of one graph (report, 3.2.2 and 3.2.3).

    It is fast, because the model runs once per window. Each frame has its own weights, so the length of the
    window is fixed, and the model is not invariant to shifts in time.

    Args:
        model: without its shapes.
        kind: kind of representation.
        shape: of one frame: (C, H, W), (S, F) or (F,).
        window: number of frames.
    """

    def __init__(self, model: MakeModel, kind: Kind, shape: Sequence[int], window: int) -> None:
        super().__init__()
        stacked = (shape[0], window * shape[1]) if kind == "graph" else (window * shape[0], *shape[1:])
        self.kind, self.window = kind, window
        self.model = model(kind, stacked)
        self.width = self.model.width

    def forward(self, frames: Frames) -> Tensor:
        """Return the embeddings (B, E) of windows of the length given at construction."""
        x, adjacency = frames.x, self.common(frames.adjacency)
        if x.shape[1] != self.window:
            raise InputError(
                f"fusion=early is made for windows of {self.window} frames, got {x.shape[1]}: "
                "train with fusion=late, which takes any length"
            )
        stacked = x.transpose(1, 2).flatten(2) if self.kind == "graph" else x.flatten(1, 2)
        return self.model(stacked, adjacency)
