"""Readings to channels: scaled, invalid ones zero, with their mask where asked for."""

import torch
from torch import Tensor

__all__ = ["channels"]


def channels(readings: Tensor, valid: Tensor, scale: float, mask: bool) -> Tensor:
    """Return what every representation starts from.

    Args:
        readings: (B, T, S), N.
        valid: (B, T, S), bool; a reading that is not valid becomes 0, whatever it holds (NaN too).
        scale: N; readings are divided by it.
        mask: append a channel that is 1 where the reading means nothing, so that it is silent where all is
            well: a channel of ones beside small readings drowns them (docs/results/dead.csv).

    Returns:
        (B, T, S, C), with C = 2 under ``mask`` and else 1.
    """
    values = torch.where(valid, readings / scale, readings.new_zeros(()))
    return torch.stack([values, (~valid).to(values.dtype)] if mask else [values], dim=-1)
