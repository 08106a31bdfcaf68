"""Plain readings, one feature per sensor."""

from typing import ClassVar, Literal

from torch import Tensor

from skin.learning.representation.base import AbstractRepresentation, Frames, channels


class Readings(AbstractRepresentation):
    """Returns the readings as a vector with one feature per sensor, without positions.

    It is the most accurate representation for one fixed layout, and does not apply to another layout.

    Args:
        positions: (S, 3), m; only their number matters.
        size: extent (x, y) of the sheet, m; not used.
        scale: N; readings are divided by it (the clip of the report's sensors is 10 N).
        mask: append one feature per sensor that is 1 where its reading is not valid.
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
