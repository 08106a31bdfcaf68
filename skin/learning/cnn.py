"""Convolutional networks on sensor images."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from skin.core.files import candidates
from skin.core.messages import one_line
from skin.errors import InputError
from skin.learning.model import AbstractModel, Kind

# Sparse convolution and pooling. The 25 pixels of 25 sensors touch 100 of 961 cells after a 3x3 convolution
# and a 2x2 pooling; every other cell holds the same value in all images, the *background*. A layer computes
# both: the same mathematics as the dense layer, which a test compares, at about a quarter of its time.


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
    """Return which of the 9 taps (4, 16) takes each of the 4x4 inputs of a pooled cell to each of its 2x2
    positions; 9 where none does."""
    offset = torch.arange(4)[None, :] - torch.arange(2)[:, None]
    inside = (offset >= 0) & (offset <= 2)
    tap = 3 * offset[:, None, :, None] + offset[None, :, None, :]
    return torch.where(inside[:, None, :, None] & inside[None, :, None, :], tap, 9).reshape(4, 16)


def plan_convolution(active: Tensor) -> Plan:
    """Return the plan of a 3x3 convolution without padding and a 2x2 pooling of active cells (H, W), bool."""
    count = int(active.sum())
    slot = torch.full(active.shape, count, device=active.device)
    slot[active] = torch.arange(count, device=active.device)
    windows = slot.unfold(0, 4, 2).unfold(1, 4, 2).flatten(2)
    seen = (windows < count).any(dim=-1)
    inputs, positions = windows[seen].sort(dim=-1)  # the empty slot sorts last
    largest = int((inputs < count).sum(dim=-1).amax()) if count else 0
    inputs = inputs[:, :largest]
    taps = _tap_table().to(active.device)[:, positions[:, :largest]].transpose(0, 1)
    taps = torch.where((inputs < count)[:, None], taps, 9)
    return Plan(inputs, F.one_hot(taps, 10)[..., :9], seen)


def convolve_and_pool(cells: Cells, steps: Plan, weight: Tensor, bias: Tensor) -> Cells:
    """Return the 2x2 maximum of the 3x3 convolution of ``cells``, weight (O, C, 3, 3) and bias (O,)."""
    width, channels = weight.shape[:2]
    count, size = steps.inputs.shape
    images = cells.difference.shape[-1]
    kernel = weight.flatten(2).permute(2, 0, 1).flatten(1)
    local = (steps.taps.to(weight.dtype) @ kernel).view(count, 4, size, width, channels)
    local = local.transpose(2, 3).reshape(count, 4 * width, size * channels)
    padded = torch.cat([cells.difference, cells.difference.new_zeros(1, channels, images)])
    # not padded[...]: the gradient of that is summed in an order that changes from run to run
    inputs = padded.index_select(0, steps.inputs.flatten()).view(count, size * channels, images)
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
    pixels = weight.view(width * channels, -1)
    # a product with 0 and 1: the gradient of an index would be scattered one number at a time
    chosen = torch.eye(pixels.shape[1], dtype=weight.dtype, device=weight.device)[:, cells.active.flatten()]
    active = (pixels @ chosen).view(width, channels, -1).transpose(1, 2).reshape(width, -1)
    background = pixels.sum(dim=1).view(width, channels) @ cells.background
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


class Cnn(AbstractModel):
    """Blocks of 3x3 convolution, 2x2 max pooling, ReLU and spatial dropout (report, 3.2.3 and 3.2.5).

    Accepts any layout with the same weights. Sparse images (``representation=image``) are computed by a
    faster, exact method; see :mod:`skin.learning.cnn`.

    Args:
        kind: must be ``image``.
        shape: (C, H, W).
        channels: of the blocks.
        repeat: number of copies of the image in the input of the first block, 3 in the report; computed as
            one convolution with summed weights.
        embedding: width of a dense layer on the flattened blocks; None: the flattened blocks are the
            embedding.
        dropout: fraction of channels dropped after each block in training.
        sparse: images with fewer than one active pixel in so many are computed by the faster method.

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
        sparse: float = 32,
    ) -> None:
        super().__init__(kind)
        self.repeat, self.dropout, self.sparse = repeat, dropout, sparse
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
        if not torch.compiler.is_exporting():  # an exported graph cannot depend on the values
            active = x.abs().amax(dim=(0, 1)) != 0
            if self.sparse * int(active.sum()) < active.numel():
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
        return x * self.fc2(F.silu(self.fc1(x.mean(dim=(2, 3), keepdim=True)))).sigmoid()


class Bottleneck(nn.Module):
    """Widen, filter each channel by itself, weight the channels, narrow (Sandler et al., 2018).

    Args:
        inputs: channels.
        outputs: channels.
        kernel: of the channels' filters.
        stride: of the channels' filters.
        ratio: by which the channels are widened.
        skipped: fraction of images for which a residual block does nothing in training (Huang et al., 2016).
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
_WAYS = "model.weights=random trains from scratch"


def find_weights(weights: str) -> Path:
    """Return the file that ``model.weights`` stands for.

    Args:
        weights: a path, looked for in the current folder, then beside the package; or ``imagenet``:
            torchvision's file of EfficientNet-B0 in ``hub/checkpoints`` of ``$TORCH_HOME``, where torchvision
            itself would keep it.

    Raises:
        InputError: the file does not exist.
    """
    if weights == "imagenet":
        folder = Path(torch.hub.get_dir()).expanduser() / "checkpoints"
        # the official one first, then older or newer ones
        files = [folder / _OFFICIAL, *sorted(folder.glob("efficientnet_b0*.pth"))]
        advice = f"put {_OFFICIAL} there from https://download.pytorch.org/models/{_OFFICIAL}"
    else:
        files, advice = candidates(weights), "give model.weights=imagenet"
    file = next((path for path in files if path.is_file()), None)
    if file is None:
        tried = " and ".join(dict.fromkeys(map(str, files)))
        raise InputError(
            f"model.weights={weights}: no weights file {tried}: {advice}, or model.weights=FILE.pth; {_WAYS}"
        )
    return file


def load_weights(module: nn.Module, path: Path, spare: tuple[str, ...]) -> None:
    """Give a module the weights of a file, without running code that the file may hold.

    Args:
        module: takes the weights.
        path: of a state dict.
        spare: names that the file may hold and the module has no use for.

    Raises:
        InputError: the file cannot be read, is not a state dict, or holds other weights than the module has.
    """
    needed = f"model=efficientnet needs the state dict of torchvision's efficientnet_b0; {_WAYS}"
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises nearly anything on a file that it cannot read
        # torch's own words would advise to run the code in the file
        reason = error.strerror if isinstance(error, OSError) else "it is damaged, or holds more than tensors"
        raise InputError(f"cannot read the weights file {path}: {reason}; get it again; {_WAYS}") from error
    try:
        module.load_state_dict({name: value for name, value in content.items() if name not in spare})
    except (AttributeError, RuntimeError, TypeError) as error:
        raise InputError(
            f"the weights file {path} does not fit: {one_line(error)[:300]}; {needed}"
        ) from error
    if wrong := [name for name, value in module.state_dict().items() if not value.isfinite().all()]:
        raise InputError(f"the weights file {path} has numbers in {wrong[0]} that are not finite; {needed}")


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
HEAD = ("classifier.1.weight", "classifier.1.bias")  # of the thousand classes, not used here


class EfficientNet(AbstractModel):
    """EfficientNet-B0 (Tan and Le, 2019) without its classification layer (report, 3.2.5).

    Accepts any layout and image size with the same weights. Training needs about 9 MB and 5 ms of a core per
    frame of 64 x 64. Use small batches (``data.batch_size=8``) and, without a GPU, few data
    (``data.gestures``, ``representation.pixels``). Frozen weights need a fifth of the time and little memory.

    Args:
        kind: must be ``image``.
        shape: (C, H, W) with C = 1, fed three times, or C = 3.
        weights: ``imagenet`` (torchvision's file, see :func:`skin.learning.cnn.find_weights`;
            nothing is downloaded), the path of such a file, or ``random``.
        frozen: keep the weights and the statistics of batch norm as they are.
        dropout: fraction of the embedding dropped in training.
        skipped: fraction of images that would skip a block after the last one; 0.2 in torchvision.
        chunk: images at a time where no gradient is asked for: bounds memory to a few hundred MB.

    Raises:
        InputError: not an image, neither 1 nor 3 channels, or no fitting weights.
    """

    takes: ClassVar[Kind] = "image"
    width = 1280

    def __init__(
        self,
        kind: Kind,
        shape: Sequence[int],
        weights: str = "imagenet",
        frozen: bool = False,
        dropout: float = 0.2,
        skipped: float = 0.2,
        chunk: int = 256,
    ) -> None:
        super().__init__(kind)
        if shape[0] not in (1, 3):
            raise InputError(
                f"model=efficientnet needs images of 1 or 3 channels, got {shape[0]}: "
                "set fusion=late and representation.mask=false"
            )
        self.frozen, self.dropout, self.chunk = frozen, dropout, chunk
        # of ImageNet's photographs: what the weights were trained on
        self.mean = nn.Buffer(torch.tensor([0.485, 0.456, 0.406])[:, None, None], persistent=False)
        self.deviation = nn.Buffer(torch.tensor([0.229, 0.224, 0.225])[:, None, None], persistent=False)
        self.features = nn.Sequential(unit(3, 32, 3, 2), *_stages(skipped), unit(STAGES[-1][3], self.width))
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
        parts = [x] if self.features.training else x.split(self.chunk)
        return F.dropout(torch.cat([self._encode(part) for part in parts]), self.dropout, self.training)

    def _encode(self, x: Tensor) -> Tensor:
        x = (x - self.mean) / self.deviation  # a single channel becomes three
        # With the channels last, 1.7 times faster.
        return self.features(x.contiguous(memory_format=torch.channels_last)).mean(dim=(2, 3))


def _stages(skipped: float) -> Iterator[nn.Sequential]:
    total, number, inputs = sum(stage[-1] for stage in STAGES), 0, 32
    for ratio, kernel, stride, outputs, count in STAGES:
        blocks = []
        for first in (True, *[False] * (count - 1)):
            step = stride if first else 1
            blocks.append(Bottleneck(inputs, outputs, kernel, step, ratio, skipped * number / total))
            inputs, number = outputs, number + 1
        yield nn.Sequential(*blocks)


def _start(module: nn.Module) -> None:
    """Draw the weights of a convolution as in torchvision (He et al., 2015, by fan-out)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out")
        if module.bias is not None:
            nn.init.zeros_(module.bias)
