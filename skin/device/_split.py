"""The split of a training budget, 80/10/10 by gesture."""

import torch
from torch import Tensor

from skin.device.base import Split
from skin.rng import Stream, generator


def split_slices(count: int) -> dict[Split, slice]:
    """Return the slice of ``count`` shuffled gestures that belongs to each split."""
    training = round(0.8 * count)
    middle = training + (count - training) // 2
    return {"train": slice(training), "validation": slice(training, middle), "holdout": slice(middle, count)}


def split_rows(split: Split, count: int, seed: int) -> Tensor:
    """Return the shuffled indices of the gestures of a split; the order depends on ``seed`` alone."""
    order = generator(Stream.SPLIT, seed).permutation(count)
    return torch.from_numpy(order[split_slices(count)[split]])
