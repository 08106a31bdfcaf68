"""The big graph, typed out and against PyTorch Geometric."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.learning.cnn import Cnn
from skin.learning.fusion import Linked, link
from skin.learning.graph import normalised
from skin.learning.model import Gcn
from skin.learning.representation import Frames

PAIR = np.array([[0.0, 0.5], [0.5, 0.0]])


def test_two_sensors_and_three_frames_by_hand():
    # rows of A + I with the edge from the frame before: 1.5 in the first frame, 2.5 in the others
    a, b, c = 1.5, 2.5, np.sqrt(1.5 * 2.5)
    wanted = np.array(
        [
            [1 / a, 0.5 / a, 0, 0, 0, 0],
            [0.5 / a, 1 / a, 0, 0, 0, 0],
            [1 / c, 0, 1 / b, 0.5 / b, 0, 0],
            [0, 1 / c, 0.5 / b, 1 / b, 0, 0],
            [0, 0, 1 / b, 0, 1 / b, 0.5 / b],
            [0, 0, 0, 1 / b, 0.5 / b, 1 / b],
        ]
    )
    np.testing.assert_allclose(link(torch.from_numpy(normalised(PAIR)), 3), wanted)


def test_it_is_normalised_as_in_pytorch_geometric():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script", DeprecationWarning)
        from torch_geometric.nn.conv.gcn_conv import gcn_norm
    edges = np.random.default_rng(0).random((4, 4))
    edges = np.triu(edges, 1) + np.triu(edges, 1).T
    plain = torch.block_diag(*[torch.from_numpy(edges)] * 3)
    later = torch.arange(4, 12)
    plain[later, later - 4] = 1
    target, source = plain.nonzero().T
    index, weights = gcn_norm(torch.stack([source, target]), plain[target, source], num_nodes=12)
    wanted = torch.zeros(12, 12, dtype=torch.float64)
    wanted[index[1], index[0]] = weights.double()
    torch.testing.assert_close(link(torch.from_numpy(normalised(edges)), 3), wanted, atol=1e-6, rtol=1e-6)


def test_news_travel_forward_in_time_only():
    torch.manual_seed(0)
    model = partial(Gcn, widths=[3, 3], pooling="mean", activation="silu")
    fusion = Linked(model, "graph", (2, 1), 5)
    x = torch.zeros(1, 5, 2, 1, requires_grad=True)
    nodes = []
    fusion.model.norms[0].register_forward_hook(lambda *call: nodes.append(call[-1]))
    fusion(Frames(x, torch.from_numpy(normalised(PAIR)).float()))
    hidden = nodes[0].unflatten(0, (5, 2))  # frames, sensors, windows, features after one convolution
    hidden[2].sum().backward()
    assert (x.grad[0, :, :, 0] != 0).any(dim=1).tolist() == [False, True, True, False, False]


def test_images_are_refused():
    with pytest.raises(InputError, match="got image: add representation=graph model=gcn"):
        Linked(Cnn, "image", (1, 64, 64), 30)
