"""Rows over the motion of elements: the force across the footprint of a sensor, and the strain of cells."""

import warnings

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from skin.body.base import Sensors, plane_axes
from skin.mechanics.simulator._mesh import Hexahedra, lagrange

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
    parts = fractions[:, :, None] * sensors.measured[:, None]
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
