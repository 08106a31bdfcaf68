"""The transformer over sensors: an encoder layer typed out, and what does not matter to it."""

import math

import pytest
import torch
from torch.nn import functional as F

from skin.errors import InputError
from skin.learning.model import Transformer

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


@pytest.mark.parametrize("pooling", ["mean", "max"])
def test_the_order_of_the_sensors_does_not_matter(pooling):
    model, x, order = transformer(pooling=pooling), torch.randn(4, 8, 3), torch.randperm(8)
    torch.testing.assert_close(model(x[:, order], NO_EDGES), model(x, NO_EDGES))


@pytest.mark.parametrize("sensors", [1, 5, 30])
def test_any_number_of_sensors_is_taken(sensors):
    assert transformer()(torch.randn(4, sensors, 3), torch.eye(sensors)).shape == (4, 12)


def test_sensors_look_at_each_other():
    # the mean of tokens that did not would change by the same whatever the other sensor reads
    model, x = transformer(), torch.zeros(4, 2, 3)
    x[1, 0], x[2, 1], x[3, :] = 1, 2, torch.tensor([[1.0], [2.0]])
    none, first, second, both = model(x, torch.eye(2))
    assert not torch.allclose(both - second, first - none, atol=1e-3)


def test_layers_start_different():
    first, second = transformer().encoder.layers
    assert not torch.equal(first.linear1.weight, second.linear1.weight)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"width": 10},
            "4 heads of attention must share the width equally, got model.width=10: set model.width=12",
        ),
        ({"layers": 0}, "model.layers=0 must be greater than 0"),
        ({"pooling": "attention"}, "model.pooling=attention must be 'mean' or 'max'"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        transformer(**options)
