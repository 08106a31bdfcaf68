"""Process batches on as many threads as torch has."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

_T = TypeVar("_T")


def in_threads(work: Callable[[int], _T], count: int) -> list[_T]:
    """Return ``work(0), ..., work(count - 1)``, computed on as many threads as torch has.

    Each call runs on one thread: splitting its many small products costs more time than it saves. The result
    is therefore the same to the last bit on any number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(work, range(count)))
    finally:
        torch.set_num_threads(threads)
