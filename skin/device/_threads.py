"""Draw batches on as many threads as torch has."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import torch

from skin.recording import Part, Recording, concatenate

_T = TypeVar("_T")
_PART = 8  # batches: enough for few files, and little enough for memory


def in_threads(work: Callable[[int], _T], count: int) -> list[_T]:
    """Return ``work(0), ..., work(count - 1)``, computed on as many threads as torch has.

    Each call runs on one thread: splitting its many small products costs more time than it saves. The result
    is therefore the same to the last bit on any number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    pool, ended = ThreadPoolExecutor(threads), False
    try:
        return list(pool.map(work, range(count)))
    except (SystemExit, KeyboardInterrupt):
        ended = True  # who ends a command need not wait for the batches that are being drawn
        raise
    finally:
        pool.shutdown(wait=not ended, cancel_futures=True)
        torch.set_num_threads(threads)


def joined(batches: Sequence[Part]) -> Recording:
    """Return the recording of all batches."""
    return concatenate(in_threads(lambda n: batches[n].make(), len(batches)))


def grouped(batches: Sequence[Part], metadata: Callable[[Recording], dict[str, Any]]) -> list[Part]:
    """Return batches as parts of eight, each of which is drawn on the thread that asks for it.

    Args:
        batches: to group.
        metadata: gives that of a part.
    """

    def make(group: Sequence[Part]) -> Recording:
        recording = concatenate([batch.make() for batch in group])
        return replace(recording, metadata=metadata(recording))

    groups = [batches[first : first + _PART] for first in range(0, len(batches), _PART)]
    return [Part(sum(batch.count for batch in group), partial(make, group)) for group in groups]
