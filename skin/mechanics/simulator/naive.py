"""A skin without mechanics: each sensor reads the pressure above it (report, 2.1.1)."""

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody, Sensors
from skin.mechanics.simulator.base import AbstractSimulator, Response, flatten


class Naive(AbstractSimulator):
    """Reads the pressure of the cell of the sensor times the area of its footprint, without mechanics.

    Use it as a baseline for the mechanics, or for a skin too thin to spread a touch.

    Args:
        body: any; only its cells are used.
        sensors: the sensors; a footprint beyond the edge of the body is clipped.

    Raises:
        InputError: a tilted sensor.
    """

    mechanical: ClassVar[bool] = False

    cell: Tensor
    area: Tensor

    def __init__(self, body: AbstractBody, sensors: Sensors) -> None:
        super().__init__()
        self.refuse_tilted(sensors)
        # A sensor on the far edge belongs to the last cell.
        column, row = (
            np.minimum(sensors.positions[:, axis] / body.cell[axis], body.cells[axis] - 1).astype(np.int64)
            for axis in (0, 1)
        )
        self.shape = body.shape
        self.register_buffer("cell", torch.from_numpy(row * body.cells[0] + column))
        area = body.footprint_areas(sensors).sum(axis=1)
        self.register_buffer("area", torch.from_numpy(area).float())

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa, without displacements.

        Raises:
            InputError: shear; only normal forces are supported.
        """
        if shear is not None:
            self.refuse_shear()
        cells = flatten(pressure, self.shape, self.area.dtype)
        return Response(cells[..., self.cell] * self.area, None)
