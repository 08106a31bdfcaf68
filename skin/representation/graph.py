"""A graph with a sensor at each node and an edge between neighbours."""

from typing import ClassVar, Literal

import numpy as np
import torch
from scipy.spatial import Delaunay, QhullError, cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from skin.errors import InputError
from skin.representation._channels import channels
from skin.representation.base import AbstractRepresentation, Frames

__all__ = ["Graph", "adjacency", "neighbours", "normalised"]

Edges = Literal["knn", "delaunay"]
Weight = Literal["exp", "distance", "none"]


def neighbours(positions: np.ndarray, edges: Edges, count: int = 6) -> np.ndarray:
    """Return which sensors (S, 3), m, are neighbours: (S, S), bool, symmetric, no node its own neighbour.

    ``knn``: one of the two is among the ``count`` nearest of the other. ``delaunay``: they share an edge of
    the Delaunay triangulation in the plane.

    Raises:
        InputError: an unknown rule, no neighbours asked for, or sensors of which no triangle can be made.
    """
    linked = np.zeros((len(positions), len(positions)), dtype=bool)
    if edges == "knn":
        if count < 1:
            raise InputError(f"a graph needs at least one neighbour, got {count}: set representation.count=6")
        nearest = cKDTree(positions).query(positions, k=range(1, min(count + 1, len(positions)) + 1))[1]
        np.put_along_axis(linked, nearest, True, axis=1)
    elif edges == "delaunay":
        try:
            triangles = Delaunay(positions[:, :2]).simplices
        except (QhullError, ValueError):
            raise InputError(
                f"representation.edges=delaunay needs at least three sensors that are not in one line, "
                f"got {len(positions)}: set representation.edges=knn"
            ) from None
        for corner in range(3):
            linked[triangles[:, corner], triangles[:, corner - 1]] = True
    else:
        raise InputError(f"unknown edges {edges!r}: set representation.edges=knn or delaunay")
    np.fill_diagonal(linked, False)
    return linked | linked.T


def adjacency(positions: np.ndarray, linked: np.ndarray, weight: Weight) -> np.ndarray:
    """Return the weights (S, S) of the edges ``linked``; 0 where there is none.

    With d the distance and d0 the median distance to the nearest neighbour: ``exp`` is exp(-d / d0),
    ``distance`` is d / d0 (the report's edge value, free of the unit of length), ``none`` is 1.

    Raises:
        InputError: an unknown weight.
    """
    if weight not in ("exp", "distance", "none"):
        raise InputError(f"unknown edge weight {weight!r}: set representation.weight=exp, distance or none")
    if weight == "none" or not linked.any():
        return linked.astype(float)
    distance = cdist(positions, positions)
    unit = np.median((distance + np.diag(np.full(len(distance), np.inf))).min(axis=1))
    return linked * (np.exp(-distance / unit) if weight == "exp" else distance / unit)


def normalised(edges: np.ndarray) -> np.ndarray:
    """Return D^-1/2 (A + I) D^-1/2 of edge weights A (S, S), D the row sums of A + I (Kipf, Welling 2017).

    Its diagonal is therefore 1 / D, from which ``fusion=linked`` recovers D.
    """
    looped = edges + np.eye(len(edges))
    root = np.sqrt(looped.sum(axis=1))
    return looped / np.outer(root, root)


class Graph(AbstractRepresentation):
    """Makes a sensor a node and links neighbours (report, section 2.2).

    Needs nothing but positions, so it carries to any layout and any number of sensors. The layout is the same
    for a whole batch, so the graph is one dense matrix, normalised once.

    Args:
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m; not used.
        edges: ``knn`` or ``delaunay``; see :func:`neighbours`.
        count: number of nearest neighbours under ``knn``.
        weight: ``exp``, ``distance`` or ``none``; see :func:`adjacency`.
        scale: N; readings are divided by it.
        mask: append a node feature that tells whether the reading is valid.

    Raises:
        InputError: an unknown option, or sensors of which the graph cannot be made.
    """

    kind: ClassVar[Literal["image", "graph", "readings"]] = "graph"
    adjacency: Tensor

    def __init__(
        self,
        positions: Tensor,
        size: tuple[float, float],
        edges: Edges = "knn",
        count: int = 6,
        weight: Weight = "exp",
        scale: float = 10.0,
        mask: bool = False,
    ) -> None:
        super().__init__()
        self.scale, self.mask = scale, mask
        places = positions.cpu().numpy().astype(float)
        matrix = normalised(adjacency(places, neighbours(places, edges, count), weight))
        self.register_buffer("adjacency", torch.from_numpy(matrix).to(torch.float32))

    def forward(self, readings: Tensor, valid: Tensor) -> Frames:
        """Return frames (B, T, S, C) and the adjacency (S, S) of readings (B, T, S), N."""
        return Frames(channels(readings, valid, self.scale, self.mask), self.adjacency)
