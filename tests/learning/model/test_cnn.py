"""The short cut for images of few sensors is the same network as the long way."""

import pytest
import torch
from torch.nn import functional as F

from skin.learning import cnn as module
from skin.learning.cnn import Cnn, _FirstMaximum


def scattered(channels=1, pixels=64, sensors=25, count=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    where = torch.randperm(pixels * pixels, generator=generator)[:sensors]
    x = torch.zeros(count, channels, pixels * pixels)
    x[:, :, where] = torch.randn(count, channels, sensors, generator=generator)
    return x.unflatten(-1, (pixels, pixels))


def embed(model, x, sparse):
    """Return embeddings and gradients by the method that ``sparse`` chooses."""
    model.sparse = sparse
    model.zero_grad()
    result = model(x, None)
    result.square().sum().backward()
    return result.detach(), [parameter.grad.clone() for parameter in model.parameters()]


@pytest.mark.parametrize(
    ("given", "options"),
    [
        (scattered(), {"channels": [8, 16], "repeat": 3, "embedding": 32}),
        (scattered(channels=6), {"channels": [16, 32]}),
        (scattered(pixels=48, sensors=12), {"channels": [4, 5, 6]}),
        (scattered(sensors=60), {"channels": [8], "embedding": 7}),
        (0 * scattered(), {"channels": [8, 16], "embedding": 7}),
    ],
    ids=["sequence", "early", "three blocks", "crowded", "idle"],
)
def test_few_pixels_give_what_all_pixels_give(given, options, monkeypatch):
    torch.manual_seed(0)
    model = Cnn("image", given.shape[1:], **options).eval()
    assert 32 * int((given != 0).flatten(0, 1).any(0).sum()) < 64 * 64
    taken = []
    monkeypatch.setattr(
        module, "plan_convolution", lambda a, plan=module.plan_convolution: taken.append(1) or plan(a)
    )
    short, short_gradients = embed(model, given, 32)
    assert len(taken) == len(options["channels"])
    long, long_gradients = embed(model, given, float("inf"))
    assert len(taken) == len(options["channels"])
    assert (short - long).abs().max() < 1e-5
    for ours, theirs in zip(short_gradients, long_gradients, strict=True):
        assert (ours - theirs).abs().max() <= 2e-5 * max(1, float(theirs.abs().max()))


def test_it_is_the_network_that_the_report_describes():
    torch.manual_seed(0)
    x = scattered()
    model = Cnn("image", (1, 64, 64), channels=[8, 16], repeat=3, embedding=32).eval()
    first, second = model.convolutions
    assert first.weight.shape == (8, 3, 3, 3)
    wanted = F.max_pool2d(F.relu(first(x.repeat(1, 3, 1, 1))), 2)
    wanted = F.max_pool2d(F.relu(second(wanted)), 2).flatten(1)
    torch.testing.assert_close(model(x, None), F.relu(model.embedding(wanted)), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("sparse", [32, float("inf")], ids=["short", "long"])
def test_dropout_takes_whole_channels_of_single_images(sparse):
    torch.manual_seed(0)
    x = scattered(count=40)
    model = Cnn("image", (1, 64, 64), channels=[10], dropout=0.2, sparse=sparse)
    kept = model.eval()(x, None).unflatten(1, (10, -1))
    dropped = model.train()(x, None).unflatten(1, (10, -1))
    gone = (dropped == 0).all(dim=2)
    alive = (kept != 0).any(dim=2)
    assert 0.1 < gone[alive].float().mean() < 0.3
    assert gone[alive].float().std() > 0
    torch.testing.assert_close(dropped[~gone], kept[~gone] / 0.8)


def test_the_gradient_of_a_tie_goes_to_the_first_maximum():
    x = torch.randint(0, 2, (3, 4, 5, 7)).double().requires_grad_()
    _FirstMaximum.apply(x).square().sum().backward()
    plain = x.detach().clone().requires_grad_()
    F.max_pool2d(plain.permute(0, 2, 3, 1), (1, 4)).square().sum().backward()
    assert torch.equal(x.grad, plain.grad)
