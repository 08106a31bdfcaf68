"""EfficientNet-B0 on sensor images, trained on photographs or from scratch."""

from collections.abc import Iterator, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from skin.errors import InputError
from skin.model._mbconv import Bottleneck, unit
from skin.model._weights import find_weights, load_weights
from skin.model.base import AbstractModel, Kind

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
        weights: ``imagenet`` (torchvision's file, see :func:`skin.model._weights.find_weights`; nothing is
            downloaded), the path of such a file, or ``random``.
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
