"""What a sensor feels: points and weights over its footprint, wherever it faces."""

import numpy as np

from skin.sensors import Sensors

_GAUSS = np.array([-1.0, 1.0]) / np.sqrt(3)


def quadrature(
    sensors: Sensors, lines: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points over every sensor's footprint, what they weigh, and whose they are.

    A footprint is a rectangle about the sensor, across its normal. Two Gauss points stand along each side of
    each piece into which the mesh's lines cut it, so that a piecewise linear stress is integrated exactly
    where the sensor faces the surface. What passes the edge of the body is cut off.

    Args:
        sensors: S of them.
        lines: of the mesh, along x, y and depth, m.

    Returns:
        points (P, 3) in the chart, m; areas (P,), m^2; sensor (P,), its index.
    """
    points, areas, owners = [], [], []
    for number, (place, normal) in enumerate(zip(sensors.positions, sensors.normals, strict=True)):
        turned = _turn(normal)
        along = [
            _pieces(
                extent / 2,
                *(_crossings(lines[across] - place[across], turned[axis, across]) for across in (axis, 2)),
            )
            for axis, extent in enumerate(sensors.footprint)
        ]
        (s, ds), (t, dt) = along
        grid = s[:, None, None] * turned[0] + t[None, :, None] * turned[1]
        points.append(place + grid.reshape(-1, 3))
        areas.append(np.outer(ds, dt).ravel())
        owners.append(np.full(areas[-1].size, number))
    places, weights, owner = np.concatenate(points), np.concatenate(areas), np.concatenate(owners)
    last = np.array([line[-1] for line in lines])
    inside = ((places >= 0) & (places <= last)).all(axis=1)
    return places[inside], weights[inside], owner[inside]


def _turn(normal: np.ndarray) -> np.ndarray:
    """Return the chart's axes turned the shortest way until the third is the normal, (3, 3), rows."""
    x, y, z = normal if normal[2] >= 0 else -normal
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )


def _crossings(distances: np.ndarray, slope: float) -> np.ndarray:
    """Return where a line of some slope has gone some distances; nowhere if it stands still."""
    return distances / slope if abs(slope) > 1e-9 else np.empty(0)


def _pieces(half: float, *crossings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points between -half and half, by pieces between cuts, and their weights."""
    cuts = np.concatenate(crossings)
    edges = np.unique(np.concatenate([[-half, half], cuts[np.abs(cuts) < half]]))
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    return (middle[:, None] + np.outer(width / 2, _GAUSS)).ravel(), np.repeat(width / 2, 2)
