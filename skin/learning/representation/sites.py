"""Readings averaged onto virtual sites: the same input for any number and order of sensors."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge, MinLen
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor
from torch.nn.functional import pad

from skin.body.sensors import GEOMETRY
from skin.core.settings import checked
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.features import engineered_features
from skin.learning.representation.base import AbstractRepresentation, Frames

_IDLE = 8  # frames
_LEAST = 1e-3  # N and m, smallest response and extent to divide by
_COVERED = 1e-6
_COUNTING = (
    "raw sensor maximum",
    "sensor sum",
    "longest run of the sum",
)  # change with the number of dead sensors
_X, _Y, _WIDTH, _HEIGHT, _DIRECT = (
    GEOMETRY.index(name) for name in ("x", "y", "width", "height", "response_0mm")
)


@checked("representation")
class Sites(AbstractRepresentation):
    """Averages readings onto a grid of virtual sites and gives the largest ones in order.

    The input of a network does not depend on the number and the order of the sensors, and a sensor that is
    not valid has no effect. The weights of an average depend on the distance from sensor to site, relative
    to the extent of the surface. Readings are above their idle level (the mean of the eight lowest frames),
    and on three scales: linear, logarithmic, and logarithmic relative to the sensor's own response to a
    fingertip. Each skin is described by the geometry of its touches (:data:`skin.device.touches.GEOMETRY`),
    so the representation applies to any layout and body.

    Args:
        positions: not used.
        size: not used.
        sites: rows and columns of the grid.
        spreads: standard deviations of the Gaussian weights, as shares of width and height.
        strongest: number of the largest readings.
        scale: N; readings on the linear scale are divided by it.
        finest: N; the logarithmic scales are linear below it.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "readings"
    windowed: ClassVar[bool] = True
    layout_free: ClassVar[bool] = True
    centres: Tensor

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        sites: tuple[PositiveInt, PositiveInt] = (6, 6),
        spreads: Annotated[Sequence[PositiveFloat], MinLen(1)] = (0.08, 0.16, 0.32),
        strongest: Annotated[int, Ge(1)] = 10,
        scale: PositiveFloat = 3.0,
        finest: PositiveFloat = 0.2,
    ) -> None:
        super().__init__()
        y, x = ((torch.arange(count) + 0.5) / count for count in sites)
        self.register_buffer(
            "centres", torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)
        )
        self.spreads, self.strongest = tuple(spreads), strongest
        self.scale, self.finest = scale, finest

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Refuse readings without geometry.

        Raises:
            InputError: always.
        """
        raise _no_geometry()

    def show(self, touches: Touches) -> Frames:
        """Return frames (B, T, F) and a summary of the skin (B, D).

        Raises:
            InputError: the geometry of the sensors is not known.
        """
        if touches.geometry is None:
            raise _no_geometry()
        batch, _, sensors = touches.readings.shape
        geometry = touches.geometry.expand(batch, sensors, len(GEOMETRY))
        values = self._scaled(touches, geometry)
        weights = self._weights(geometry)
        works = touches.valid.to(values)
        shares = torch.einsum("bvs,bts->btv", weights, works)
        means = torch.einsum("bvs,btsc->btvc", weights, values) / (shares + _COVERED)[..., None]
        sums = values[..., 0].sum(2, keepdim=True)
        order = [self._largest(values[..., channel], touches.valid) for channel in (1, 2)]
        x = torch.cat([means.flatten(2), *order, sums, sums.asinh()], dim=-1)
        summary = torch.cat([self._summary(geometry, works, shares), _engineered(touches)], dim=1)
        return Frames(x, None, summary)

    def _scaled(self, touches: Touches, geometry: Tensor) -> Tensor:
        """Return readings above idle on three scales, and whether they are at their limit, (B, T, S, 4)."""
        raw = torch.where(touches.valid, touches.readings, touches.readings.new_zeros(()))
        idle = raw.topk(min(_IDLE, raw.shape[1]), dim=1, largest=False).values.mean(dim=1, keepdim=True)
        excess = (raw - idle) * touches.valid
        direct = geometry[..., _DIRECT].clamp(min=_LEAST)[:, None]
        limited = (
            touches.valid & touches.saturated
            if touches.saturated is not None
            else torch.zeros_like(touches.valid)
        )
        views = [
            excess / self.scale,
            torch.asinh(excess / self.finest) / 2,
            torch.asinh(excess / direct) / 2,
            limited.to(excess),
        ]
        return torch.stack(views, dim=-1)

    def _weights(self, geometry: Tensor) -> Tensor:
        """Return the weight of each sensor at each site for each spread, (B, V, S)."""
        # sensors that fill up a small skin have no extent
        places = geometry[..., [_X, _Y]] / geometry[..., [_WIDTH, _HEIGHT]].clamp(min=_LEAST)
        squares = (self.centres[:, None] - places[:, None]).square().sum(-1)
        return torch.cat([(-squares / (2 * spread**2)).exp() for spread in self.spreads], dim=1)

    def _largest(self, values: Tensor, valid: Tensor) -> Tensor:
        """Return the largest values of working sensors, (B, T, strongest), 0 where there are fewer."""
        working = values.masked_fill(~valid, -torch.inf)
        strongest = working.topk(min(self.strongest, values.shape[2]), dim=2).values
        return pad(strongest.masked_fill(strongest.isinf(), 0), (0, self.strongest - strongest.shape[2]))

    def _summary(self, geometry: Tensor, works: Tensor, shares: Tensor) -> Tensor:
        """Return number and mean, least and largest geometry of working sensors, and coverage, (B, D)."""
        alive = (works > 0).any(dim=1)[..., None]
        count = alive.sum(1).clamp(min=1)
        mean = (geometry * alive).sum(1) / count
        least = geometry.masked_fill(~alive, torch.inf).amin(1)
        most = geometry.masked_fill(~alive, -torch.inf).amax(1)
        columns = [mean, least, most]
        finite = [torch.where(column.isfinite(), column, 0) for column in columns]
        return torch.cat([count.to(mean).log(), *finite, (shares.amax(1) + 1e-3).log()], dim=1)


def _engineered(touches: Touches) -> Tensor:
    """Return the engineered features that a dead sensor does not change, (B, D), as asinh."""
    features = engineered_features(touches)
    selected = [value for name, value in features.items() if not name.startswith(_COUNTING)]
    return torch.stack([value.to(touches.readings) for value in selected], dim=1).asinh()


def _no_geometry() -> InputError:
    return InputError(
        "representation=sites needs to know what each sensor responds to, and this device has no mechanics: "
        "use device=simulated, recording or serial, or another representation"
    )
