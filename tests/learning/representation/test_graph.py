"""Edges and weights of the sensor graph, typed out by hand."""

import numpy as np
import pytest
import torch

from skin.body.base import Sheet
from skin.body.layout import Grid
from skin.device.touches import Touches
from skin.errors import InputError
from skin.learning.fusion import Early, Linked
from skin.learning.graph import Graph, adjacency, neighbours, normalised, typical_distance
from skin.learning.model import Gcn

# a square of side 1, a point to its right, and one far away
#   0---1
#   |   |   4
#   2---3             5
POINTS = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [1.9, 0.6], [5, 1.1]]) * 0.01
POINTS = np.hstack([POINTS, np.zeros((6, 1))])

# 3-4 is shorter than 1-4 and 2-3 than 0-2; point 5 is nobody's neighbour, but has one
TIE_FREE = POINTS + 1e-4 * np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 3, 0], [0, 0, 0], [0, 0, 0]])
TILTED = POINTS + 1e-3 * np.outer(np.eye(6)[3], [1, 1, 0])  # 1-2 is then a Delaunay edge
BODY = Sheet([0.16, 0.16], [32, 32], [{"material": "EcoFlex 00-30", "thickness": 0.005}])
PLACES = torch.from_numpy(Grid(3, 3).sensors(BODY).positions).float()


@pytest.mark.parametrize(
    ("points", "edges", "count", "expected"),
    [
        (TIE_FREE, "knn", 1, "01 23 34 45"),
        (POINTS, "knn", 2, "01 02 13 23 34 14 45 35"),
        (POINTS, "knn", 6, "01 02 03 04 05 12 13 14 15 23 24 25 34 35 45"),
        (TILTED, "delaunay", 6, "01 02 12 13 23 14 34 35 45 15"),
    ],
)
def test_neighbours(points, edges, count, expected):
    linked = neighbours(points, edges, count)
    assert {f"{i}{j}" for i, j in np.argwhere(linked) if i <= j} == set(expected.split())
    assert (linked == linked.T).all()


def test_weights_of_edges():
    points = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]) * 0.01
    linked = neighbours(points, "knn", 1)  # 0-1 and 1-2; the nearest are 1, 1 and 2 cm away: d0 = 1 cm
    for law, a, b in (("exp", np.exp(-1), np.exp(-2)), ("distance", 1, 2), ("none", 1, 1)):
        for unit in (1, 10):
            weights = adjacency(unit * points, linked, law)
            np.testing.assert_allclose(weights, [[0, a, 0], [a, 0, b], [0, b, 0]])


def test_normalised_by_hand():
    # rows of A + I sum to 3, 4 and 2
    edges = np.array([[0, 2, 0], [2, 0, 1], [0, 1, 0]])
    a, b = 2 / np.sqrt(12), 1 / np.sqrt(8)
    np.testing.assert_allclose(normalised(edges), [[1 / 3, a, 0], [a, 1 / 4, b], [0, b, 1 / 2]])


def test_coordinates_are_the_last_two_features():
    positions = torch.tensor([[0.04, 0.03, 0.005], [0.16, 0.12, 0.005], [0.0, 0.06, 0.005]])
    readings = torch.rand(2, 4, 3, generator=torch.Generator().manual_seed(0))
    valid = torch.ones_like(readings, dtype=torch.bool)
    x = Graph(positions, (0.16, 0.12), coordinates=True, mask=True)(readings, valid).x
    assert x.shape == (2, 4, 3, 4)
    torch.testing.assert_close(x[..., 0], readings / 10)
    torch.testing.assert_close(x[..., 2:], torch.tensor([[0.25, 0.25], [1, 1], [0, 0.5]]).expand(2, 4, 3, 2))


def touches(motion=None, positions=PLACES):
    generator = torch.Generator().manual_seed(0)
    readings = torch.rand(2, 5, len(positions), generator=generator)
    return Touches(readings, readings >= 0, positions, torch.zeros(2, 4), 10.0, motion)


def moves(scale=0.004):
    return scale * torch.randn(2, 5, 9, 3, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("weight", ["exp", "distance", "stiffness"])
def test_a_frame_whose_sensors_moved_has_the_graph_of_where_they_are(weight):
    """Independent answer: the graph of each frame's places, made anew, with the layout's edges and d0."""
    graph = Graph(PLACES, BODY.size, positions="deformed", weight=weight, count=3)
    motion = moves()
    x, matrices = graph.show(touches(motion))[:2]
    assert x.shape == (2, 5, 9, 1)
    assert matrices.shape == (2, 5, 9, 9)
    rest = PLACES.double().numpy()
    linked, unit = neighbours(rest, "knn", 3), typical_distance(rest)
    for gesture in range(2):
        for frame in range(5):
            positions = rest + motion[gesture, frame].double().numpy()
            distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
            stiff = np.divide(unit, distance, out=np.zeros_like(distance), where=linked)
            law = {"exp": np.exp(-distance / unit), "distance": distance / unit, "stiffness": stiff}
            expected = normalised(linked * law[weight])
            np.testing.assert_allclose(matrices[gesture, frame].numpy(), expected, rtol=1e-5, atol=1e-7)


def test_a_deformed_graph_needs_to_know_the_motion():
    with pytest.raises(InputError, match=r"Touches\(motion=\.\.\.\), or set"):
        Graph(PLACES, BODY.size, positions="deformed").show(touches())


@pytest.mark.parametrize("fusion", [Early, Linked])
def test_the_other_fusions_refuse_a_graph_per_frame(fusion):
    built = fusion(lambda kind, shape: Gcn(kind, shape, [6]), "graph", (9, 1), 5)
    with pytest.raises(InputError, match="one graph per frame needs fusion=late"):
        built(Graph(PLACES, BODY.size, positions="deformed").show(touches(moves())))
