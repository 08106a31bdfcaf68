"""A sleeve of silicone layers around a part of an arm."""

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Lt
from pydantic import PositiveFloat

from skin.body.base import AbstractBody
from skin.core.settings import checked
from skin.errors import InputError


@checked("body")
@dataclass(frozen=True)
class Arm(AbstractBody):
    """Layers on a rigid cylinder, over a part of its circumference: a rolled-up sheet (docs/adr/0005).

    The chart is the unrolled outer surface: x runs around the arm, y along it. Distances on the surface are
    those of the chart; below the surface an arc over the same x is shorter. In space y is the axis of the
    arm, and the middle of the sleeve is at the top, along z.

    Attributes:
        radius: of the outer surface, m.
        length: of the sleeve along the arm, m.
        angle: of the sleeve, rad; less than a full turn.
        size: (radius * angle, length), m.
        cells, layers: as in :class:`skin.body.base.AbstractBody`; layers from the core outwards.

    Raises:
        InputError: as in :class:`skin.body.base.AbstractBody`, and a closed sleeve, or layers that are
            thicker than the radius.
    """

    size: tuple[float, float] = field(init=False)
    radius: PositiveFloat = field(kw_only=True)
    length: PositiveFloat = field(kw_only=True)
    angle: Annotated[float, Gt(0), Lt(2 * math.pi)] = field(kw_only=True)

    flat: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", (self.radius * self.angle, self.length))
        super().__post_init__()
        if self.thickness >= self.radius:
            raise InputError(
                f"layers of {self.thickness:g} m together leave no core within "
                f"body.radius={self.radius:g} m: give a larger body.radius or thinner layers"
            )

    def resized(self, size: tuple[float, float]) -> str:
        """Return the overrides that give the sleeve an extent (x, y), m."""
        return f"body.angle={size[0] / self.radius:g} body.length={size[1]:g}"

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) of the chart, m, are in space, (..., 3), m."""
        x, y, depth = np.moveaxis(np.asarray(points, dtype=float), -1, 0)
        turn, radius = self._turn(x), self.radius - depth
        return np.stack([radius * np.sin(turn), y, radius * np.cos(turn)], axis=-1)

    def frame(self, points: np.ndarray) -> np.ndarray:
        """Return the local axes at points (..., 3), (..., 3, 3): around the arm, along it, to its axis."""
        turn = self._turn(np.asarray(points, dtype=float)[..., 0])
        sine, cosine, none = np.sin(turn), np.cos(turn), np.zeros_like(turn)
        around, along, inwards = (cosine, none, -sine), (none, none + 1, none), (-sine, none, -cosine)
        return np.stack([np.stack(axis, axis=-1) for axis in (around, along, inwards)], axis=-2)

    def _turn(self, x: np.ndarray) -> np.ndarray:
        """Return the angle from the middle of the sleeve at a position around it (...,), m, in rad."""
        return x / self.radius - self.angle / 2
