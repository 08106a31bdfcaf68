"""A graph of sensors with edges between neighbours."""

from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import PositiveInt
from scipy.spatial import Delaunay, QhullError, cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor, nn

from skin.core.settings import checked
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.representation import AbstractRepresentation, Frames, channels, count_axes

Edges = Literal["knn", "delaunay"]
Weight = Literal["exp", "distance", "stiffness", "none"]
Positions = Literal["layout", "deformed"]


def neighbours(positions: np.ndarray, edges: Edges, count: int = 6) -> np.ndarray:
    """Return which sensors (S, 3), m, are neighbours: (S, S), bool, symmetric, without self-loops.

    ``knn``: one of the two is among the ``count`` nearest of the other. ``delaunay``: they share an edge of
    the Delaunay triangulation in the plane.

    Raises:
        InputError: the sensors do not form a triangle.
    """
    linked = np.zeros((len(positions), len(positions)), dtype=bool)
    if edges == "knn":
        nearest = cKDTree(positions).query(positions, k=range(1, min(count + 1, len(positions)) + 1))[1]
        np.put_along_axis(linked, nearest, True, axis=1)
    else:
        try:
            triangles = Delaunay(positions[:, :2]).simplices
        except (QhullError, ValueError):
            raise InputError(
                f"representation.edges=delaunay needs at least three sensors that are not in one line, "
                f"got {len(positions)}: set representation.edges=knn"
            ) from None
        for corner in range(3):
            linked[triangles[:, corner], triangles[:, corner - 1]] = True
    np.fill_diagonal(linked, False)
    return linked | linked.T


def typical_distance(positions: np.ndarray) -> float:
    """Return d0, the median distance of sensors (S, 3), m, to their nearest neighbours; of a single one 1."""
    if len(positions) < 2:
        return 1.0
    distance = cdist(positions, positions)
    return float(np.median((distance + np.diag(np.full(len(distance), np.inf))).min(axis=1)))


def adjacency(positions: np.ndarray, linked: np.ndarray, weight: Weight) -> np.ndarray:
    """Return the weights (S, S) of the edges ``linked``; 0 where there is none.

    With d the distance and d0 the typical one (:func:`typical_distance`): ``exp`` is exp(-d / d0),
    ``distance`` is d / d0 (the report's edge value, free of the unit of length), ``none`` is 1. ``stiffness``
    is the stiffness k = E h w / d, summed over layers, of the strip of skin between the two sensors, divided
    by the stiffness of a strip of length d0 ("other physical information", report, 2.2.1): d0 / d, whatever w
    and the layers.

    Distances are those along the surface, on a sheet and on an arm alike: a straight line of the chart is the
    shortest way on a cylinder too, and the strip of skin along it is the one that is stretched.

    Args:
        positions: (S, 3), m.
        linked: (S, S), bool, symmetric.
        weight: see above.
    """
    if weight == "none" or not linked.any():
        return linked.astype(float)
    unit = typical_distance(positions)
    distance = cdist(positions, positions)
    if weight == "stiffness":
        return np.divide(unit, distance, out=np.zeros_like(distance), where=linked)
    return linked * (np.exp(-distance / unit) if weight == "exp" else distance / unit)


def normalised(edges: np.ndarray) -> np.ndarray:
    """Return D^-1/2 (A + I) D^-1/2 of edge weights A (S, S), D the row sums of A + I (Kipf, Welling 2017).

    Its diagonal is therefore 1 / D, from which ``fusion=linked`` recovers D.
    """
    looped = edges + np.eye(len(edges))
    root = np.sqrt(looped.sum(axis=1))
    return looped / np.outer(root, root)


@checked("representation")
class Graph(AbstractRepresentation):
    """Represents sensors as nodes with edges between neighbours (report, section 2.2).

    It needs positions only and applies to any layout and number of sensors. A site with three axes is one
    node with three readings. The adjacency is one dense
    matrix, normalised once and shared by all frames; with ``positions=deformed`` each frame has its own
    (report, section 4.2). Edges and the unit d0 always follow from the layout at rest, so that the graph
    changes continuously.

    Args:
        layout: (S, 3), m; by position.
        size: extent (x, y) of the sheet, m; by position.
        edges: ``knn`` or ``delaunay``; see :func:`neighbours`.
        count: number of nearest neighbours under ``knn``.
        weight: ``exp``, ``distance``, ``stiffness`` or ``none``; see :func:`adjacency`.
        positions: of the sensors for distances: ``layout``, or ``deformed``, the displaced positions in each
            frame, which needs touches with displacements and a fusion that accepts a graph per frame.
        coordinates: append x / size_x and y / size_y as the last two node features of every frame.
        scale: N; readings are divided by it.
        mask: append a node feature that is 1 where the reading is not valid.

    Raises:
        InputError: an unknown option, or sensors that do not form a graph.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "graph"

    def __init__(
        self,
        layout: Tensor,
        size: tuple[float, float],
        /,
        edges: Edges = "knn",
        count: PositiveInt = 6,
        weight: Weight = "exp",
        positions: Positions = "layout",
        coordinates: bool = False,
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.scale, self.mask, self.coordinates = scale, mask, coordinates
        self.weight, self.positions = weight, positions
        if positions == "deformed" and weight == "none" and not coordinates:
            raise InputError(
                "representation.positions=deformed changes nothing at representation.weight=none: set "
                "representation.weight=exp, or representation.positions=layout"
            )
        self.axes = count_axes(layout)
        points = layout[:: self.axes].cpu().numpy().astype(float)
        weights = adjacency(points, neighbours(points, edges, count), weight)
        self.unit = typical_distance(points)
        self.adjacency = nn.Buffer(torch.from_numpy(normalised(weights)).to(torch.float32))
        self.layout = nn.Buffer(torch.from_numpy(points).to(torch.float32))
        self.size = nn.Buffer(torch.tensor(size, dtype=torch.float32))
        self.pairs = nn.Buffer(torch.from_numpy(np.stack(np.nonzero(np.triu(weights)))))

    def forward(self, readings: Tensor, valid: Tensor, motion: Tensor | None = None) -> Frames:
        """Return frames (B, T, S, F) and the adjacency (S, S) or (B, T, S, S) of readings (B, T, S), N.

        Args:
            readings: (B, T, S), N.
            valid: (B, T, S), bool.
            motion: (B, T, S, 3), m, displacement of each sensor from its position in the layout; only
                ``positions=deformed`` needs it.

        Raises:
            InputError: the motion is needed and not known.
        """
        deformed = self.positions == "deformed"
        if deformed and motion is None:
            raise InputError(
                "representation.positions=deformed needs touches with displacements of sensors: give "
                "Touches(motion=...), or set representation.positions=layout"
            )
        moved = motion if motion is None else motion[:, :, :: self.axes]
        positions = self.layout + moved if deformed and moved is not None else self.layout
        matrix = self._adjacency_at(positions) if deformed and self.weight != "none" else self.adjacency
        x = channels(readings, valid, self.scale, self.mask, self.axes)
        if self.coordinates:
            coordinates = (positions[..., :2] / self.size).to(x.dtype).expand(*x.shape[:-1], 2)
            x = torch.cat([x, coordinates], dim=-1)
        return Frames(x, matrix)

    def show(self, touches: Touches) -> Frames:
        """Return the frames of touches, with the sensors at their displaced positions if these are known."""
        return self(touches.readings, touches.valid, touches.motion)

    def _adjacency_at(self, positions: Tensor) -> Tensor:
        """Return the normalised adjacency (B, T, S, S) of sensors at positions (B, T, S, 3), m."""
        first, second = self.pairs
        distance = (positions.index_select(-2, first) - positions.index_select(-2, second)).norm(dim=-1)
        ratio = distance / self.unit
        weights = {"stiffness": self.unit / distance, "exp": (-ratio).exp(), "distance": ratio}[self.weight]
        loops = torch.eye(positions.shape[-2], device=positions.device)
        looped = loops.expand(*positions.shape[:-1], -1).clone()
        looped[..., first, second] = looped[..., second, first] = weights
        root = looped.sum(dim=-1).sqrt()
        return looped / (root[..., :, None] * root[..., None, :])
