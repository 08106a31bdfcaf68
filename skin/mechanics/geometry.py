"""Where the sensors of a skin are, and what they respond to, as numbers for a network."""

import math
from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from skin.body.base import GEOMETRY, REACHES, AbstractBody, Sensors
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch import splines

# What the moments of a pressure (skin/touch/splines.py) say of footprints, and of values at nodes.


@lru_cache
def _gram(count: int) -> np.ndarray:
    points, weights = splines.gauss_points(0, count)
    values = splines.spline_values(points, count)
    return values.T @ (weights[:, None] * values)


@lru_cache
def fit_nodes(count: int, nodes: int) -> np.ndarray:
    """Return the coefficients (count, nodes) of the least-squares fit of nodal values along one axis.

    Evenly spaced nodes, ends included, are joined by a cubic spline, which the splines of the cells fit.
    """
    points, weights = splines.gauss_points(0, count)
    joined = make_interp_spline(np.linspace(0, count, nodes), np.eye(nodes), k=min(3, nodes - 1))(points)
    return np.linalg.solve(_gram(count), splines.spline_values(points, count).T @ (weights[:, None] * joined))


def footprints(body: AbstractBody, sensors: Sensors) -> np.ndarray:
    """Return weights (S, H * W) of moments whose sum is the mean pressure over each footprint, Pa.

    The weights fit the footprint by least squares; a footprint beyond the edge of the body is clipped.
    """
    weights = []
    for axis, (count, cell) in enumerate(zip(body.cells, body.cell, strict=True)):
        middle, half = sensors.positions[:, axis] / cell, sensors.footprint[axis] / cell / 2
        rows = []
        for low, high in zip(np.maximum(middle - half, 0), np.minimum(middle + half, count), strict=True):
            points, fractions = splines.gauss_points(low, high)
            rows.append(fractions @ splines.spline_values(points, count) / (high - low))
        weights.append(np.linalg.solve(_gram(count), np.array(rows).T).T)
    return np.einsum("sh,sw->shw", weights[1], weights[0]).reshape(len(sensors), -1)


# The pressure of a fingertip, differentiable in its position, radius and force.


PARAMETERS = ("x", "y", "radius", "force")
"""What a fingertip is described by, m, m, m, N, in the order of the last axis."""


class Fingertip:
    """Loads of discs with a soft rim on the cells of a body.

    The pressure at a distance d from the centre is proportional to 1 / (1 + exp((d - radius) / rim)). A cell
    has the mean of samples that are at most two rims apart, or their moment, of samples at most one rim
    apart. The part of a disc beyond the edge of the body is cut off, and the rest carries the whole force.

    Args:
        body: what is touched; distances are those of its chart.
        rim: m, over which the pressure falls by about a quarter of its maximum.
        smooth: whether loads are moments of the pressure (:mod:`skin.touch.splines`), as
            ``AbstractSimulator.smooth`` says, instead of mean pressures of cells.
    """

    def __init__(self, body: AbstractBody, rim: float, smooth: bool = False) -> None:
        self._rim, self._area = rim, math.prod(body.cell)
        apart = rim if smooth else 2 * rim
        samples = [max(1, math.ceil(cell / apart)) for cell in body.cell]
        self._x, self._y = (
            (torch.arange(count * number, dtype=torch.float64) + 0.5) * (cell / number)
            for count, cell, number in zip(body.cells, body.cell, samples, strict=True)
        )
        # Weights of the samples along an axis in the load of each cell.
        self._across, self._down = (
            torch.from_numpy(
                splines.spline_values(positions.numpy() / cell, count) / number
                if smooth
                else np.repeat(np.eye(count), number, axis=0) / number
            )
            for positions, count, cell, number in zip(
                (self._x, self._y), body.cells, body.cell, samples, strict=True
            )
        )

    def __call__(self, touches: Tensor) -> Tensor:
        """Return the loads (B, H, W), Pa, of touches (B, 4) as in :data:`PARAMETERS`, in their dtype."""
        x, y, radius, force = touches[:, :, None, None].unbind(1)
        across, down = (self._x.to(touches) - x) / self._rim, (self._y.to(touches)[:, None] - y) / self._rim
        # The root of 0 has no derivative; a micrometre changes nothing.
        distance = (across.square() + (down.square() + (1e-6 / self._rim) ** 2)).sqrt()
        fraction = torch.sigmoid(radius / self._rim - distance)
        cells = self._down.to(touches).T @ (fraction @ self._across.to(touches))
        return force * cells / (self._area * cells.sum((1, 2), keepdim=True))


def fingertip_readings(
    simulator: AbstractSimulator, body: AbstractBody, touches: Tensor, rim: float
) -> Tensor:
    """Return the readings (B, S), N, of discs with a soft rim (:class:`Fingertip`), differentiable in them.

    Args:
        simulator: of the body and S sensors; its dtype is that of the readings.
        body: what is touched.
        touches: (B, 4), as in :data:`PARAMETERS`.
        rim: of the discs, m.
    """
    fingertip = Fingertip(body, rim, simulator.smooth)
    return torch.cat([simulator.press(fingertip(part)).readings for part in touches.split(_AT_ONCE)])


_RADIUS, _RIM = 0.008, 0.0015  # m, of the fingertip that probes a skin
_AT_ONCE = 64  # touches
_AROUND = 8  # positions at each distance from a sensor
_UNIFORM = 1000.0  # Pa


@torch.no_grad()
def sensor_geometry(body: AbstractBody, sensors: Sensors, model: AbstractSimulator) -> Tensor:
    """Return the columns :data:`skin.device.touches.GEOMETRY` of each sensor, (S, G), float32.

    Responses are readings of ``model`` under a fingertip of 1 N at some distances from the sensor, the mean
    over positions around it on the surface, and under a uniform pressure, relative to the force on the
    footprint.

    Args:
        body: the body.
        sensors: S sensors.
        model: of these sensors.
    """
    count = len(sensors)
    parts = [
        sensors.positions,
        sensors.measured,
        np.broadcast_to(sensors.footprint, (count, 2)),
        np.broadcast_to(body.size, (count, 2)),
        np.full((count, 1), body.thickness),
    ]
    uniform = model(torch.full((1, *body.shape), _UNIFORM)).readings[0]
    fraction = uniform / (_UNIFORM * math.prod(sensors.footprint))
    reaches = torch.stack([_response(body, sensors, model, reach) for reach in REACHES], dim=1)
    design = torch.from_numpy(np.concatenate(parts, axis=1)).float()
    columns = torch.cat([design, fraction[:, None].float(), reaches.float()], dim=1)
    assert columns.shape == (count, len(GEOMETRY))
    return columns


def _response(body: AbstractBody, sensors: Sensors, model: AbstractSimulator, reach: float) -> Tensor:
    """Return the mean reading (S,), N, of each sensor under fingertips of 1 N at a distance, m."""
    angles = np.linspace(0, 2 * np.pi, _AROUND if reach else 1, endpoint=False)
    around = reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    positions = sensors.positions[:, None, :2] + around
    inside = ((positions >= 0) & (positions <= body.size)).all(axis=2)
    inside |= ~np.any(
        inside, axis=1, keepdims=True
    )  # of a small body: beyond the edge is better than nowhere
    owner, number = np.nonzero(inside)
    constants = np.broadcast_to([_RADIUS, 1.0], (len(owner), 2))
    touches = torch.from_numpy(
        np.concatenate([positions[owner, number].clip(0, body.size), constants], axis=1)
    )
    rows = torch.arange(len(owner))
    index = torch.from_numpy(owner)
    # A simulator of a user's own computes in single precision.
    felt = fingertip_readings(model, body, touches.float(), _RIM)
    total = torch.zeros(len(sensors)).index_add(0, index, felt[rows, index].float())
    return total / torch.bincount(index, minlength=len(sensors))
