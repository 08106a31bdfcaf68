"""The short cut for images of few sensors is the same network as the long way."""

import hashlib
import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from skin.errors import InputError
from skin.learning import cnn as module
from skin.learning.cnn import HEAD, Cnn, EfficientNet, _FirstMaximum


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
    plan = module.plan_convolution
    monkeypatch.setattr(module, "plan_convolution", lambda given: taken.append(1) or plan(given))
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


# torchvision itself cannot be imported beside this torch: what its ``efficientnet_b0`` (release 0.29.2) holds
# and returns was written down once.
EMBEDDINGS = [  # every 160th of the 1280, in double precision
    [-0.118828, -0.090470, 0.373448, 1.135036, -0.147856, 0.274990, -0.172690, -0.103287],
    [-0.121774, 0.240244, 0.172235, 1.077277, -0.120227, 0.137239, -0.099206, 0.012885],
]
SUMS = [1102.371007, 803.640291]


def noise(shape, number):
    return torch.as_tensor(2 * np.random.default_rng(number).random(shape) - 1)


def value(name, shape, number):
    """Return weights that carry a signal through all layers."""
    if name.endswith("num_batches_tracked"):
        return torch.tensor(0)
    drawn = noise(shape, number)
    if name.endswith("running_var"):
        return (1 + 0.5 * drawn).float()
    if len(shape) == 4:
        return (math.sqrt(6 / math.prod(shape[1:])) * drawn).float()
    return (1 + 0.3 * drawn if name.endswith("weight") and len(shape) == 1 else 0.1 * drawn).float()


@pytest.fixture(scope="module")
def official():
    """A full state dict as torchvision writes it, with made-up numbers."""
    own = EfficientNet("image", (1, 64, 64), weights="random").state_dict()
    shapes = {name: tuple(tensor.shape) for name, tensor in own.items()}
    shapes |= dict(zip(HEAD, [(1000, 1280), (1000,)], strict=True))
    return {name: value(name, shapes[name], number) for number, name in enumerate(sorted(shapes))}


@pytest.fixture
def file(official, tmp_path):
    path = tmp_path / "weights.pth"
    torch.save(official, path)
    return path


def loaded(path, shape=(1, 64, 64), **options):
    return EfficientNet("image", shape, weights=str(path), **options)


def test_names_and_shapes_are_those_of_torchvision(official):
    lines = "\n".join(f"{name} {tuple(official[name].shape)}" for name in sorted(official))
    assert len(official) == 360
    assert hashlib.sha256(lines.encode()).hexdigest().startswith("98a6d92c040c4bca")


def test_the_file_gives_the_embeddings_of_torchvision(file):
    images = noise((2, 1, 64, 64), 1000).float()
    with torch.inference_mode():
        embeddings = loaded(file).eval()(images, None)
    torch.testing.assert_close(embeddings[:, ::160], torch.tensor(EMBEDDINGS), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(embeddings.sum(dim=1), torch.tensor(SUMS), atol=1e-2, rtol=1e-5)


@pytest.mark.parametrize(
    "name", ["efficientnet_b0_rwightman-7f5810bc.pth", "efficientnet_b0_rwightman-3dd342df.pth"]
)
def test_imagenet_is_looked_for_where_torchvision_keeps_it(name, official, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    torch.save(official, folder / name)
    found = EfficientNet("image", (1, 64, 64)).state_dict()
    assert torch.equal(found["features.0.0.weight"], official["features.0.0.weight"])


def test_without_imagenet_a_sentence_says_where_to_put_it(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(InputError) as error:
        EfficientNet("image", (1, 64, 64))
    for words in (
        f"no weights file {tmp_path}/hub/checkpoints/efficientnet_b0_rwightman-7f5810bc.pth: put",
        "model.weights=FILE.pth",
        "model.weights=random trains from scratch",
    ):
        assert words in str(error.value)


class Code:
    """An object whose unpickling runs code."""

    def __reduce__(self):
        return exec, ("raise SystemExit('ran')",)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(path.read_bytes()[:1_000_000]),
        lambda path: path.write_text("<html>404: no such file</html>"),
        lambda path: torch.save({"features.0.0.weight": Code()}, path),
    ],
    ids=["cut off", "a page", "code"],
)
def test_a_file_that_cannot_be_read_is_refused_and_runs_nothing(spoil, file):
    spoil(file)
    match = rf"cannot read the weights file {file}: it is damaged, .*get it again"
    with pytest.raises(InputError, match=match) as error:
        loaded(file)
    assert "weights_only" not in str(error.value)


def altered(name, tensor):
    return lambda state: state | {name: tensor}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: {name: state[name] for name in [*state][:-20]}, r"Missing key.*features\.7"),
        (altered("layer4.bias", torch.zeros(3)), r"Unexpected key.*layer4\.bias"),
        (lambda state: {"state_dict": state}, "Missing key.*features"),
        (lambda state: list(state), "does not fit: .*items"),
        (lambda state: {}, "Missing key.*features"),
        (altered("features.0.0.weight", torch.zeros(40, 3)), r"mismatch for features\.0\.0\.w.*40, 3.*32, 3"),
        (altered("features.0.1.bias", torch.full((32,), math.nan)), r"features\.0\.1\.bias.* not finite"),
    ],
    ids=["missing", "foreign", "wrapped", "list", "empty", "shape", "nan"],
)
def test_other_weights_are_refused_by_name(change, words, official, file):
    torch.save(change(official), file)
    with pytest.raises(InputError, match=rf"{file} .*{words}.*model\.weights=random"):
        loaded(file)
