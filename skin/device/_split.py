"""The split of touches, 80/10/10 by gesture."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from skin.device.base import Split
from skin.rng import Stream, generator

MOST_HELD_OUT = 32768
"""Gestures of a data set that a validation or a holdout has: more take memory and time, and tell no more."""


def split_slices(count: int) -> dict[Split, slice]:
    """Return the slice of ``count`` shuffled gestures that belongs to each split."""
    training = round(0.8 * count)
    middle = training + (count - training) // 2
    return {"train": slice(training), "validation": slice(training, middle), "holdout": slice(middle, count)}


def split_rows(split: Split, count: int, seed: int) -> Tensor:
    """Return the shuffled indices of the gestures of a split; the order depends on ``seed`` alone."""
    order = generator(Stream.SPLIT, seed).permutation(count)
    return torch.from_numpy(order[split_slices(count)[split]])


def split_shards(split: Split, counts: Sequence[int], seed: int) -> Iterator[tuple[int, Tensor]]:
    """Yield the shards of a split and the rows that it has of each, both in random order.

    Validation and holdout have at most ``MOST_HELD_OUT`` gestures each, and ``train`` has the rest.

    Args:
        split: train, validation or holdout.
        counts: number of gestures of each shard.
        seed: the order depends on it alone.
    """
    count = sum(counts)
    slices = split_slices(count)
    validation, holdout = (
        min(MOST_HELD_OUT, len(range(count)[slices[name]])) for name in ("validation", "holdout")
    )
    ends = {"train": count - validation - holdout, "validation": count - holdout, "holdout": count}
    begin, end = {"train": 0, "validation": ends["train"], "holdout": ends["validation"]}[split], ends[split]
    before = 0
    for number in generator(Stream.SPLIT, seed, 0).permutation(len(counts)).tolist():
        first, last = max(begin - before, 0), min(end - before, counts[number])
        if first < last:
            rows = generator(Stream.SPLIT, seed, 1, number).permutation(counts[number])
            yield number, torch.from_numpy(rows[first:last])
        before += counts[number]
