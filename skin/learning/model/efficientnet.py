"""EfficientNet-B0 on sensor images, trained on photographs or from scratch."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from skin.core.files import candidates
from skin.errors import InputError
from skin.learning.model.base import AbstractModel, Kind

# The inverted bottlenecks that EfficientNet is made of, named as in torchvision's weight files.


def unit(
    inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1, active: bool = True
) -> nn.Sequential:
    """Return a convolution that keeps the size (at stride 1), batch norm and, where ``active``, SiLU."""
    layers = [
        nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
    ]
    return nn.Sequential(*layers, *([nn.SiLU(inplace=True)] if active else []))


class SqueezeExcitation(nn.Module):
    """Weights each channel by a small network of all channels' means (Hu et al., 2018)."""

    def __init__(self, channels: int, squeezed: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(channels, squeezed, 1)
        self.fc2 = nn.Conv2d(squeezed, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return x (N, C, H, W), weighted."""
        means = x.mean(dim=(2, 3), keepdim=True)
        return x * self.fc2(F.silu(self.fc1(means))).sigmoid()


class Bottleneck(nn.Module):
    """Widen, filter each channel by itself, weight the channels, narrow (Sandler et al., 2018).

    Args:
        inputs: channels.
        outputs: channels.
        kernel: of the channels' filters.
        stride: of the channels' filters.
        ratio: by which the channels are widened.
        skipped: share of images for which a residual block does nothing in training (Huang et al., 2016).
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, ratio: int, skipped: float
    ) -> None:
        super().__init__()
        wide = ratio * inputs
        self.block = nn.Sequential(
            *([unit(inputs, wide)] if ratio > 1 else []),
            unit(wide, wide, kernel, stride, groups=wide),
            SqueezeExcitation(wide, inputs // 4),
            unit(wide, outputs, active=False),
        )
        self.residual = stride == 1 and inputs == outputs
        self.skipped = skipped

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, outputs, H / stride, W / stride), rounded up, of x (N, inputs, H, W)."""
        result = self.block(x)
        if not self.residual:
            return result
        keep = F.dropout(x.new_ones(len(x), 1, 1, 1), self.skipped, self.training)
        return torch.addcmul(x, result, keep)


# Files of trained weights: where they lie, and whether they fit.


_OFFICIAL = "efficientnet_b0_rwightman-7f5810bc.pth"
_SOURCE = f"https://download.pytorch.org/models/{_OFFICIAL}"
_WAYS = "model.weights=random trains from scratch"


def find_weights(weights: str) -> Path:
    """Return the file that ``model.weights`` stands for.

    Args:
        weights: a path, looked for in the current folder, then beside the package; or ``imagenet``:
            torchvision's file of EfficientNet-B0 in ``hub/checkpoints`` of ``$TORCH_HOME``, where torchvision
            itself would keep it.

    Raises:
        InputError: there is no such file.
    """
    if weights == "imagenet":
        folder = Path(torch.hub.get_dir()).expanduser() / "checkpoints"
        # the official one first, then older or newer ones
        named = [folder / _OFFICIAL, *sorted(folder.glob("efficientnet_b0*.pth"))]
        missing = (
            f"model.weights=imagenet needs {_OFFICIAL} in {folder}, which is not there: "
            f"put it there from {_SOURCE}, or give model.weights=FILE.pth; {_WAYS}"
        )
    else:
        named = candidates(weights)
        looked = " and ".join(dict.fromkeys(map(str, named)))
        missing = (
            f"no weights file {weights}: looked for {looked}; "
            f"give model.weights=FILE.pth or model.weights=imagenet; {_WAYS}"
        )
    file = next((path for path in named if path.is_file()), None)
    if file is None:
        raise InputError(missing)
    return file


def load_weights(module: nn.Module, path: Path, spare: tuple[str, ...]) -> None:
    """Give a module the weights of a file, without running code that the file may hold.

    Args:
        module: takes all of them or none.
        path: of a state dict.
        spare: names that the file may hold and the module has no use for.

    Raises:
        InputError: the file cannot be read, is no state dict, or holds other weights than the module has.
    """
    content, state = _read(path), module.state_dict()
    if wrong := _unfit(content, state, spare):
        raise InputError(
            f"the weights file {path} {wrong}: model=efficientnet needs the state dict of torchvision's "
            f"efficientnet_b0; {_WAYS}"
        )
    module.load_state_dict(state | {name: content[name] for name in content if name not in spare})


def _read(path: Path) -> Any:
    try:
        return torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises nearly anything on a file that it cannot read
        # torch's own words would advise to run the code in the file
        reason = error.strerror if isinstance(error, OSError) else "it is damaged, or holds more than tensors"
        raise InputError(f"cannot read the weights file {path}: {reason}; get it again; {_WAYS}") from error


def _unfit(content: Any, state: dict[str, Tensor], spare: tuple[str, ...]) -> str:
    """Return what is wrong with the content of a file; empty if it fits."""
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        return "is no state dict (names and tensors)"
    stored = {name: value for name, value in content.items() if name not in spare}
    # they count batches for a momentum that is not used; files older than torch 0.4.1 have none
    missing = [name for name in state if name not in stored and not name.endswith("num_batches_tracked")]
    foreign = [name for name in stored if name not in state]
    if missing or foreign:
        return " and ".join(filter(None, [_listed("lacks", missing), _listed("has the unknown", foreign)]))
    for name, value in stored.items():
        if value.shape != state[name].shape:
            return f"has {name} of shape {tuple(value.shape)} where {tuple(state[name].shape)} is needed"
        if not value.isfinite().all():
            return f"has numbers in {name} that are not finite"
    return ""


def _listed(verb: str, names: list[str]) -> str:
    remainder = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{verb} {', '.join(names[:3])}{remainder}" if names else ""


# Table 1 of Tan and Le (2019): ratio, kernel, stride of the first block, channels, blocks
STAGES = (
    (1, 3, 1, 16, 1),
    (6, 3, 2, 24, 2),
    (6, 5, 2, 40, 2),
    (6, 3, 2, 80, 3),
    (6, 5, 1, 112, 3),
    (6, 5, 2, 192, 4),
    (6, 3, 1, 320, 1),
)
WIDTH = 1280
SKIPPED = 0.2  # share of images that would skip a block after the last one
HEAD = ("classifier.1.weight", "classifier.1.bias")  # of the thousand classes, not used here
CHUNK = 256  # images at a time where no gradient is asked for: bounds memory to a few hundred MB


class EfficientNet(AbstractModel):
    """EfficientNet-B0 (Tan and Le, 2019) without its classification layer (report, 3.2.5).

    Accepts any layout and image size with the same weights. Training needs about 9 MB and 5 ms of a core per
    frame of 64 x 64. Use small batches (``data.batch_size=8``) and, without a GPU, few data
    (``data.gestures``, ``representation.pixels``). Frozen weights need a fifth of the time and little memory.

    Args:
        kind: must be ``image``.
        shape: (C, H, W) with C = 1, fed three times, or C = 3.
        weights: ``imagenet`` (torchvision's file, see :func:`skin.learning.model.efficientnet.find_weights`;
            nothing is downloaded), the path of such a file, or ``random``.
        frozen: keep the weights and the statistics of batch norm as they are.
        dropout: share of the embedding dropped in training.

    Raises:
        InputError: not an image, a number of channels that three is no multiple of, or no fitting weights.
    """

    takes: ClassVar[Kind] = "image"
    mean: Tensor
    spread: Tensor

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        weights: str = "imagenet",
        frozen: bool = False,
        dropout: float = 0.2,
    ) -> None:
        super().__init__(kind)
        if shape[0] not in (1, 3):
            raise InputError(
                f"model=efficientnet needs images of 1 or 3 channels, got {shape[0]}: "
                "set fusion=late and representation.mask=false"
            )
        self.frozen, self.dropout, self.width = frozen, dropout, WIDTH
        # of ImageNet's photographs: what the weights were trained on
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406])[:, None, None], persistent=False)
        self.register_buffer("spread", torch.tensor([0.229, 0.224, 0.225])[:, None, None], persistent=False)
        self.features = nn.Sequential(unit(3, 32, 3, 2), *_stages(), unit(STAGES[-1][3], WIDTH))
        if weights == "random":
            self.features.apply(_start)
        else:
            load_weights(self, find_weights(weights), spare=HEAD)
        self.requires_grad_(not frozen)
        self.train()

    def train(self, mode: bool = True) -> "EfficientNet":
        """Set training mode, in which a frozen encoder stays as it is."""
        super().train(mode)
        self.features.train(mode and not self.frozen)
        return self

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, 1280) of images (N, C, H, W)."""
        parts = [x] if self.features.training else x.split(CHUNK)
        embedding = torch.cat([self._encode(part) for part in parts])
        return F.dropout(embedding, self.dropout, self.training)

    def _encode(self, x: Tensor) -> Tensor:
        x = (x - self.mean) / self.spread  # a single channel becomes three
        x = x.contiguous(memory_format=torch.channels_last)  # 1.7 times faster
        return self.features(x).mean(dim=(2, 3))


def _stages() -> Iterator[nn.Sequential]:
    total, number, inputs = sum(stage[-1] for stage in STAGES), 0, 32
    for ratio, kernel, stride, outputs, count in STAGES:
        blocks = []
        for first in (True, *[False] * (count - 1)):
            step = stride if first else 1
            blocks.append(Bottleneck(inputs, outputs, kernel, step, ratio, SKIPPED * number / total))
            inputs, number = outputs, number + 1
        yield nn.Sequential(*blocks)


def _start(module: nn.Module) -> None:
    """Draw the weights of a convolution as in torchvision (He et al., 2015, by fan-out)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out")
        if module.bias is not None:
            nn.init.zeros_(module.bias)
