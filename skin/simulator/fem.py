"""The report's finite-element skin: plates and beams (report, 2.1.2), as one linear operator."""

from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.sensors import Sensors
from skin.settings import checked
from skin.simulator._assembly import Constraint, Structure
from skin.simulator._operator import Operator, cached
from skin.simulator._store import folder
from skin.simulator._strain import largest, squeeze
from skin.simulator.base import AbstractSimulator, Response, flatten

Reading = Literal["equation10", "interface"]


@checked("simulator")
class PlatesAndBeams(AbstractSimulator):
    """Layers of Kirchhoff plates on upright Euler-Bernoulli beams, glued to a table.

    Each layer is a set of beams, one per node with the part of the sheet nearest to it as section, and the
    plates on their heads. Linear: no contact, no large strain.

    Refinement is slow. Under a Gaussian touch of 15 mm standard deviation the default 32 x 32 cells give a
    D_s 16 %, a D_t 11 % and a share D_s / D_t 5 % smaller than 128 x 128 cells do; 64 x 64 come within 5 %.
    Under uniform pressure the surface's edges deviate from its middle by -11 to +3 % (128 x 128: -1.4 to
    +0.3 %).

    Args:
        body: the sheet.
        sensors: where the sensors are; each lies at an interface between layers, or on the surface.
        reading: ``equation10`` is the report's: the force on the footprint at the surface times D_s / D_t,
            the share of the surface's motion that reaches the sensor. It is zero beside the contact.
            ``interface`` is the force that the layer below carries under the footprint: linear, and
            neighbours feel a touch.
        constraint: ``vertical`` is the report's: nodes move vertically and tilt. ``free`` lets them move
            along the sheet too; then :meth:`motion` tells where the sensors go.
        cache: folder of operators kept from earlier runs; None means the variable SKIN_CACHE, else the
            user's cache.

    Raises:
        InputError: an unknown reading or constraint, a body that is not flat, a sensor at no interface or
            tilted, or a mesh finer than memory allows.

    Attributes:
        operator: the rows D_s, D_t, F_in, the carried force and the motion along x and y in float64, as
            computed. The buffers that pressures are multiplied by are float32 copies of them.
    """

    transfer: Tensor
    along: Tensor

    def __init__(
        self,
        body: AbstractBody,
        sensors: Sensors,
        reading: Reading = "equation10",
        constraint: Constraint = "vertical",
        cache: str | Path | None = None,
    ) -> None:
        super().__init__()
        self.refuse_tilted(sensors)
        self.reading, self.constraint = reading, constraint
        self.shape = body.shape
        self._structure = Structure(body, constraint)
        self.operator: Operator = cached(self._structure, sensors, folder(cache))
        force = self.operator.applied if reading == "equation10" else self.operator.carried
        rows = np.concatenate([self.operator.sensor, self.operator.surface, force])
        self.register_buffer("transfer", torch.from_numpy(rows.T.copy()).float())
        moves = np.concatenate([self.operator.along_x, self.operator.along_y, self.operator.sensor])
        self.register_buffer("along", torch.from_numpy(moves.T.copy()).float())

    def forward(self, pressure: Tensor, shear: Tensor | None = None) -> Response:
        """Return the response to pressure (..., H, W), Pa, with D_s and D_t as its displacement.

        Raises:
            InputError: shear; only normal forces are felt.
        """
        return self.read(self.linear(pressure, shear))

    def linear(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return D_s, D_t and the force that the reading is made of, (..., 3 S)."""
        if shear is not None:
            self.refuse_shear()
        return flatten(pressure, self.shape, self.transfer.dtype) @ self.transfer

    def read(self, linear: Tensor) -> Response:
        """Return the response that has these linear parts (..., 3 S)."""
        sensor, surface, force = linear.chunk(3, dim=-1)
        displacement = torch.stack([sensor, surface], dim=-1)
        if self.reading == "interface":
            return Response(force, displacement)
        # Where nothing moves the share is 0; dividing by 1 there keeps the gradient finite too. Subnormal
        # motion counts as none: its quotient could overflow.
        moves = surface.abs() > torch.finfo(surface.dtype).tiny
        share = torch.where(moves, sensor / torch.where(moves, surface, 1), 0)
        return Response(share * force, displacement)

    def strain(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return by how much of its thickness the top layer is squeezed where it is most, (U,)."""
        cells = flatten(pressure, self.shape, self.transfer.dtype)
        return largest(cells, self._squeeze.to(cells.device))

    @cached_property
    def _squeeze(self) -> Tensor:
        return torch.from_numpy(squeeze(self._structure)[None]).float()

    def motion(self, pressure: Tensor, shear: Tensor | None = None) -> Tensor:
        """Return how far each sensor moves along x, along y and into the skin, (..., S, 3), m.

        Raises:
            InputError: nodes are held along x and y; or shear.
        """
        if shear is not None:
            self.refuse_shear()
        if self.constraint != "free":
            raise InputError(
                "sensors that move need a skin that does, got simulator.constraint="
                f"{self.constraint}: set simulator.constraint=free"
            )
        cells = flatten(pressure, self.shape, self.along.dtype)
        return (cells @ self.along).unflatten(-1, (3, -1)).transpose(-1, -2)
