"""Touches from a file or a data set."""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import MinLen
from torch import Tensor

from skin.body.base import AbstractBody, Sensors, require_memory
from skin.body.layout import AbstractLayout
from skin.core.settings import ONCE, checked
from skin.device.base import AbstractDevice, Blank, Split, split_groups, split_rows, split_shards
from skin.device.files import DataSet, read_recording
from skin.device.touches import CLASS, GROUP, Part, Recording, Touches, concatenate, one_hot
from skin.errors import InputError
from skin.touch.labels import Task, target_unit

What = Literal["labels", "classes", "regression"]
_BYTES = 8.0  # of a reading, whether it is valid and whether it is saturated; of a number of a contact


@checked("device")
class Recorded(AbstractDevice):
    """Yields the touches of a recording or a data set, split 80/10/10 by group or by gesture.

    ``test`` is ``holdout``, the last part. A recording of ``skin convert`` brings its sensors, and body and
    layout have no effect, unless it was made with ``positions: layout``. A network is trained on a data set
    shard by shard, so that its touches need not fit into memory; its validation and holdout have at most
    32,768 gestures each.

    Args:
        path: ``x.parquet`` or the folder of a data set (:mod:`skin.device.files`).
        body: the sheet; it is compared with the file's.
        layout: positions of the sensors; they are compared with the file's.
        split_seed: seed of the split.
        test: ``holdout``, or ``all`` touches, for a run that was trained on others.
        group: whose touches stay together, such as ``session``, or ``gesture``; None: the first group of the
            file, if it has one.
        test_groups: groups of ``holdout``; None draws a tenth of them.
        task: what is learned: ``labels``, exclusive ``classes``, or ``regression`` of targets; None: what the
            file has as labels, which may be classes.
        targets: of a regression, such as ``[x, y]``; None: all measured ones of the file.

    Attributes:
        sensors: as ``layout`` gives them.
        rate: frames per second, Hz.
        window: frames per touch.

    Raises:
        InputError: no file given, unreadable, too few touches, or another sheet or other sensors than the
            configuration's; groups, classes or targets that the file lacks; groups that leave none to train
            on. Methods raise it if touches do not fit into memory, or if those to train on have a label of
            one class, or a target with one value.
    """

    def __init__(
        self,
        body: AbstractBody,
        layout: AbstractLayout,
        path: str | None = None,
        split_seed: int = 0,
        test: Literal["holdout", "all"] = "holdout",
        group: str | None = None,
        test_groups: str | Sequence[str | int] | None = None,
        task: What | None = None,
        targets: Annotated[Sequence[str], MinLen(1), ONCE] | None = None,
    ) -> None:
        if path is None:
            raise InputError(
                "device=recording needs a file or a data set: add device.path=x.parquet or =FOLDER"
            )
        self.path, self.split_seed, self._test = path, split_seed, test
        folder = Path(path).expanduser()
        self._whole = folder.suffix != "" and not folder.is_dir()
        if self._whole:
            self._shards: list[Recording | Path] = [read_recording(path)]  # stays in memory
            self._counts = [len(self._shards[0])]  # type: ignore[arg-type]
        else:
            data_set = DataSet(path)
            self._shards, self._counts = [*map(data_set.path, range(len(data_set.counts)))], data_set.counts
        self._what, self._targets = task, targets
        self._learned: Task | None = None
        if (count := sum(self._counts)) < 10 and test == "holdout":
            raise InputError(
                f"{path} has {count} touches: 80/10/10 needs at least 10, or a "
                "run that was trained on others and device.test=all"
            )
        self._example = self._read(0)[torch.tensor([0])]  # a copy: a slice would keep the whole
        touches = self._example.touches
        self.sensors, self.size = (
            Sensors(touches.positions.double().numpy(), self._example.footprint),
            self._example.size,
        )
        self.configured = self._example.metadata.get("positions") not in ("unknown", "stated")
        if self.configured:
            self._compare(body, layout.sensors(body))
            self.sensors, self.surface = layout.sensors(body), body
        self.name, self.task = path, self._example.task
        self.rate, self.window = touches.rate, touches.readings.shape[1]
        self._groups: dict[Split, Tensor] = {}
        groups: dict[str, list[str]] = self._example.metadata.get("groups", {})
        name = next(iter(groups), "gesture") if group is None else group
        if test == "all":
            self.split = "none: all touches are for the test"
        elif name in groups:
            tested = [test_groups] if isinstance(test_groups, str) else [*map(str, test_groups or ())]
            self._divide(name, groups[name], tested)
        elif name != "gesture":
            raise InputError(
                f"{self.path} has no group {name}: give device.group={', '.join([*groups, 'gesture'])}"
            )
        elif test_groups is not None:
            raise InputError("device.test_groups needs a recording with groups, and not device.group=gesture")

    def _divide(self, name: str, values: list[str], tested: list[str]) -> None:
        """Assign the groups of a name to the splits; without ``tested``, those of the test are drawn."""
        if len(values) < 2:
            raise InputError(
                f"{self.path} has the single {name} {values[0]}: device.group=gesture splits it by gesture"
            )
        if unknown := [value for value in tested if value not in values]:
            raise InputError(
                f"device.test_groups: {self.path} has no {name} {unknown[0]}, it has {_few(values)}"
            )
        if len(set(tested)) == len(values):
            raise InputError(f"device.test_groups has every {name}: leave out some to train on")
        numbers = self._read(0).parameters[GROUP + name].long()
        self._groups = split_groups(
            numbers, self.split_seed, [values.index(value) for value in tested] or None
        )
        trained, held, judged = (
            [values[number] for number in numbers[rows].unique()] for rows in self._groups.values()
        )
        apart = (
            "a tenth of their touches validates" if {*trained} & {*held} else f"{len(held)} for validation"
        )
        self.split = f"by {name}: {len(trained)} to train ({apart}), {len(judged)} to test ({_few(judged)})"

    def _check_classes(self, labels: Tensor | None) -> None:
        """Raise InputError where the touches to train on have a label of one class."""
        lack = "has less than two values" if self.task.kind == "regression" else "lacks a class"
        for label, column in zip(self.task.names, () if labels is None else labels.T, strict=False):
            if len(column[~column.isnan()].unique()) < 2:
                raise InputError(
                    f"split {self.split}: {label} {lack} in the touches to train on: give other "
                    "device.test_groups, or device.group=gesture"
                )

    def _compare(self, body: AbstractBody, sensors: Sensors) -> None:
        """Raise InputError where the file is of another skin than the configuration."""
        stored, size = self._example.touches.positions.numpy(), self._example.size
        layout = "give the layout it was recorded with, as in layout=file layout.path=FILE.csv"
        if not np.allclose(size, body.size):
            raise InputError(
                f"{self.path} was recorded on a skin of {size[0]:g} x {size[1]:g} m, the body is "
                f"{body.size[0]:g} x {body.size[1]:g} m: add {body.resized(size)}"
            )
        if len(stored) != len(sensors):
            three = len(stored) == 3 * len(sensors)  # sites with three axes, for a run of normal sensors
            raise InputError(
                f"{self.path} has {len(stored)} sensors, the layout has {len(sensors)}: "
                + ("keep the channels inwards, readings[..., 2::3]" if three else layout)
            )
        apart = np.abs(stored - sensors.positions).max(axis=1)
        if apart.max() > 1e-6:  # m: the file's positions are float32
            number = int(apart.argmax())
            raise InputError(
                f"{self.path} has sensor {number} at {stored[number].tolist()} m, the layout at "
                f"{sensors.positions[number].tolist()} m: {layout}"
            )

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split, the same in every epoch."""
        return self.recording(split, epoch, complete=False).touches

    def all_touches(self) -> Touches:
        """Return the touches of the whole file, or of the first shard."""
        return self._read(0).touches

    def with_labels(self, task: Task) -> AbstractDevice:
        """Return the device with the labels of a run; those that the file lacks are unknown."""
        present = self.task
        if task == present:
            return self
        plain = task.kind == present.kind == "binary" and (task.gate is None or task.gate in present.names)
        if self._example.touches.labels is not None and not (plain and set(present.names) & set(task.names)):
            raise InputError(
                f"{self.path} has the labels {', '.join(present.names)}, and the run learned "
                f"{', '.join(task.names)}: give a recording with labels of the run, or without any"
            )
        other = copy(self)
        other.task = other._learned = task
        return other

    def blank(self) -> AbstractDevice:
        """Return a device that has labels, which the file may lack."""
        blank = Blank.of(self.task, self.size, self._example.touches)
        blank.configured = self.configured
        return blank

    def strips(self) -> Iterator[Touches]:
        """Yield the touches of the file, or of the first shard."""
        yield self._read(0, complete=False).touches

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
        metadata = {name: content for name, content in recording.metadata.items() if name != "summary"}
        return replace(recording, metadata=metadata)  # the summary is of one shard

    def parts(self, split: Split | None = None) -> list[Part] | None:
        """Return the shards of a data set, or what a split has of each; None for a file."""
        return None if self._whole else self._parts(split, complete=False)

    def _parts(self, split: Split | None, complete: bool) -> list[Part]:
        counts = self._counts
        if split is None or (split == "test" and self._test == "all"):
            return [Part(count, partial(self._read, n, complete)) for n, count in enumerate(counts)]
        name: Split = "holdout" if split == "test" else split
        if self._whole:
            rows = self._groups[name] if self._groups else split_rows(name, counts[0], self.split_seed)
            shards = iter([(0, rows)])
        else:
            shards = split_shards(name, counts, self.split_seed)
        parts = [Part(len(rows), partial(self._rows, n, complete, rows)) for n, rows in shards]
        if self._groups and name == "train":
            self._check_classes(parts[0].make().touches.labels)
        return parts

    def _rows(self, number: int, complete: bool, rows: Tensor) -> Recording:
        return self._read(number, complete)[rows]

    def _read(self, number: int, complete: bool = True) -> Recording:
        shard = self._shards[number]
        stored = read_recording(shard, complete) if isinstance(shard, Path) else shard
        recording = choose_task(stored, self._what, self._targets, self.path)
        task = self._learned or recording.task
        return replace(recording, task=task, touches=label_as(recording.touches, recording.task, task))


def choose_task(
    recording: Recording, task: What | None, targets: Sequence[str] | None, path: str
) -> Recording:
    """Return a recording with other labels: what is learned of its touches.

    Args:
        recording: whose parameters are targets, m or N, and whose metadata ``classes`` name the values of the
            parameter ``class``.
        task: as of :class:`Recorded`.
        targets: as of :class:`Recorded`.
        path: of the recording, for messages.

    Raises:
        InputError: it has no such labels, classes or targets; one sentence.
    """
    kind, parameters = recording.task.kind, recording.parameters
    if targets is not None and task != "regression":
        raise InputError("device.targets needs task=regression")
    labelled = kind == "binary" and recording.touches.labels is not None
    if task is None or (task == "classes" and kind == "exclusive") or (task == "labels" and labelled):
        return recording
    if task == "labels":
        raise InputError(f"{path} has no labels that hold or not: give task=classes or task=regression")
    if task == "classes":
        names = recording.metadata.get("classes", [])
        if CLASS not in parameters or len(names) < 2:
            raise InputError(
                f"{path} has no classes: give task=labels or task=regression, or classes in the mapping"
            )
        return _relabelled(recording, Task(tuple(names), "exclusive"), one_hot(parameters[CLASS], len(names)))
    measured = [name for name in parameters if name != CLASS and not name.startswith(GROUP)]
    chosen = [name for name in measured if target_unit(name)] if targets is None else list(targets)
    if unknown := [name for name in chosen if name not in measured]:
        raise InputError(f"{path} has no target {unknown[0]}, it has {', '.join(measured) or 'none'}")
    if not chosen:
        raise InputError(f"{path} has no target: give targets in the mapping, or device.targets=[NAME]")
    values = torch.stack([parameters[name] for name in chosen], dim=1)
    return _relabelled(recording, Task(tuple(chosen), "regression"), values)


def label_as(touches: Touches, present: Task, task: Task) -> Touches:
    """Return touches with the labels of another task; those that are not present are unknown, NaN."""
    if present == task or (labels := touches.labels) is None:
        return touches
    unknown = labels.new_full((len(labels),), torch.nan)
    columns = [
        labels[:, present.names.index(name)] if name in present.names else unknown for name in task.names
    ]
    return replace(touches, labels=torch.stack(columns, dim=1))


def _relabelled(recording: Recording, task: Task, labels: Tensor) -> Recording:
    return replace(recording, task=task, touches=replace(recording.touches, labels=labels))


def _few(values: Sequence[str], shown: int = 4) -> str:
    """Return the first of some names."""
    return ", ".join(values[:shown]) + ", ..." * (len(values) > shown)
