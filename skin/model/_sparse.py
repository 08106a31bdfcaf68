"""Convolution and pooling of images of which only a few pixels ever differ from a constant.

An image of 25 sensors has 25 pixels that may differ from zero. After a 3x3 convolution and a 2x2 pooling they
touch 100 of 961 cells; every other cell holds the same value in all images, the *background*. So a layer
needs the cells that differ (their difference from the background) and the background itself. This is the same
mathematics as the dense layer, at about a quarter of its time; a test compares the two.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

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
