"""What the footprints of sensors feel: weights of pressures, rows over elements, columns for a network."""

import math
import warnings
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
import torch
from scipy.interpolate import make_interp_spline
from scipy.sparse.linalg import spsolve
from torch import Tensor

from skin.body.base import GEOMETRY, REACHES, AbstractBody, Sensors, plane_axes
from skin.mechanics.simulator._mesh import Hexahedra, lagrange
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.shapes import gauss_points, spline_values

# What the moments of a pressure (skin/touch/shapes.py) say of footprints, and of values at nodes.


@lru_cache
def _gram(count: int) -> np.ndarray:
    points, weights = gauss_points(0, count)
    values = spline_values(points, count)
    return values.T @ (weights[:, None] * values)


@lru_cache
def fit_nodes(count: int, nodes: int) -> np.ndarray:
    """Return the coefficients (count, nodes) of the least-squares fit of nodal values along one axis.

    Evenly spaced nodes, ends included, are joined by a cubic spline, which the splines of the cells fit.
    """
    points, weights = gauss_points(0, count)
    joined = make_interp_spline(np.linspace(0, count, nodes), np.eye(nodes), k=min(3, nodes - 1))(points)
    return np.linalg.solve(_gram(count), spline_values(points, count).T @ (weights[:, None] * joined))


def footprints(body: AbstractBody, sensors: Sensors) -> np.ndarray:
    """Return weights (S, H * W) of moments whose sum is the mean pressure over each footprint, Pa.

    The weights fit the footprint by least squares; a footprint beyond the edge of the body is clipped.
    """
    weights = []
    for axis, (count, cell) in enumerate(zip(body.cells, body.cell, strict=True)):
        middle, half = sensors.positions[:, axis] / cell, sensors.footprint[axis] / cell / 2
        rows = []
        for low, high in zip(np.maximum(middle - half, 0), np.minimum(middle + half, count), strict=True):
            points, fractions = gauss_points(low, high)
            rows.append(fractions @ spline_values(points, count) / (high - low))
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
        smooth: whether loads are moments of the pressure (:mod:`skin.touch.shapes`), as
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
                spline_values(positions.numpy() / cell, count) / number
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


# Rows over the motion of elements: the force across the footprint of a sensor, and the strain of cells.


_POINTS = 24  # along each side of a tilted footprint: what it loses is known to 4 %, its reading to 0.1 %
_NOTHING = 1e-13  # of the largest weight of a node; weights fade by 0.27 from node to node
_LEAST_CUT = 0.03  # fraction of a footprint that causes a warning: less than a line of points


def reading_rows(mesh: Hexahedra, sensors: Sensors) -> sp.csr_array:
    """Return rows (S, 3 N) that give the force on each sensor along its direction, N, from nodal motions.

    A sensor that faces the surface reads the traction that belongs to the forces between the rows of elements
    above and below its plane of nodes; between planes, the cubic through the nearest four. A tilted sensor
    reads the stress in the middles of elements.
    """
    tilted = sensors.tilted
    near, weights = lagrange(mesh.lines[2], sensors.positions[:, 2], min(4, len(mesh.lines[2])))
    fractions = np.zeros((len(sensors), len(mesh.lines[2])))
    np.put_along_axis(fractions, near, weights * ~tilted[:, None], axis=1)
    rows = sp.csr_array((len(sensors), 3 * len(mesh.nodes)))
    parts = fractions[:, :, None] * (sensors.measured * np.sign(sensors.normals[:, 2:]))[:, None]
    for plane, axis in np.argwhere(np.abs(parts).max(axis=0) > 1e-9).tolist():
        rows = rows + sp.diags_array(parts[:, plane, axis]) @ _pressed(mesh, sensors, plane, axis)
    return rows + _stressed(mesh, sensors) if tilted.any() else rows


def _pressed(mesh: Hexahedra, sensors: Sensors, plane: int, axis: int) -> sp.csr_array:
    """Return rows (S, 3 N) that read the force along an axis on footprints in a plane of nodes."""
    along_x, along_y = (
        _overlaps(line, sensors.positions[:, axis], sensors.footprint[axis])
        for axis, line in enumerate(mesh.lines[:2])
    )
    felt = np.einsum("sy,sx->yxs", along_y, along_x).reshape(-1, len(sensors))
    pressures = spsolve(mesh.plane_areas(plane), felt).reshape(felt.shape)
    pressures[np.abs(pressures) < _NOTHING * np.abs(pressures).max()] = 0
    return sp.csr_array(pressures.T) @ mesh.pushes(plane, axis)


def _overlaps(line: np.ndarray, middle: np.ndarray, extent: float) -> np.ndarray:
    """Return the integrals of the nodes' hat functions over lengths about some middles, (S, nodes), m."""
    low, high = ((middle + side * extent / 2)[:, None].clip(line[:-1], line[1:]) for side in (-1, 1))
    fraction = ((low + high) / 2 - line[:-1]) / np.diff(line)
    weights = np.zeros((len(middle), len(line)))
    weights[:, :-1] += (high - low) * (1 - fraction)
    weights[:, 1:] += (high - low) * fraction
    return weights


def _stressed(mesh: Hexahedra, sensors: Sensors) -> sp.csr_array:
    """Return rows (S, 3 N) that read the force on tilted sensors, and nothing on others."""
    points, inside = sample(sensors, tuple(line[-1] for line in mesh.lines))
    owner, number = np.nonzero(inside & sensors.tilted[:, None])
    area = np.prod(sensors.footprint) / inside.shape[1]
    sums = sp.csr_matrix((np.full(len(owner), -area), (owner, np.arange(len(owner)))),
                         shape=(len(sensors), len(owner)))  # fmt: skip
    weights = (sums @ mesh.between(points[owner, number])).tocsr()
    return sp.csr_array(mesh.mean_stress(weights, sensors.normals, sensors.measured))


def sample(sensors: Sensors, extent: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return even points over each footprint, (S, P, 3) in the chart, m, and which are in the body, (S, P).

    A footprint is a rectangle about the sensor, across its normal: the chart's x and y turned the shortest
    way. What passes the surface, an edge or the base of the body, of some extent, m, reads nothing.
    """
    along_x, along_y = plane_axes(sensors.normals).swapaxes(0, 1)
    s, t = np.meshgrid(*(side * ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) for side in sensors.footprint))
    points = s.reshape(-1, 1) * along_x[:, None] + t.reshape(-1, 1) * along_y[:, None]
    points += sensors.positions[:, None]
    return points, ((points >= 0) & (points <= extent)).all(axis=2)


def warn_of_cut(sensors: Sensors, extent: tuple[float, float, float]) -> None:
    """Warn of tilted sensors whose footprints pass an edge or the base of a body of some extent, m."""
    lost = (1 - sample(sensors, extent)[1].mean(axis=1)) * sensors.tilted
    if lost.max(initial=0) > _LEAST_CUT:
        warnings.warn(
            f"the footprints of {(lost > _LEAST_CUT).sum()} tilted sensors pass the surface, the base or an "
            f"edge of the body, where there is no stress: sensor {lost.argmax() + 1} loses "
            f"{100 * lost.max():.0f} % of its footprint; move or turn the sensors, or make layout.footprint "
            "smaller",
            UserWarning,
            stacklevel=3,
        )


def strain_rows(mesh: Hexahedra, top: float, refinement: int) -> list[sp.csr_matrix]:
    """Return rows (6 cells, 3 N) of the mean strain of each cell in the upper and the lower half of a layer.

    Args:
        mesh: of the body.
        top: thickness of the uppermost layer, m; a single row of elements has no halves.
        refinement: elements along each side of a cell.
    """
    x, y, z = ((line[1:] + line[:-1]) / 2 for line in mesh.lines)
    along = [
        sp.kron(sp.eye_array(len(line) // refinement), np.full((1, refinement), 1 / refinement))
        for line in (x, y)
    ]
    mean, positions = sp.kron(along[1], along[0]).tocsr(), np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    halves = [half for half in np.array_split(z[z < top], 2) if len(half)]
    return [
        sp.vstack(
            [
                sum(mean @ part for part in parts) / len(half)
                for parts in zip(
                    *(
                        mesh.strain(np.column_stack([positions, np.full(len(positions), depth)]))
                        for depth in half
                    ),
                    strict=True,
                )
            ]
        ).tocsr()
        for half in halves
    ]
