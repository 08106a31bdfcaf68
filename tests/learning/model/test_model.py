"""What every model must do; graph networks against PyTorch Geometric, and the transformer by hand."""

import math
import re
import warnings
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch.nn import functional as F

from skin.core.files import CONF
from skin.errors import InputError
from skin.learning.graph import Graph, adjacency, neighbours, normalised
from skin.learning.model import POOLINGS, Gcn, Pyg, Transformer, _InstanceNorm

PLACES = 0.1 * np.random.default_rng(0).random((8, 3))
EDGES = adjacency(PLACES, neighbours(PLACES, "knn", 3), "exp")
MATRIX = torch.from_numpy(normalised(EDGES)).float()


@contextmanager
def quiet():
    """Bear the warnings that PyTorch Geometric gives when it is imported."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script", DeprecationWarning)
        yield


def gcn(**options):
    torch.manual_seed(0)
    return Gcn("graph", (8, 2), **({"widths": [16, 5]} | options)).eval()


@pytest.mark.parametrize(("features", "width"), [(3, 7), (7, 3)])
def test_one_convolution_is_that_of_pytorch_geometric(features, width):
    with quiet():
        from torch_geometric.nn import GCNConv
    model = Gcn("graph", (8, features), widths=[width], activation="relu", pooling="max")
    theirs = GCNConv(features, width)
    theirs.lin.weight.data = model.convolutions[0].linear.weight.data
    theirs.bias.data = model.convolutions[0].bias.data.normal_()
    x = torch.randn(8, features)
    weights = torch.from_numpy(EDGES).float()
    index = weights.nonzero().T
    wanted = theirs(x, index, weights[index[0], index[1]]).relu().amax(dim=0)
    torch.testing.assert_close(model(x[None], MATRIX)[0], wanted)


def test_one_layer_of_gcn_is_the_dense_product_with_the_adjacency():
    with quiet():
        from torch_geometric.nn.models import GCN
    model, x = Pyg("graph", (8, 2), GCN, width=4, layers=1, pooling="mean"), torch.randn(3, 8, 2)
    convolution = model.network.convs[0]
    expected = (MATRIX @ x @ convolution.lin.weight.T + convolution.bias).mean(dim=1)
    torch.testing.assert_close(model(x, MATRIX), expected)


def plain(nodes):
    """Return nodes (S, N, F) as PyTorch Geometric lists them, (N S, F), and the graph of each."""
    return nodes.transpose(0, 1).flatten(0, 1), torch.arange(nodes.shape[1]).repeat_interleave(len(nodes))


def test_instance_norm_is_that_of_pytorch_geometric():
    with quiet():
        from torch_geometric.nn import InstanceNorm
    torch.manual_seed(0)
    ours, theirs = _InstanceNorm(5), InstanceNorm(5, affine=True)
    theirs.weight.data, theirs.bias.data = ours.weight.data.normal_(), ours.bias.data.normal_()
    nodes = 3 + 2 * torch.randn(8, 4, 5)
    wanted = theirs(*plain(nodes)).unflatten(0, (4, 8)).transpose(0, 1)
    torch.testing.assert_close(ours(nodes), wanted)


@pytest.mark.parametrize("name", POOLINGS)
def test_a_pooling_is_that_of_pytorch_geometric(name):
    with quiet():
        from torch_geometric.nn import aggr
    ours = POOLINGS[name](5)
    if name == "set2set":
        theirs = aggr.Set2Set(5, processing_steps=3)
        weights = {f"{key}_l0": value for key, value in ours.lstm.state_dict().items()}
        theirs.lstm.load_state_dict(weights)
    elif name == "attention":
        theirs = aggr.AttentionalAggregation(ours.gate)
    else:
        theirs = {"max": aggr.MaxAggregation, "mean": aggr.MeanAggregation}[name]()
    nodes = torch.randn(8, 4, 5)
    assert ours(nodes).shape == (4, ours.width)
    torch.testing.assert_close(theirs(*plain(nodes), dim_size=4), ours(nodes))


def test_a_graph_of_one_sensor_can_be_normed():
    model = gcn(norm="instance").train()
    assert torch.isfinite(model(torch.randn(4, 1, 2), torch.ones(1, 1))).all()


NO_EDGES = torch.eye(8)


def transformer(**options):
    torch.manual_seed(0)
    return Transformer("graph", (8, 3), **({"width": 12, "feedforward": 20} | options)).eval()


def layer_by_hand(layer, x, heads):
    """Return x + attention(norm(x)), then that + dense(norm(that)), head by head."""
    y = layer.norm1(x)
    query, key, value = F.linear(y, layer.self_attn.in_proj_weight, layer.self_attn.in_proj_bias).chunk(3, -1)
    width = x.shape[-1] // heads
    parts = []
    for head in range(heads):
        mine = slice(head * width, (head + 1) * width)
        fraction = torch.einsum("nsd,ntd->nst", query[..., mine], key[..., mine]) / math.sqrt(width)
        fraction = fraction.exp() / fraction.exp().sum(dim=-1, keepdim=True)
        parts.append(torch.einsum("nst,ntd->nsd", fraction, value[..., mine]))
    x = x + layer.self_attn.out_proj(torch.cat(parts, dim=-1))
    return x + layer.linear2(F.gelu(layer.linear1(layer.norm2(x))))


@pytest.mark.parametrize("pooling", ["mean", "max"])
@pytest.mark.parametrize("context", [torch.enable_grad, torch.inference_mode])
def test_it_is_the_encoder_that_the_formulas_describe(pooling, context):
    model, x = transformer(heads=3, pooling=pooling), torch.randn(4, 8, 3)
    tokens = model.tokens(x)
    for layer in model.encoder.layers:
        tokens = layer_by_hand(layer, tokens, 3)
    tokens = model.encoder.norm(tokens)
    wanted = tokens.amax(dim=1) if pooling == "max" else tokens.mean(dim=1)
    with context():
        torch.testing.assert_close(model(x, NO_EDGES), wanted, atol=1e-5, rtol=1e-5)


OPTIONS = sorted((CONF / "model").glob("*.yaml"))
PYG = "torch_geometric.nn.models"
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
    "pyg": [{"network": {"_target_": f"{PYG}.{name}"} | extra} for name, extra in NETWORKS.items()],
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
        wanted = f"representation={takes}"
        assert str(error.value) == f"model={name} needs {wanted}, got {kind}: add {wanted}"
