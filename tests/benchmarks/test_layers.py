"""The layers that are timed against each other give the same."""

import pytest
import torch

from experiments.benchmarks import layers
from skin.model._pooling import POOLINGS


@pytest.mark.parametrize(("first", "second"), [(3, 7), (7, 3)])
def test_convolutions_give_the_same(first, second):
    ours, theirs = layers.convolutions(first, second, 4)
    nodes = torch.randn(layers.SENSORS, 4, first)
    for task in theirs.values():
        found = task(nodes).view(4, layers.SENSORS, second).transpose(0, 1)
        torch.testing.assert_close(found, ours(nodes))


@pytest.mark.parametrize("name", POOLINGS)
def test_poolings_give_the_same(name):
    ours, theirs = layers.poolings(name, 5, 4)
    nodes = torch.randn(layers.SENSORS, 4, 5)
    assert ours(nodes).shape == (4, ours.width)
    for task in theirs.values():
        torch.testing.assert_close(task(nodes), ours(nodes))


def test_every_layer_of_both_rows_is_timed(monkeypatch):
    monkeypatch.setattr(layers, "ROWS", {"temporal_graph": (2, (3, 4, 5)), "sequence_graph": (3, (1, 2, 4))})
    found = layers.measure_layers(1)
    assert set(found) == {"temporal_graph", "sequence_graph"}
    assert all(len(ratios) == 2 * 3 + 3 * 2 + 1 and min(ratios.values()) >= 0 for ratios in found.values())
