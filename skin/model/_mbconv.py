"""The inverted bottlenecks that EfficientNet is made of, named as in torchvision's weight files."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F


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
