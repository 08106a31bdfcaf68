"""Check pressure frames and lay their cells in a row."""

import torch
from torch import Tensor

__all__ = ["flatten"]


def flatten(pressure: Tensor, shape: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Return pressure (..., H, W), Pa, as (..., H*W) of the simulator's own dtype.

    Raises:
        ValueError: the frames do not have the shape of the sheet's cells, or are not floating point.
    """
    if pressure.ndim < 2 or tuple(pressure.shape[-2:]) != shape:
        raise ValueError(f"pressure must be (..., H, W) with H, W = {shape}, got {tuple(pressure.shape)}")
    if not pressure.is_floating_point():
        raise ValueError(f"pressure must be floating point, in Pa, got {pressure.dtype}")
    return pressure.to(dtype).flatten(-2)
