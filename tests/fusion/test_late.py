"""Late fusion: which heads know the order of frames."""

from functools import partial

import pytest
import torch

from skin.errors import InputError
from skin.fusion.late import Late
from skin.model.gcn import Gcn
from skin.model.mlp import Mlp
from skin.representation.base import Frames

MODEL = partial(Mlp, widths=[8])


@pytest.mark.parametrize("head", ["mean", "max", "conv", "lstm", "gru", "attention+gru"])
def test_only_mean_and_max_forget_the_order(head):
    torch.manual_seed(0)
    fusion = Late(MODEL, "readings", (4,), 6, head=head)
    x = torch.randn(3, 6, 4)
    same = torch.allclose(fusion(Frames(x.flip(1), None)), fusion(Frames(x, None)), atol=1e-6)
    assert same == (head in ("mean", "max"))


def test_a_graph_per_frame_is_taken():
    torch.manual_seed(0)
    fusion = Late(partial(Gcn, widths=[5]), "graph", (7, 1), 4, head="max")
    x, adjacency = torch.randn(2, 4, 7, 1), torch.rand(7, 7)
    torch.testing.assert_close(fusion(Frames(x, adjacency.expand(2, 4, 7, 7))), fusion(Frames(x, adjacency)))


def test_an_unknown_head_is_refused():
    with pytest.raises(
        InputError, match=r"fusion\.head to one of mean, max, conv, lstm, gru, attention\+gru"
    ):
        Late(MODEL, "readings", (4,), 6, head="transformer")
