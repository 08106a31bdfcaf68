"""Late fusion: which heads know the order of frames."""

import math
from functools import partial

import pytest
import torch

from skin.errors import InputError
from skin.learning.fusion import HEADS, Late, positions
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


def test_a_graph_per_frame_is_taken():
    torch.manual_seed(0)
    fusion = Late(partial(Gcn, widths=[5]), "graph", (7, 1), 4, head="max")
    x, adjacency = torch.randn(2, 4, 7, 1), torch.rand(7, 7)
    torch.testing.assert_close(fusion(Frames(x, adjacency.expand(2, 4, 7, 7))), fusion(Frames(x, adjacency)))


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
