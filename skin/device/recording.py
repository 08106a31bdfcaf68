"""Touches from a file or a data set."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody, require_memory
from skin.body.layout import AbstractLayout
from skin.core.settings import checked
from skin.device.base import AbstractDevice, Blank, Split, split_rows, split_shards
from skin.device.files import DataSet, read_recording
from skin.device.touches import Part, Recording, Touches, concatenate
from skin.errors import InputError

_SAME_PLACE = 1e-6  # m: the file's positions are float32
_BYTES = 8.0  # of a reading, whether it is valid and whether it is saturated; of a number of a contact


@checked("device")
class Recorded(AbstractDevice):
    """Yields the touches of a recording or a data set, split 80/10/10 by gesture.

    ``test`` is ``holdout``, the last part. A network is trained on a data set shard by shard, so that its
    touches need not fit into memory; its validation and holdout have at most 32,768 gestures each.

    Args:
        path: ``x.parquet``, ``x.csv`` or the folder of a data set (:mod:`skin.device.files`).
        body: the sheet; it is compared with the file's.
        layout: positions of the sensors; they are compared with the file's.
        split_seed: seed of the split.
        test: ``holdout``, or ``all`` touches, for a run that was trained on others.

    Attributes:
        sensors: as ``layout`` gives them.
        rate: frames per second, Hz.
        window: frames per touch.

    Raises:
        InputError: no file given, unreadable, too few touches, or another sheet or other sensors than the
            configuration's. Methods raise it if touches do not fit into memory.
    """

    def __init__(
        self,
        body: AbstractBody,
        layout: AbstractLayout,
        path: str | None = None,
        split_seed: int = 0,
        test: Literal["holdout", "all"] = "holdout",
    ) -> None:
        if path is None:
            raise InputError(
                "device=recording needs a file or a data set: add device.path=x.parquet or =FOLDER"
            )
        self.path, self.split_seed, self._test = path, split_seed, test
        folder = Path(path).expanduser()
        self._whole = folder.suffix != "" and not folder.is_dir()
        self._stored = _File(path) if self._whole else DataSet(path)
        count = sum(self._stored.counts)
        if count < 10 and test == "holdout":
            raise InputError(
                f"{path} has {count} touches: 80/10/10 needs at least 10, or a "
                "run that was trained on others and device.test=all"
            )
        self._example = self._stored.read(0)[torch.tensor([0])]  # a copy: a slice would keep the whole
        self.sensors = layout.sensors(body)
        self._compare(body)
        self.name = str(self._stored.path(0))
        self.surface, self.task, self.size = body, self._example.task, body.size
        self.rate, self.window = self._example.touches.rate, self._example.touches.readings.shape[1]

    def _compare(self, body: AbstractBody) -> None:
        stored, size = self._example.touches.positions, self._example.size
        if not np.allclose(size, body.size):
            raise InputError(
                f"{self.path} was recorded on a skin of {size[0]:g} x {size[1]:g} m, the body is "
                f"{body.size[0]:g} x {body.size[1]:g} m: add {body.resized(size)}"
            )
        if len(stored) != len(self.sensors):
            raise InputError(
                f"{self.path} has {len(stored)} sensors, the layout has {len(self.sensors)}: give the layout "
                "it was recorded with, as in layout=file layout.path=FILE.csv"
            )
        apart = np.abs(stored.numpy() - self.sensors.positions).max(axis=1)
        if apart.max() > _SAME_PLACE:
            number = int(apart.argmax())
            raise InputError(
                f"{self.path} has sensor {number} at {stored[number].tolist()} m, the layout at "
                f"{self.sensors.positions[number].tolist()} m: give the layout it was recorded with, as in "
                "layout=file layout.path=FILE.csv"
            )

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split, the same in every epoch."""
        return self.recording(split, epoch, complete=False).touches

    def all_touches(self) -> Touches:
        """Return the touches of the whole file, or of the first shard."""
        return self._stored.read(0).touches

    def blank(self) -> AbstractDevice:
        """Return a device that has labels, which the file may lack."""
        return Blank.of(self.task, self.size, self._example.touches)

    def strips(self) -> Iterator[Touches]:
        """Yield the touches of the file, or of the first shard."""
        yield self._stored.read(0, complete=False).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the recording of a split; None takes the whole file or data set."""
        parts = self._parts(split, complete)
        if self._whole:
            return parts[0].make()
        count, example = sum(part.count for part in parts), self._example.touches
        numbers = example.readings.numel() + (0 if example.contacts is None else example.contacts.numel())
        require_memory(
            2.0 * _BYTES * count * numbers,  # joining shards copies them
            f"{self.path}, {count} gestures at once,",
            "train a network, which reads shard by shard, or generate fewer gestures",
        )
        recording = concatenate([part.make() for part in parts] or [self._example[:0]])
        # The summary is of one shard.
        return replace(
            recording,
            metadata={name: content for name, content in recording.metadata.items() if name != "summary"},
        )

    def parts(self, split: Split | None = None) -> list[Part] | None:
        """Return the shards of a data set, or what a split has of each; None for a file."""
        return None if self._whole else self._parts(split, complete=False)

    def _parts(self, split: Split | None, complete: bool) -> list[Part]:
        counts = self._stored.counts
        if split is None or (split == "test" and self._test == "all"):
            return [Part(count, partial(self._stored.read, n, complete)) for n, count in enumerate(counts)]
        part: Split = "holdout" if split == "test" else split
        seed = self.split_seed
        rows = [(0, split_rows(part, counts[0], seed))] if self._whole else split_shards(part, counts, seed)
        return [Part(len(selected), partial(self._rows, n, complete, selected)) for n, selected in rows]

    def _rows(self, number: int, complete: bool, rows: Tensor) -> Recording:
        return self._stored.read(number, complete)[rows]


class _File:
    """A recording as the only shard of a data set; it stays in memory."""

    def __init__(self, path: str) -> None:
        self._path, self._recording = Path(path), read_recording(path)
        self.counts = [len(self._recording)]

    def path(self, number: int) -> Path:
        return self._path

    def read(self, number: int, complete: bool = True) -> Recording:
        return self._recording
