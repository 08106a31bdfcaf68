"""Early fusion: time is nothing but channels."""

import torch

from skin.learning.fusion import Early
from skin.learning.representation import Frames


class Spy(torch.nn.Module):
    width = 1

    def __init__(self, kind, shape):
        super().__init__()
        self.shape = shape

    def forward(self, x, adjacency):
        return x


def test_frames_of_an_image_are_its_channels():
    x = torch.randn(2, 5, 1, 8, 8)
    fusion = Early(Spy, "image", (1, 8, 8), 5)
    assert fusion.model.shape == (5, 8, 8)
    assert torch.equal(fusion(Frames(x, None)), x[:, :, 0])


def test_frames_of_a_graph_are_features_of_its_nodes():
    x = torch.randn(2, 5, 7, 1)
    fusion = Early(Spy, "graph", (7, 1), 5)
    assert fusion.model.shape == (7, 5)
    assert torch.equal(fusion(Frames(x, torch.eye(7)))[1, 3], x[1, :, 3, 0])
