"""EfficientNet-B0 against torchvision's, and the door for files of weights.

torchvision itself cannot be imported beside this torch. What its ``efficientnet_b0`` (release 0.29.2) holds
and returns was written down once; its numbers are the literals below.
"""

import hashlib
import math

import numpy as np
import pytest
import torch

from skin.errors import InputError
from skin.learning.cnn import HEAD, EfficientNet

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
        (
            altered("features.0.0.weight", torch.zeros(40, 3)),
            r"size mismatch for features\.0\.0\.w.*40, 3.*32, 3",
        ),
        (altered("features.0.1.bias", torch.full((32,), math.nan)), r"features\.0\.1\.bias.* not finite"),
    ],
    ids=["missing", "foreign", "wrapped", "list", "empty", "shape", "nan"],
)
def test_other_weights_are_refused_by_name(change, words, official, file):
    torch.save(change(official), file)
    with pytest.raises(InputError, match=rf"{file} .*{words}.*model\.weights=random"):
        loaded(file)
