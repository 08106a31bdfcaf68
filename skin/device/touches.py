"""Touches, the type that every device yields, and Recording, its stored form."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from skin.body.base import GEOMETRY
from skin.errors import InputError
from skin.touch.labels import Task


@dataclass(frozen=True)
class Touches:
    """A batch of touches as any device yields it.

    Attributes:
        readings: (B, T, S), N.
        valid: (B, T, S), bool: False for invalid readings (dead sensor, lost frame).
        positions: (S, 3), (B, S, 3) or (B, T, S, 3), m: x right and y down from the upper left corner, z
            depth.
        labels: (B, L), 0 or 1, float; or None.
        rate: frames per second, Hz.
        motion: (B, T, S, 3), m, how far each sensor is from its place in ``positions``, along the same axes;
            None if unknown.
        saturated: (B, T, S), bool: the sensor is at its limit, so the force is at least its reading; None
            if unknown.
        geometry: (S, G) or (B, S, G), the columns :data:`GEOMETRY` of each sensor; None if unknown.

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

    def __post_init__(self) -> None:
        if self.readings.ndim != 3:
            raise ValueError(f"readings must be (B, T, S), got {tuple(self.readings.shape)}")
        if self.valid.dtype != torch.bool:
            raise ValueError(f"valid must be bool, got {self.valid.dtype}")
        batch, time, sensors = self.readings.shape
        scalars, moving = (batch, time, sensors), (batch, time, sensors, 3)
        geometry_shape = (sensors, len(GEOMETRY))
        _expect(self.valid, "valid", scalars)
        _expect(self.positions, "positions", (sensors, 3), (batch, sensors, 3), moving)
        _expect(self.geometry, "geometry", geometry_shape, (batch, *geometry_shape))
        _expect(self.motion, "motion", moving)
        _expect(self.saturated, "saturated", scalars)
        if self.labels is not None and (self.labels.ndim != 2 or len(self.labels) != batch):
            raise ValueError(f"labels must be (B, L), B = {batch}, got {tuple(self.labels.shape)}")

    def __len__(self) -> int:
        return len(self.readings)

    def __getitem__(self, index: Tensor | slice) -> "Touches":
        """Return the touches that ``index`` selects; positions common to all touches stay common."""
        return Touches(
            self.readings[index],
            self.valid[index],
            self.positions if self.positions.ndim == 2 else self.positions[index],
            None if self.labels is None else self.labels[index],
            self.rate,
            None if self.motion is None else self.motion[index],
            None if self.saturated is None else self.saturated[index],
            self.geometry if self.geometry is None or self.geometry.ndim == 2 else self.geometry[index],
        )

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

    touches = replace(
        first.touches,
        readings=torch.cat([part.touches.readings for part in parts]),
        valid=torch.cat([part.touches.valid for part in parts]),
        labels=together(part.touches.labels for part in parts),
        motion=together(part.touches.motion for part in parts),
        saturated=together(part.touches.saturated for part in parts),
    )
    return replace(
        first,
        touches=touches,
        force=together(part.force for part in parts),
        displacement=together(part.displacement for part in parts),
        parameters={name: torch.cat([part.parameters[name] for part in parts]) for name in first.parameters},
    )


def touches_hash(touches: Touches) -> str:
    """Return a hash of readings and labels, 16 hexadecimal digits."""
    content = hashlib.sha256(touches.readings.contiguous().numpy().tobytes())
    if touches.labels is not None:
        content.update(touches.labels.contiguous().numpy().tobytes())
    return content.hexdigest()[:16]
