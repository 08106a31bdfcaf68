"""The pressure of a fingertip, differentiable in its place, radius and force."""

import math

import torch
from torch import Tensor

from skin.body.base import AbstractBody

PARAMETERS = ("x", "y", "radius", "force")
"""What a fingertip is described by, m, m, m, N, in the order of the last axis."""


class Fingertip:
    """Pressure of discs with a soft rim on the cells of a body.

    The pressure at a distance d from the centre is proportional to 1 / (1 + exp((d - radius) / rim)). A cell
    has the mean of samples that are at most two rims apart. The part of a disc beyond the edge of the body is
    cut off, and the rest carries the whole force.

    Args:
        body: what is touched; distances are those of its chart.
        rim: m, over which the pressure falls by about a quarter of its maximum.
    """

    def __init__(self, body: AbstractBody, rim: float) -> None:
        self._shape, self._rim = body.shape, rim
        self._area = math.prod(body.cell)
        x, y = (_samples(count, cell, rim) for count, cell in zip(body.cells, body.cell, strict=True))
        self._x, self._y = x, y

    def __call__(self, touches: Tensor) -> Tensor:
        """Return the pressure (B, H, W), Pa, of touches (B, 4) as in :data:`PARAMETERS`, in their dtype."""
        x, y, radius, force = touches[:, :, None, None].unbind(1)
        across, down = self._x.to(touches) - x, self._y.to(touches)[:, None] - y
        # The root of 0 has no derivative; a micrometre changes nothing.
        distance = (across.square() + down.square() + 1e-12).sqrt()
        share = torch.sigmoid((radius - distance) / self._rim)
        height, width = self._shape
        cells = share.unflatten(1, (height, -1)).unflatten(3, (width, -1)).mean((2, 4))
        return force * cells / (self._area * cells.sum((1, 2), keepdim=True))


def _samples(count: int, cell: float, rim: float) -> Tensor:
    """Return sample points along an axis, m: equally many in each cell."""
    each = max(1, math.ceil(cell / (2 * rim)))
    return (torch.arange(count * each, dtype=torch.float64) + 0.5) * (cell / each)
