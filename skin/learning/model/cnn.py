"""A convolutional network on sensor images."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from skin.errors import InputError
from skin.learning.model.base import AbstractModel, Kind

# Sparse convolution and pooling. The 25 pixels of 25 sensors touch 100 of 961 cells after a 3x3 convolution
# and a 2x2 pooling; every other cell holds the same value in all images, the *background*. A layer computes
# both: the same mathematics as the dense layer, which a test compares, at about a quarter of its time.

TAPS = 9  # of a 3x3 kernel
WINDOW = 4  # a pooled cell sees 4x4 inputs


class Cells(NamedTuple):
    """Images (N, C, H, W) as differences from a background.

    Attributes:
        difference: (A, C, N), of the active cells; images come last so that every product is one large one.
        background: (C, 1) or (C, N).
        active: (H, W), bool, with A true cells in reading order.
    """

    difference: Tensor
    background: Tensor
    active: Tensor


class Plan(NamedTuple):
    """Where the inputs of every active pooled cell lie.

    Attributes:
        inputs: (A', K), which of the A active inputs lie in the cell's window, A where there are fewer than
            K.
        taps: (A', 4, K, 9), one-hot: which tap of the kernel takes the input to each of the four positions
            that are pooled; all zero where none does.
        active: (H', W'), bool, with A' true cells.
    """

    inputs: Tensor
    taps: Tensor
    active: Tensor


def _tap_table() -> Tensor:
    """Return which tap (4, 16) takes each input of a window to each pooled position; 9 where none does."""
    offset = torch.arange(WINDOW)[None, :] - torch.arange(2)[:, None]
    inside = (offset >= 0) & (offset <= 2)
    tap = 3 * offset[:, None, :, None] + offset[None, :, None, :]
    return torch.where(inside[:, None, :, None] & inside[None, :, None, :], tap, TAPS).reshape(4, WINDOW**2)


def plan_convolution(active: Tensor) -> Plan:
    """Return the plan of a 3x3 convolution without padding and a 2x2 pooling of active cells (H, W), bool."""
    count = int(active.sum())
    slot = torch.full(active.shape, count, device=active.device)
    slot[active] = torch.arange(count, device=active.device)
    windows = slot.unfold(0, WINDOW, 2).unfold(1, WINDOW, 2).flatten(2)
    seen = (windows < count).any(dim=-1)
    inputs, place = windows[seen].sort(dim=-1)  # the empty slot sorts last
    most = int((inputs < count).sum(dim=-1).amax()) if count else 0
    inputs, place = inputs[:, :most], place[:, :most]
    taps = _tap_table().to(active.device)[:, place].transpose(0, 1)
    taps = torch.where((inputs < count)[:, None], taps, TAPS)
    return Plan(inputs, nn.functional.one_hot(taps, TAPS + 1)[..., :TAPS], seen)


def convolve_and_pool(cells: Cells, steps: Plan, weight: Tensor, bias: Tensor) -> Cells:
    """Return the 2x2 maximum of the 3x3 convolution of ``cells``, weight (O, C, 3, 3) and bias (O,)."""
    width, channels = weight.shape[:2]
    count, most = steps.inputs.shape
    images = cells.difference.shape[-1]
    kernel = weight.flatten(2).permute(2, 0, 1).flatten(1)
    local = (steps.taps.to(weight.dtype) @ kernel).view(count, 4, most, width, channels)
    local = local.transpose(2, 3).reshape(count, 4 * width, most * channels)
    padded = torch.cat([cells.difference, cells.difference.new_zeros(1, channels, images)])
    # not padded[...]: the gradient of that is summed in an order that changes from run to run
    inputs = padded.index_select(0, steps.inputs.flatten()).view(count, most * channels, images)
    pooled = _FirstMaximum.apply(torch.bmm(local, inputs).view(count, 4, width, images))
    # the background is the same at all four positions, so that it may be added after the maximum
    background = weight.sum(dim=(2, 3)) @ cells.background + bias[:, None]
    return Cells(pooled, background, steps.active)


def dense(cells: Cells, images: int) -> Tensor:
    """Return the images (N, C, H, W) that ``cells`` stand for."""
    background = cells.background.expand(-1, images)
    full = background.repeat(cells.active.numel(), 1, 1)
    full[cells.active.flatten()] = background + cells.difference
    return full.unflatten(0, cells.active.shape).permute(3, 2, 0, 1)


def linear(cells: Cells, weight: Tensor, bias: Tensor) -> Tensor:
    """Return ``weight @ flat + bias``, (N, O), of the flattened images that ``cells`` stand for.

    Args:
        cells: of images (N, C, H, W).
        weight: (O, C H W).
        bias: (O,).
    """
    width, channels = len(weight), len(cells.background)
    places = weight.view(width * channels, -1)
    # a product with 0 and 1: the gradient of an index would be scattered one number at a time
    chosen = torch.eye(places.shape[1], dtype=weight.dtype, device=weight.device)[:, cells.active.flatten()]
    active = (places @ chosen).view(width, channels, -1).transpose(1, 2).reshape(width, -1)
    background = places.sum(dim=1).view(width, channels) @ cells.background
    return (active @ cells.difference.flatten(0, 1) + background + bias[:, None]).T


class _FirstMaximum(torch.autograd.Function):
    """Maximum over axis 1, whose gradient goes to the first maximum as in ``max_pool2d``.

    torch's own reductions are 6 times slower backwards here.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        maximum = x.amax(dim=1)
        ctx.save_for_backward(x, maximum)
        return maximum

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        x, maximum = ctx.saved_tensors
        result = torch.empty_like(x)
        free = torch.ones_like(maximum, dtype=torch.bool)
        for position in range(x.shape[1]):
            hit = (x[:, position] == maximum) & free
            torch.mul(gradient, hit, out=result[:, position])
            free &= ~hit
        return result


SPARSE = 32  # images with fewer than one active pixel in so many go the short way


class Cnn(AbstractModel):
    """Blocks of 3x3 convolution, 2x2 max pooling, ReLU and spatial dropout (report, 3.2.3 and 3.2.5).

    Accepts any layout with the same weights. Sparse images (``representation=image``) are computed by a
    faster, exact method; see :mod:`skin.learning.model.cnn`.

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
