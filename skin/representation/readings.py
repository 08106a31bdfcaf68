"""Readings as they are, one feature per sensor."""

from typing import ClassVar, Literal

from torch import Tensor

from skin.representation.base import AbstractRepresentation, Frames, channels


class Readings(AbstractRepresentation):
    """Keeps the readings as a vector: the sensors keep their identity, their places are not told.

    The strongest choice on one fixed layout, and of no use on another one.

    Args:
        positions: (S, 3), m; only their number matters.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; readings are divided by it (the clip of the report's sensors is 10 N).
        mask: append one feature per sensor that tells whether its reading is valid.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"

    def __init__(
        self, positions: Tensor, size: tuple[float, float], scale: float = 10.0, mask: bool = False
    ) -> None:
        super().__init__()
        self.scale, self.mask = scale, mask

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, S), or (B, T, 2 S) with the mask, of readings (B, T, S), N."""
        return Frames(channels(readings, valid, self.scale, self.mask).mT.flatten(2), None)
