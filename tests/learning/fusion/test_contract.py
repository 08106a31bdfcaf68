"""What every fusion must do, whatever model it holds."""

from functools import partial
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.errors import InputError
from skin.learning.cnn import Cnn
from skin.learning.fusion import HEADS
from skin.learning.graph import Graph
from skin.learning.model import Gcn, Mlp
from skin.learning.representation import Frames

OPTIONS = sorted((Path(__file__).parents[3] / "conf" / "fusion").glob("*.yaml"))
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


def test_a_window_becomes_one_embedding(given):
    make, kind = given
    fusion = make()
    assert fusion(windows(kind)).shape == (5, fusion.width)


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
    assert torch.equal(fusion(Frames(x, adjacency)), together)
    torch.testing.assert_close(fusion(Frames(x[1:3], adjacency)), together[1:3])


def test_weights_reload(given):
    make, kind = given
    fusion, other, frames = make().eval(), make().eval(), windows(kind)
    assert not torch.equal(other(frames), fusion(frames))
    other.load_state_dict(fusion.state_dict())
    assert torch.equal(other(frames), fusion(frames))


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("kind", MODELS)
def test_late_fusion_trained_on_30_frames_takes_20_and_60(kind, head):
    torch.manual_seed(0)
    late = next(path for path in OPTIONS if path.stem == "late")
    fusion = instantiate(OmegaConf.load(late), head=head)(MODELS[kind], kind, SHAPES[kind], 30)
    optimizer = torch.optim.Adam(fusion.parameters())
    fusion(windows(kind, 30)).square().sum().backward()
    optimizer.step()
    fusion.eval()
    x, adjacency, _ = windows(kind, 60)
    short, long = fusion(Frames(x[:, :20], adjacency)), fusion(Frames(x, adjacency))
    assert short.shape == long.shape == (5, fusion.width)
    assert torch.isfinite(short).all()
    assert torch.isfinite(long).all()
    assert not torch.allclose(short, long)  # the frames after the 20th are not overlooked


@pytest.mark.parametrize("length", [1, 4, 11])
def test_windows_of_other_lengths(given, length, request):
    make, kind = given
    fusion = make()
    if "[early" in request.node.name or "-early" in request.node.name:
        with pytest.raises(InputError, match=rf"windows of 6 frames, got {length}: train with fusion=late"):
            fusion(windows(kind, length))
    else:
        assert fusion(windows(kind, length)).shape == (5, fusion.width)
