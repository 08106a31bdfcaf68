"""Each fusion by itself."""

import math
import warnings
from functools import partial

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.learning.cnn import Cnn
from skin.learning.fusion import HEADS, Early, Late, Linked, link, positions
from skin.learning.graph import normalised
from skin.learning.model import Gcn, Mlp
from skin.learning.representation import Frames

MODEL = partial(Mlp, widths=[8])


@pytest.mark.parametrize("head", HEADS)
def test_only_mean_and_max_forget_the_order(head):
    torch.manual_seed(0)
    fusion = Late(MODEL, "readings", (4,), 6, head=head).eval()
    x = torch.randn(3, 6, 4)
    same = torch.allclose(fusion(Frames(x.flip(1), None)), fusion(Frames(x, None)), atol=1e-6)
    assert same == (head in ("mean", "max"))


def test_an_unknown_head_is_refused():
    names = r"'mean', 'max', 'conv', 'lstm', 'gru', 'attention\+gru', 'residual' or 'transformer'"
    with pytest.raises(InputError, match=rf"fusion\.head=tcn must be {names}"):
        Late(MODEL, "readings", (4,), 6, head="tcn")


@pytest.mark.parametrize(
    ("head", "hidden", "words"),
    [
        ("transformer", 30, r"got fusion\.hidden=30: set fusion\.hidden=32"),
        ("gru", 0, r"fusion.hidden=0 must be greater than 0: as in fusion.hidden=64"),
        ("transformer", -4, r"fusion.hidden=-4 must be greater than 0"),
    ],
)
def test_a_width_that_a_head_cannot_have_is_refused(head, hidden, words):
    with pytest.raises(InputError, match=words):
        Late(MODEL, "readings", (4,), 6, head=head, hidden=hidden)


def test_positions_of_frames_by_hand():
    sin, cos = math.sin, math.cos
    wanted = [[sin(t), cos(t), sin(t / 100), cos(t / 100)] for t in range(3)]
    torch.testing.assert_close(positions(3, 4), torch.tensor(wanted))


def test_a_transformer_looks_back_over_the_whole_window():
    torch.manual_seed(0)
    head = HEADS["transformer"](4, 8).eval()
    x = torch.zeros(1, 60, 4, requires_grad=True)
    states = []
    head.encoder.register_forward_hook(lambda *call: states.append(call[-1]))
    head(x)
    # Not the sum: the layer's norm keeps that at 0, and its gradient would be rounding.
    states[0][0, 59, 0].backward()
    assert (x.grad[0].abs().amax(dim=1) > 1e-6).all()


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
