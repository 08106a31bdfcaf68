"""A convolutional network on sensor images."""

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from skin.errors import InputError
from skin.model._sparse import Cells, convolve_and_pool, dense, linear, plan_convolution
from skin.model.base import AbstractModel, Kind

SPARSE = 32  # images with fewer than one active pixel in so many go the short way


class Cnn(AbstractModel):
    """Blocks of 3x3 convolution, 2x2 max pooling, ReLU and spatial dropout (report, 3.2.3 and 3.2.5).

    Accepts any layout with the same weights. Sparse images (``representation=image``) are computed by a
    faster, exact method; see :mod:`skin.model._sparse`.

    Args:
        kind: must be ``image``.
        shape: (C, H, W).
        channels: of the blocks.
        repeat: number of copies of the image in the input of the first block, 3 in the report; computed as
            one convolution with summed weights.
        embedding: width of a dense layer on the flattened blocks; None: the flattened blocks are the
            embedding.
        dropout: share of channels dropped after each block in training.

    Raises:
        InputError: not an image, no block, or an image too small for the blocks.
    """

    takes: ClassVar[Kind] = "image"

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        channels: Sequence[int] = (16, 32),
        repeat: int = 1,
        embedding: int | None = None,
        dropout: float = 0.2,
    ) -> None:
        super().__init__(kind)
        self.repeat, self.dropout = repeat, dropout
        size = list(shape[1:])
        for _ in channels:
            size = [(edge - 2) // 2 for edge in size]
        if not channels or min(size) < 1:
            raise InputError(
                f"model=cnn cannot take {len(channels)} blocks from an image of "
                f"{shape[1]} x {shape[2]} pixels: set model.channels=[16,32] and representation.pixels=64"
            )
        widths = [repeat * shape[0], *channels]
        self.convolutions = nn.ModuleList(nn.Conv2d(before, after, 3) for before, after in pairwise(widths))
        flat = channels[-1] * size[0] * size[1]
        self.embedding = None if embedding is None else nn.Linear(flat, embedding)
        self.width = flat if embedding is None else embedding

    def forward(self, x: Tensor, adjacency: Tensor | None) -> Tensor:
        """Return the embeddings (N, E) of images (N, C, H, W)."""
        if torch.compiler.is_exporting():  # an exported graph cannot depend on the values
            return self._dense(x)
        active = x.abs().amax(dim=(0, 1)) != 0
        if SPARSE * int(active.sum()) < active.numel():
            return self._sparse(x, active)
        return self._dense(x)

    def _weights(self) -> list[tuple[Tensor, Tensor]]:
        """Return weight and bias of each block, equal input channels as one with summed weights."""
        pairs = [(layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in self.convolutions]
        weight, bias = pairs[0]
        return [(weight.unflatten(1, (self.repeat, -1)).sum(dim=1), bias), *pairs[1:]]

    def _dense(self, x: Tensor) -> Tensor:
        x = x.contiguous(memory_format=torch.channels_last)
        for weight, bias in self._weights():
            weight = weight.contiguous(memory_format=torch.channels_last)
            # pooling first gives the same result on a quarter of the values
            x = F.relu(F.max_pool2d(F.conv2d(x, weight, bias), 2))
            x = F.dropout2d(x, self.dropout, self.training)
        x = x.flatten(1)
        return x if self.embedding is None else F.relu(self.embedding(x))

    def _sparse(self, x: Tensor, active: Tensor) -> Tensor:
        difference = x.flatten(2)[:, :, active.flatten()].permute(2, 1, 0)
        cells = Cells(difference, x.new_zeros(x.shape[1], 1), active)
        for weight, bias in self._weights():
            cells = convolve_and_pool(cells, plan_convolution(cells.active), weight, bias)
            background = F.relu(cells.background)
            difference = F.relu(cells.difference + cells.background) - background
            # spatial dropout takes whole channels of an image: background and difference alike
            keep = F.dropout(x.new_ones(len(bias), len(x)), self.dropout, self.training)
            cells = Cells(difference * keep, background * keep, cells.active)
        if self.embedding is None:
            return dense(cells, len(x)).flatten(1)
        return F.relu(linear(cells, self.embedding.weight, self.embedding.bias))
