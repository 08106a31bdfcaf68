"""The interface of a device: a source of touches."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from threading import Thread
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from joblib import Parallel, delayed
from torch import Tensor

from skin.body.base import AbstractBody
from skin.core.rng import Stream, generator
from skin.device.touches import Part, Recording, Touches, concatenate
from skin.errors import InputError
from skin.touch.labels import Task

if TYPE_CHECKING:
    from skin.device.simulated import Simulated


Split = Literal["train", "validation", "holdout", "test"]


class AbstractDevice(ABC):
    """Base class of devices: sources of touches.

    A subclass needs ``task``, ``size`` and :meth:`touches`. The defaults of everything else apply to a device
    that has only touches.

    Attributes:
        task: the labels and their kind.
        size: extent (x, y) of the sheet, m.
        surface: the touched body, for plots; None: a flat sheet of ``size``.
        name: of the source of :meth:`strips`, for the live view.
        split: in words, what its splits keep apart.
        configured: whether its sensors and its body are those of the configuration.
        real: whether touches are read from a real skin, which may ask a person for them.
    """

    task: Task
    size: tuple[float, float]
    surface: AbstractBody | None = None
    name: str = "simulator"
    split: str = "by gesture"
    configured: bool = True
    real: bool = False

    @property
    def simulation(self) -> "Simulated | None":
        """This device, if it simulates its touches; else None."""
        return None

    @property
    def reference(self) -> "Simulated | None":
        """The simulated skin of the configuration, on which thresholds of ``skin live`` are tuned."""
        return self.simulation

    @abstractmethod
    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split.

        ``train``, ``validation`` and ``holdout`` share the training budget 80/10/10 by gesture; ``test``
        comes from gestures that are not used for training, if the device has such. ``epoch`` is used by
        devices that draw fresh gestures.
        """

    def all_touches(self) -> Touches:
        """Return the touches that can be selected by number for plots: by default those of ``test``."""
        return self.touches("test")

    def parts(self, split: Split | None = None) -> Sequence[Part] | None:
        """Return a split, or the whole budget, as parts that are made one at a time.

        None, the default: the touches fit into memory, and :meth:`touches` and :meth:`recording` return them.
        """
        return None

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the touches of a split, or the whole budget, with applied force and parameters.

        Raises:
            InputError: the device has only readings and labels.
        """
        raise InputError(
            "only simulated or recorded touches can be written to a file: leave out device=, or add "
            "device=recording device.path=FILE.parquet"
        )

    def blank(self) -> "AbstractDevice":
        """Return a device with labelled touches of the same shapes, with which a run can be restored.

        By default it is the device itself. A device whose touches may lack labels returns another one.
        """
        return self

    def with_labels(self, task: Task) -> "AbstractDevice":
        """Return a device whose touches have the labels of a run, as far as they are known.

        By default it is the device itself.

        Raises:
            InputError: it knows none of these labels.
        """
        return self

    def strips(self) -> Iterator[Touches]:
        """Yield touches, N, that can be played one after the other as a stream of frames.

        Raises:
            InputError: the device has none.
        """
        raise InputError(
            "only a skin at a port, a recording or the simulator can be watched: give device=serial "
            "device.port=/dev/ttyACM0, device=recording device.path=FILE.parquet, or leave out device="
        )

    def simulated(self, purpose: str) -> "Simulated":
        """Return this device as a simulated one.

        Args:
            purpose: the reason, the beginning of the error message.

        Raises:
            InputError: the device is not simulated.
        """
        if self.simulation is None:
            raise InputError(f"{purpose}: leave out device=, or add device=simulated")
        return self.simulation


# A device that yields placeholder touches of the right shapes.


@dataclass
class Blank(AbstractDevice):
    """Yields the same example for every split: enough to restore a trained run, not to train one."""

    task: Task
    size: tuple[float, float]
    example: Touches

    @classmethod
    def of(cls, task: Task, size: tuple[float, float], touches: Touches) -> "Blank":
        """Return a device whose example is the first of the touches, with labels 0."""
        return cls(task, size, replace(touches[:1], labels=torch.zeros(1, len(task))))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the example."""
        return self.example


# The split of touches, 80/10/10 by gesture.


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


def split_groups(
    groups: Tensor, seed: int, test: Sequence[int] | None = None, few: int = 5
) -> dict[Split, Tensor]:
    """Return the shuffled indices of the gestures of each split; the gestures of a group stay together.

    About a tenth of the groups is the holdout, and another tenth the validation. If the holdout leaves fewer
    than ``few`` groups, too few to give one for validation, the validation is a tenth of their gestures.

    Args:
        groups: (B,), number of the group of each gesture; at least two groups.
        seed: the order depends on it alone.
        test: groups of the holdout; None draws them.
    """
    source = generator(Stream.SPLIT, seed)
    order = source.permutation(groups.unique().tolist()).tolist()
    tenth = max(1, round(0.1 * len(order)))
    held = order[:tenth] if test is None else list(test)
    left = [group for group in order if group not in held]
    rows = torch.from_numpy(source.permutation(len(groups)))
    numbers = groups[rows]
    holdout, others = torch.isin(numbers, torch.tensor(held)), rows[torch.isin(numbers, torch.tensor(left))]
    if len(left) < few:
        edge = max(1, round(0.1 * len(others)))
        return {"train": others[edge:], "validation": others[:edge], "holdout": rows[holdout]}
    middle = torch.isin(groups[others], torch.tensor(left[:tenth]))
    return {"train": others[~middle], "validation": others[middle], "holdout": rows[holdout]}


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


# Draw batches on as many threads as torch has.


_S = TypeVar("_S")
_T = TypeVar("_T")
_PART = 8  # batches: enough for few files, and little enough for memory


def in_threads(work: Callable[[int], _T], count: int) -> list[_T]:
    """Return ``work(0), ..., work(count - 1)``, computed on as many threads as torch has.

    Each call runs on one thread: splitting its many small products costs more time than it saves. The result
    is therefore the same to the last bit on any number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        # Who ends a command need not wait for the batches that are being drawn.
        return Parallel(threads, backend="threading")(delayed(work)(number) for number in range(count))
    finally:
        torch.set_num_threads(threads)


def in_background(work: Callable[[], _T]) -> Future[_T]:
    """Return the result of ``work()`` to come, from a thread that does not outlive the command."""
    future: Future[_T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, daemon=True).start()
    return future


def one_ahead(work: Callable[[_S], _T], values: Iterable[_S]) -> Iterator[_T]:
    """Yield ``work(value)`` in order; the next one is computed on another thread meanwhile."""
    begun = (in_background(partial(work, value)) for value in values)
    for current, _ in pairwise(chain(begun, [None])):
        assert current is not None
        yield current.result()


def joined(batches: Sequence[Part]) -> Recording:
    """Return the recording of all batches."""
    return concatenate(in_threads(lambda n: batches[n].make(), len(batches)))


def grouped(batches: Sequence[Part], metadata: Callable[[Recording], dict[str, Any]]) -> list[Part]:
    """Return batches as parts of eight, each of which is drawn on the thread that asks for it.

    Args:
        batches: to group.
        metadata: gives the metadata of a part.
    """

    def make(group: Sequence[Part]) -> Recording:
        recording = concatenate([batch.make() for batch in group])
        return replace(recording, metadata=metadata(recording))

    groups = [batches[first : first + _PART] for first in range(0, len(batches), _PART)]
    return [Part(sum(batch.count for batch in group), partial(make, group)) for group in groups]
