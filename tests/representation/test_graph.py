"""Edges and weights of the sensor graph, typed out by hand."""

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.representation.graph import Graph, adjacency, neighbours, normalised

# a square of side 1, a point to its right, and one far away
#   0---1
#   |   |   4
#   2---3             5
POINTS = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [1.9, 0.6], [5, 1.1]]) * 0.01
POINTS = np.hstack([POINTS, np.zeros((6, 1))])


def pairs(linked):
    return {(int(i), int(j)) for i, j in np.argwhere(linked) if i < j}


def test_the_nearest_neighbour_of_each():
    # 3-4 is shorter than 1-4 and 2-3 than 0-2; point 5 is nobody's neighbour, but has one
    tie_free = POINTS + 1e-4 * np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [1, 3, 0], [0, 0, 0], [0, 0, 0]])
    assert pairs(neighbours(tie_free, "knn", 1)) == {(0, 1), (2, 3), (3, 4), (4, 5)}


def test_the_two_nearest_neighbours_of_each():
    assert pairs(neighbours(POINTS, "knn", 2)) == {
        (0, 1), (0, 2), (1, 3), (2, 3), (3, 4), (1, 4), (4, 5), (3, 5),
    }  # fmt: skip


def test_delaunay_edges():
    tilted = POINTS.copy()
    tilted[3, :2] += 0.001  # the diagonal 1-2 is then the Delaunay one
    assert pairs(neighbours(tilted, "delaunay")) == {
        (0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (1, 4), (3, 4), (3, 5), (4, 5), (1, 5),
    }  # fmt: skip


def test_more_neighbours_than_sensors_link_all():
    linked = neighbours(POINTS, "knn", 6)
    assert linked.sum() == 30
    assert not linked.diagonal().any()


def test_weights_of_edges():
    points = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]) * 0.01
    linked = neighbours(points, "knn", 1)  # 0-1 and 1-2; the nearest are 1, 1 and 2 cm away: d0 = 1 cm
    e = np.exp
    np.testing.assert_allclose(
        adjacency(points, linked, "exp"), [[0, e(-1), 0], [e(-1), 0, e(-2)], [0, e(-2), 0]]
    )
    np.testing.assert_allclose(adjacency(points, linked, "distance"), [[0, 1, 0], [1, 0, 2], [0, 2, 0]])
    np.testing.assert_allclose(adjacency(points, linked, "none"), [[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    np.testing.assert_allclose(
        adjacency(10 * points, linked, "distance"), adjacency(points, linked, "distance")
    )


def test_normalised_by_hand():
    # rows of A + I sum to 3, 4 and 2
    edges = np.array([[0, 2, 0], [2, 0, 1], [0, 1, 0]])
    a, b = 2 / np.sqrt(12), 1 / np.sqrt(8)
    np.testing.assert_allclose(normalised(edges), [[1 / 3, a, 0], [a, 1 / 4, b], [0, b, 1 / 2]])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"edges": "ring"}, "representation.edges=knn or delaunay"),
        ({"count": 0}, "representation.count=6"),
        ({"weight": "stiffness"}, "representation.weight=exp, distance or none"),
    ],
)
def test_bad_options_are_refused_with_the_override_that_mends_them(options, words):
    with pytest.raises(InputError, match=words):
        Graph(torch.from_numpy(POINTS), (0.16, 0.16), **options)


def test_delaunay_of_sensors_in_a_line_is_refused():
    line = torch.tensor([[0.01 * i, 0.02, 0.0] for i in range(5)])
    with pytest.raises(InputError, match=r"got 5: set representation\.edges=knn"):
        Graph(line, (0.16, 0.16), edges="delaunay")
