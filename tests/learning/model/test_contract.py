"""What every model must do."""

import re
from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.errors import InputError
from skin.learning.graph import Graph

OPTIONS = sorted((Path(__file__).parents[3] / "conf" / "model").glob("*.yaml"))
NETWORKS = {
    "GCN": {},
    "GIN": {},
    "GAT": {"heads": 4, "v2": True},
    "PNA": {"aggregators": ["mean", "max", "std"], "scalers": ["identity", "amplification"]},
}
CHANGES = {
    "gcn": [
        {"pooling": "max", "norm": "batch", "activation": "relu"},
        {"pooling": "mean", "norm": "layer", "activation": "elu"},
        {"pooling": "set2set", "norm": "instance"},
        {"widths": [40, 8]},
    ],
    "cnn": [{"channels": [4], "embedding": None}, {"repeat": 3}],
    "transformer": [{"pooling": "max", "layers": 1, "heads": 1}],
    "pyg": [
        {"network": {"_target_": f"torch_geometric.nn.models.{name}"} | extra}
        for name, extra in NETWORKS.items()
    ],
    "mlp": [{"widths": [5], "activation": "silu"}],
}
# Biases, kept because the original has them: a softmax takes the first away, a norm behind them the others.
WITHOUT_EFFECT = (r"gate\.bias$", r"(convolutions|block)\.\d[.\d]*\.bias$")
# trained weights are a file that a test cannot count on
NEEDED = {"efficientnet": {"weights": "random"}}
VARIANTS = [
    (path, NEEDED.get(path.stem, {}) | extra)
    for path in OPTIONS
    for extra in ({}, *CHANGES.get(path.stem, []))
]


def frames(kind, count=6, seed=0):
    """Return the shape of one frame, frames of that kind and their adjacency."""
    generator = torch.Generator().manual_seed(seed)
    shape = {"image": (3, 24, 24), "graph": (9, 3), "readings": (11,)}[kind]
    x = torch.randn(count, *shape, generator=generator)
    positions = 0.1 * torch.rand(9, 3, generator=generator)
    return shape, x, Graph(positions, (0.16, 0.16)).adjacency if kind == "graph" else None


@pytest.fixture(params=VARIANTS, ids=lambda v: "-".join([v[0].stem, *map(str, v[1].values())]))
def make(request):
    path, extra = request.param
    torch.manual_seed(0)
    return instantiate(OmegaConf.load(path), **extra)


@pytest.fixture
def given(make):
    kind = make.func.takes
    shape, x, adjacency = frames(kind)
    return make(kind, shape), x, adjacency


def test_it_encodes_frames_to_its_width(given):
    model, x, adjacency = given
    assert model(x, adjacency).shape == (6, model.width)


def test_a_gradient_reaches_every_parameter(given, request):
    """In double precision: what changes nothing has a gradient of rounding size, which only may be 0."""
    model, x, adjacency = given
    model.double().train()
    model(x.double(), None if adjacency is None else adjacency.double()).square().sum().backward()
    maximum = {name: one.grad.abs().max().item() for name, one in model.named_parameters()}
    idle = {name for name, size in maximum.items() if size < 1e-12 * max(maximum.values())}
    normed = re.search("^efficientnet|batch|instance", request.node.callspec.id)
    known = WITHOUT_EFFECT if normed else WITHOUT_EFFECT[:1]
    assert all(any(re.search(one, name) for one in known) for name in idle), idle


def test_frames_do_not_see_each_other(given):
    model, x, adjacency = given
    together = model.eval()(x, adjacency)
    assert torch.equal(model(x, adjacency), together)
    torch.testing.assert_close(model(x[2:3], adjacency), together[2:3])


def test_other_kinds_are_refused_with_the_override_that_mends_it(make, request):
    name = request.node.callspec.params["make"][0].stem
    takes = make.func.takes
    for kind in {"image", "graph", "readings"} - {takes}:
        with pytest.raises(InputError) as error:
            make(kind, frames(kind)[0])
        assert str(error.value) == (
            f"model={name} needs representation={takes}, got {kind}: add representation={takes}"
        )
