"""Each fusion by itself."""

from functools import partial

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.core.files import CONF
from skin.errors import InputError
from skin.learning.cnn import Cnn
from skin.learning.fusion import HEADS, Linked, link
from skin.learning.graph import Graph, normalised
from skin.learning.model import Gcn, Mlp
from skin.learning.representation import Frames

PAIR = np.array([[0.0, 0.5], [0.5, 0.0]])
# What every fusion must do, whatever model it holds.
OPTIONS = sorted((CONF / "fusion").glob("*.yaml"))
MODELS = {
    "readings": partial(Mlp, widths=[8]),
    "graph": partial(Gcn, widths=[4, 8]),
    "image": partial(Cnn, channels=[4], embedding=8, dropout=0.0),
}
SHAPES = {"readings": (9,), "graph": (9, 2), "image": (2, 16, 16)}
WINDOW = 6
VARIANTS = [
    (path, extra, kind)
    for path in OPTIONS
    for extra in ([{"head": head} for head in HEADS] if path.stem == "late" else [{}])
    for kind in (["graph"] if path.stem == "linked" else MODELS)
]


def test_two_sensors_and_three_frames_by_hand():
    # rows of A + I with the edge from the frame before: 1.5 in the first frame, 2.5 in the others
    a, b, c = 1.5, 2.5, np.sqrt(1.5 * 2.5)
    wanted = [
        [1 / a, 0.5 / a, 0, 0, 0, 0],
        [0.5 / a, 1 / a, 0, 0, 0, 0],
        [1 / c, 0, 1 / b, 0.5 / b, 0, 0],
        [0, 1 / c, 0.5 / b, 1 / b, 0, 0],
        [0, 0, 1 / b, 0, 1 / b, 0.5 / b],
        [0, 0, 0, 1 / b, 0.5 / b, 1 / b],
    ]
    np.testing.assert_allclose(link(torch.from_numpy(normalised(PAIR)), 3), wanted)


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


def windows(kind, length=WINDOW):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(5, length, *SHAPES[kind], generator=generator)
    positions = 0.1 * torch.rand(9, 3, generator=generator)
    return Frames(x, Graph(positions, (0.16, 0.16)).adjacency if kind == "graph" else None)


@pytest.fixture(params=VARIANTS, ids=lambda v: "-".join([v[0].stem, *v[1].values(), v[2]]))
def given(request):
    path, extra, kind = request.param

    def make():
        return instantiate(OmegaConf.load(path), **extra)(MODELS[kind], kind, SHAPES[kind], WINDOW)

    torch.manual_seed(0)
    return make, kind


def test_a_gradient_reaches_every_parameter(given):
    make, kind = given
    fusion = make()
    fusion(windows(kind)).square().sum().backward()
    for name, parameter in fusion.named_parameters():
        assert parameter.grad is not None, name
        # A softmax takes the bias of a score away: that gradient is rounding, and may be 0.
        assert parameter.grad.abs().max() > 0 or name.endswith(("score.bias", "gate.bias")), name


def test_windows_do_not_see_each_other(given):
    make, kind = given
    fusion, (x, adjacency, _) = make().eval(), windows(kind)
    together = fusion(Frames(x, adjacency))
    assert together.shape == (5, fusion.width)
    assert torch.equal(fusion(Frames(x, adjacency)), together)
    torch.testing.assert_close(fusion(Frames(x[1:3], adjacency)), together[1:3])


@pytest.mark.parametrize("length", [1, 4, 11])
def test_windows_of_other_lengths(given, length, request):
    make, kind = given
    fusion = make()
    if "[early" in request.node.name or "-early" in request.node.name:
        with pytest.raises(InputError, match=rf"windows of 6 frames, got {length}: train with fusion=late"):
            fusion(windows(kind, length))
    else:
        assert fusion(windows(kind, length)).shape == (5, fusion.width)
