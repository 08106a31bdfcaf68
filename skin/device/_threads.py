"""Process batches on as many threads as torch has."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_T = TypeVar("_T")


def in_threads(work: Callable[[int], _T], count: int) -> list[_T]:
    """Return what ``work`` makes of 0, 1, ... count - 1, on as many threads as torch has.

    Each works alone: batches share nothing, and their many small products lose more by waiting for each
    other than they gain by being split. So the result is the same to the last bit on any number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, range(count)))
    finally:
        torch.set_num_threads(threads)
