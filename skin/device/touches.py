"""Touches, recordings, and streams: what a device yields."""

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from math import nan
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from skin.body.base import GEOMETRY
from skin.errors import InputError
from skin.touch.labels import CONTACT, TOUCH, TOUCH_OR_NOT, Task
from skin.touch.movie import AbstractSampler, Movie, join_movies


@dataclass(frozen=True)
class Touches:
    """A batch of touches as any device yields it.

    Attributes:
        readings: (B, T, S), N.
        valid: (B, T, S), bool: False for invalid readings (dead sensor, lost frame).
        positions: (S, 3), (B, S, 3) or (B, T, S, 3), m: x right and y down from the upper left corner, z
            depth.
        labels: (B, L), 0 or 1, or the targets of a regression, float, NaN where unknown; or None.
        rate: frames per second, Hz.
        motion: (B, T, S, 3), m, distance of each sensor from ``positions``, along the same axes; None if
            unknown.
        saturated: (B, T, S), bool: the sensor is at its limit, so the force is at least its reading; None
            if unknown.
        geometry: (S, G) or (B, S, G), the columns :data:`GEOMETRY` of each sensor; None if unknown.
        contacts: (B, T, K, 5), the columns :data:`skin.touch.labels.CONTACT` of up to K contacts, NaN
            where there is none; None if unknown.

    Raises:
        ValueError: shapes or types disagree.
    """

    readings: Tensor
    valid: Tensor
    positions: Tensor
    labels: Tensor | None
    rate: float
    motion: Tensor | None = None
    saturated: Tensor | None = None
    geometry: Tensor | None = None
    contacts: Tensor | None = None

    def __post_init__(self) -> None:
        if self.readings.ndim != 3:
            raise ValueError(f"readings must be (B, T, S), got {tuple(self.readings.shape)}")
        if self.valid.dtype != torch.bool:
            raise ValueError(f"valid must be bool, got {self.valid.dtype}")
        batch, time, sensors = self.readings.shape
        each, contacts = (batch, time, sensors), () if self.contacts is None else self.contacts.shape[2:3]
        shapes: dict[str, tuple[tuple[int, ...], ...]] = {
            "valid": (each,),
            "positions": ((sensors, 3), (batch, sensors, 3), (*each, 3)),
            "geometry": ((sensors, len(GEOMETRY)), (batch, sensors, len(GEOMETRY))),
            "motion": ((*each, 3),),
            "saturated": (each,),
            "contacts": ((batch, time, *contacts, len(CONTACT)),),
        }
        for name, allowed in shapes.items():
            _expect(getattr(self, name), name, *allowed)
        if self.labels is not None and (self.labels.ndim != 2 or len(self.labels) != batch):
            raise ValueError(f"labels must be (B, L), B = {batch}, got {tuple(self.labels.shape)}")

    def __len__(self) -> int:
        return len(self.readings)

    def __getitem__(self, index: Tensor | slice) -> "Touches":
        """Return the touches that ``index`` selects; positions common to all touches stay common."""
        common = {"positions": 2, "geometry": 2}  # dimensions where they are common to all touches
        selected = {
            name: value[index]
            for name, value in vars(self).items()
            if isinstance(value, Tensor) and value.ndim != common.get(name)
        }
        return replace(self, **selected)  # type: ignore[arg-type]

    @property
    def known_labels(self) -> Tensor:
        """The labels, (B, L).

        Raises:
            InputError: the touches have no labels.
        """
        if self.labels is None:
            raise InputError("touches without labels cannot be used for training: record them with labels")
        return self.labels

    def to(self, device: torch.device | str) -> "Touches":
        """Return these touches with every tensor on ``device``."""
        moved: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **moved)


@dataclass(frozen=True)
class Recording:
    """Touches with labels and parameters, as :mod:`skin.device.files` stores them.

    Attributes:
        touches: B touches of T frames; their positions are common to all, (S, 3).
        task: the labels.
        size: extent (x, y) of the sheet, m.
        footprint: extent (x, y) of a sensor, m.
        force: applied force, (B, T), N; None if unknown.
        displacement: (B, T, S, 2), m: D_s and D_t (``skin.mechanics.simulator.base.Response``); or None.
        parameters: (B,) each, float32: further parameters of each gesture.
        metadata: any JSON data: seeds, versions, hashes, a summary.

    Raises:
        ValueError: shapes disagree.
    """

    touches: Touches
    task: Task
    size: tuple[float, float]
    footprint: tuple[float, float]
    force: Tensor | None = None
    displacement: Tensor | None = None
    parameters: dict[str, Tensor] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = tuple(self.touches.readings.shape)
        if self.touches.positions.ndim != 2:
            raise ValueError("a recording has one layout: positions must be (S, 3)")
        _expect(self.force, "force", shape[:2])
        _expect(self.displacement, "displacement", (*shape, 2))
        _expect(self.touches.labels, "labels", (shape[0], len(self.task)))
        for name, values in self.parameters.items():
            _expect(values, f"parameter {name}", shape[:1])

    def __len__(self) -> int:
        return len(self.touches)

    def __getitem__(self, index: Tensor | slice) -> "Recording":
        """Return the recording of the touches that ``index`` selects."""
        return replace(
            self,
            touches=self.touches[index],
            force=None if self.force is None else self.force[index],
            displacement=None if self.displacement is None else self.displacement[index],
            parameters={name: values[index] for name, values in self.parameters.items()},
        )


@dataclass(frozen=True)
class Part:
    """Consecutive touches of a whole that need not fit into memory: they are made when they are needed.

    Attributes:
        count: number of touches.
        make: draws or reads them.
    """

    count: int
    make: Callable[[], Recording]


def _expect(values: Tensor | None, name: str, *shapes: tuple[int, ...]) -> None:
    """Raise a ValueError where a tensor, if there is one, has none of some shapes."""
    if values is not None and tuple(values.shape) not in shapes:
        raise ValueError(f"{name} must be {' or '.join(map(str, shapes))}, got {tuple(values.shape)}")


def concatenate(parts: Sequence[Recording]) -> Recording:
    """Return one recording of all touches of ``parts``, which agree on the rest; the first one's metadata."""
    first = parts[0]

    def together(tensors: Iterable[Tensor | None]) -> Tensor | None:
        present = [tensor for tensor in tensors if tensor is not None]
        return torch.cat(present) if present else None

    joined = {
        name: together(getattr(part.touches, name) for part in parts)
        for name in ("readings", "valid", "labels", "motion", "saturated")
    }
    contacts = join_contacts([part.touches.contacts for part in parts])
    return replace(
        first,
        touches=replace(first.touches, contacts=contacts, **joined),  # type: ignore[arg-type]
        force=together(part.force for part in parts),
        displacement=together(part.displacement for part in parts),
        parameters={name: torch.cat([part.parameters[name] for part in parts]) for name in first.parameters},
    )


def join_contacts(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Return contacts (B, T, K, 5) of all parts; None if those of one part are unknown."""
    tensors = [part for part in parts if part is not None]
    if len(tensors) < len(parts):
        return None
    maximum = max(tensor.shape[2] for tensor in tensors)
    return torch.cat([pad(tensor, (0, 0, 0, maximum - tensor.shape[2]), value=nan) for tensor in tensors])


CLASS = "class"
"""Parameter with the number of a class, of a recording with labels too; the metadata ``classes`` name it."""
GROUP = "group_"
"""What the parameter of a group is called, before its name; the metadata ``groups`` list its values."""


def one_hot(numbers: Tensor, count: int) -> Tensor:
    """Return labels (B, L), 0 or 1, of L = ``count`` classes with numbers (B,); NaN where that is NaN."""
    return (numbers[:, None] == torch.arange(count)).float().where(~numbers.isnan()[:, None], nan)


def touches_hash(touches: Touches) -> str:
    """Return a hash of readings and labels, 16 hexadecimal digits."""
    parts = [part for part in (touches.readings, touches.labels) if part is not None]
    return hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in parts)).hexdigest()[:16]


# Streams: touches with idle gaps between them, and the windows cut from them.


@dataclass(frozen=True)
class Timeline:
    """The gestures of a stream and their times.

    Attributes:
        movie: G gestures.
        begin: (G,), ascending, the frame of the stream at which each contact begins.
        length: F, frames; the last gesture may be truncated.
    """

    movie: Movie
    begin: Tensor
    length: int

    def __post_init__(self) -> None:
        if (self.begin[1:] <= self.end[:-1]).any():
            raise ValueError("gestures of a stream must be at least one frame apart")

    @property
    def duration(self) -> Tensor:
        """Frames in contact, (G,)."""
        return self.movie.parameters["duration"].long()

    @property
    def end(self) -> Tensor:
        """The frame after the last one of each gesture, (G,)."""
        return self.begin + self.duration

    def spread(self, values: Tensor, gap: float = 0.0) -> Tensor:
        """Return values of gestures, (G, T, ...), along the stream, (F, ...), and ``gap`` between."""
        gesture = torch.arange(len(self.begin)).repeat_interleave(self.duration)
        step = torch.arange(len(gesture)) - (self.duration.cumsum(0) - self.duration)[gesture]
        frame = self.begin[gesture] + step
        inside = frame < self.length
        column = (self.movie.parameters["onset"].long()[gesture] + step)[inside]
        result = values.new_full((self.length, *values.shape[2:]), gap)
        result[frame[inside]] = values[gesture[inside], column]
        return result

    def window_content(self, starts: Tensor, window: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the content of windows of ``window`` frames that begin at ``starts`` (W,).

        Returns:
            The gesture with the most frames in each window, (W,), the first in a tie, -1 without contact; the
            fraction of its contact frames in the window, (W,), 0 to 1; its labels and ``touch``, (W, L + 1),
            float32, even if the window shows a part of it, all 0 without contact.
        """
        nearest = torch.searchsorted(self.end, starts, right=True)
        maximum = max(1, int((torch.searchsorted(self.begin, starts + window) - nearest).amax()))
        candidates = (nearest[:, None] + torch.arange(maximum)).clamp(max=len(self.begin) - 1)
        first = torch.maximum(self.begin[candidates], starts[:, None])
        beyond = torch.minimum(self.end[candidates], starts[:, None] + window)
        seen, best = (beyond - first).clamp(min=0).max(dim=1)
        gesture = candidates[torch.arange(len(starts)), best]
        touched = seen > 0
        labels = torch.cat([self.movie.labels[gesture], torch.ones(len(starts), 1)], dim=1)
        return gesture.where(touched, -1), seen / self.duration[gesture], labels * touched[:, None]


def draw_timeline(
    sampler: AbstractSampler,
    length: int,
    gap: Sequence[int],
    generator: np.random.Generator,
    fewest: int = 16,
) -> Timeline:
    """Draw a stream of ``length`` frames that begins with a gap.

    Args:
        sampler: draws the gestures, with balanced labels.
        length: F, frames.
        gap: [least, most] idle frames between two touches, drawn uniformly, both ends included.
        generator: source of randomness.
        fewest: gestures drawn at a time.
    """
    sampler = copy(sampler)
    sampler.settings = replace(sampler.settings, ongoing=0.0)  # no window cuts the touches of a stream
    frames = sampler.settings.frames
    typical = (sum(frames.tap) + sum(frames.press)) / 4 + sum(gap) / 2
    movies: list[Movie] = []
    begins: list[np.ndarray] = []
    filled = 0
    while filled < length:
        count = max(fewest, math.ceil((length - filled) / typical))
        movies.append(sampler.sample(count, generator))
        duration = movies[-1].parameters["duration"].long().numpy()
        ends = filled + np.cumsum(duration + generator.integers(gap[0], gap[1], count, endpoint=True))
        begins.append(ends - duration)
        filled = int(ends[-1])
    begin = torch.from_numpy(np.concatenate(begins))
    inside = begin < length
    inside[0] = True  # at least one, even if a short stream ends before it
    return Timeline(join_movies(movies)[inside], begin[inside], length)


@dataclass(frozen=True)
class TouchStream:
    """The readings of a stream.

    Attributes:
        timeline: the gestures and their times.
        whole: the stream as one touch of F frames, (1, F, ...), without labels; its windows have labels.
    """

    timeline: Timeline
    whole: Recording

    @classmethod
    def of(cls, timeline: Timeline, gestures: Recording) -> "TouchStream":
        """Return the stream of gestures that were simulated one by one.

        Args:
            timeline: the times of the gestures.
            gestures: (G, T, ...), 0 without contact, so without noise or offset.
        """

        def along(values: Tensor | None, gap: float = 0.0) -> Tensor | None:
            return None if values is None else timeline.spread(values, gap)[None]

        readings = timeline.spread(gestures.touches.readings)[None]
        valid = torch.ones_like(readings, dtype=torch.bool)
        whole = replace(
            gestures,
            touches=replace(
                gestures.touches,
                readings=readings,
                valid=valid,
                labels=None,
                motion=along(gestures.touches.motion),
                contacts=along(gestures.touches.contacts, nan),
            ),
            task=TOUCH_OR_NOT.with_labels(gestures.task.names[len(TOUCH) :]),
            force=along(gestures.force),
            displacement=along(gestures.displacement),
            parameters={},
        )
        return cls(timeline, whole)

    def cut(self, starts: Tensor, window: int) -> Recording:
        """Return the windows (W, T, ...) of T = ``window`` frames that begin at ``starts`` (W,).

        Labels and ``fraction`` are those of :meth:`Timeline.window_content`. The other parameters are those
        of the gesture in the window, with its onset counted from the window's first frame, and 0 without a
        touch; ``clipped`` refers to the frames of the window.
        """
        frames = starts[:, None] + torch.arange(window)
        gesture, fraction, labels = self.timeline.window_content(starts, window)

        def windows(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[0][frames]

        whole, shown = self.whole, self.whole.touches
        drawn = {name: values[gesture] for name, values in self.timeline.movie.parameters.items()}
        drawn["onset"] = (self.timeline.begin[gesture] - starts).float()
        parameters = {name: values.where(gesture >= 0, 0) for name, values in drawn.items()}
        saturated = windows(shown.saturated)
        content = {} if saturated is None else {"clipped": saturated.flatten(1).any(1).float()}
        content |= {"share": fraction.float()}
        return replace(
            whole,
            touches=replace(
                shown,
                readings=shown.readings[0][frames],
                valid=shown.valid[0][frames],
                labels=labels,
                motion=windows(shown.motion),
                saturated=saturated,
                contacts=windows(shown.contacts),
            ),
            force=windows(whole.force),
            displacement=windows(whole.displacement),
            parameters=parameters | content,
        )


def only_touches(recording: Recording) -> Recording:
    """Return the windows that show a touch; all of them where the task has no label for that."""
    labels, gate = recording.touches.labels, recording.task.gate
    if labels is None or gate is None:
        return recording
    return recording[labels[:, recording.task.names.index(gate)] > 0.5]
