"""Labels of a touch, and how they follow from its pressure movie."""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from annotated_types import Ge, Gt, Lt, MinLen
from torch import Tensor

from skin.settings import ONCE, checked

_PART = 256
_STRAIGHT = 0.5


@dataclass(frozen=True)
class Task:
    """Names and kind of a device's labels; they determine head width, loss, metrics and table columns.

    Attributes:
        names: one name per label, in the order of the label tensor's last axis.
        kind: ``binary`` (each label holds or not by itself) or ``exclusive`` (exactly one holds).
        gate: the label without which the others are undefined (report, 4.2), such as ``touch``; None: all
            labels are always defined.
        direction: the last two labels are not binary but the cosines of a direction with x and y, -1 to 1.
            Both are 0 if a touch has no direction; they are then undefined.

    Raises:
        ValueError: the gate is no label, or labels with a gate or a direction are not binary.
    """

    names: Annotated[tuple[str, ...], MinLen(1), ONCE]
    kind: Literal["binary", "exclusive"] = "binary"
    gate: str | None = None
    direction: bool = False

    def __post_init__(self) -> None:
        if self.gate is not None and (self.kind != "binary" or self.gate not in self.binary):
            raise ValueError(f"{self.gate} is no gate of the {self.kind} labels {self.names}")
        if self.direction and (self.kind != "binary" or len(self.names) < 3):
            raise ValueError(f"a direction stands behind binary labels, got {self.kind} {self.names}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def binary(self) -> tuple[str, ...]:
        """The names of all labels but a direction's."""
        return self.names[:-2] if self.direction else self.names

    @property
    def gated(self) -> tuple[str, ...]:
        """The names of all labels but the gate and a direction's."""
        return tuple(name for name in self.binary if name != self.gate)

    def counts(self, labels: Tensor) -> Tensor:
        """Return the mask of the labels (B, L) that are defined, bool, by gate and direction."""
        counts = torch.ones_like(labels, dtype=torch.bool)
        if self.gate is not None:
            gate = self.names.index(self.gate)
            counts = (labels[:, gate : gate + 1] > 0.5).repeat(1, len(self))
            counts[:, gate] = True
        if self.direction:
            counts[:, -2:] &= (labels[:, -2:] != 0).any(dim=1, keepdim=True)
        return counts

    def shares(self, labels: Tensor) -> Tensor:
        """Return labels (B, L) as what a probability should be on average, 0 to 1: cosines c as (1 + c) / 2.

        The mean of c has the least cross-entropy then, as the share of true cases has it of a binary label.
        """
        return torch.cat([labels[:, :-2], (1 + labels[:, -2:]) / 2], dim=1) if self.direction else labels


TOUCH = Task(("big", "dynamic", "press", "dangerous"))
"""The four binary labels of the report, section 2.1.1."""

TOUCH_OR_NOT = Task((*TOUCH.names, "touch"), gate="touch")
"""The same with the report's fifth label (section 4.2); where it is 0 the other four are 0 too."""

TOUCH_SLIDING = Task((*TOUCH.names, "slide_x", "slide_y"), direction=True)
"""The four binary labels and the direction of sliding, as :func:`sliding` gives it."""


def sliding(net: Tensor, way: Tensor) -> Tensor:
    """Return the cosines (B, 2) of the directions in which touches slide; 0, 0 where they have none.

    It is the direction from where a touch begins to where it ends. A path that leads less than half its
    length away, because it was turned at the edges, goes to and fro: it has no direction, like one that
    stands still.

    Args:
        net: (B, 2), m, from the first place to the last.
        way: (B,), m, the length of the path.
    """
    far = torch.linalg.vector_norm(net, dim=1)
    straight = (far > 0) & (far >= _STRAIGHT * way)
    return net / far.where(straight, 1)[:, None] * straight[:, None]


OPPOSITE = {"big": "small", "dynamic": "static", "press": "tap", "dangerous": "safe"}
"""Label -> name of its opposite."""


@checked("touch.thresholds")
@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the labels (report, section 2.1.1).

    Attributes:
        area: a touch is big if it covers more than this share of the sheet.
        duration: a touch is a press if it lasts longer than this without interruption, s.
        pressure: a touch is dangerous if some sensor's surface pressure exceeds this in some frame, Pa
            (cuff algometry, Jespersen et al.).
        contact: cells above this share of the gesture's peak cell are in contact.
        travel: a touch is dynamic if its centre of pressure moves further than this from where it began, m.
    """

    area: Annotated[float, Gt(0), Lt(1)] = 0.30
    duration: Annotated[float, Ge(0)] = 0.3
    pressure: float = 90.5e3
    contact: Annotated[float, Gt(0), Lt(1)] = 0.02
    travel: float = 1e-3


class Measures(NamedTuple):
    """Measures of each gesture of a movie; every tensor is (B,).

    Attributes:
        area: largest share of the sheet in contact in one frame.
        travel: furthest distance of the centre of pressure from its first place, m.
        frames: longest run of consecutive frames in contact.
        pressure: largest surface pressure over a sensor's footprint, Pa.
    """

    area: Tensor
    travel: Tensor
    frames: Tensor
    pressure: Tensor

    def labels(self, thresholds: Thresholds, rate: float) -> Tensor:
        """Return the labels (B, 4), 0 or 1, float32, in the order of ``TOUCH``.

        Args:
            thresholds: of the labels.
            rate: frames per second of the movie, Hz.
        """
        big = self.area > thresholds.area
        dynamic = self.travel > thresholds.travel
        press = self.frames > round(thresholds.duration * rate)
        dangerous = self.pressure > thresholds.pressure
        return torch.stack([big, dynamic, press, dangerous], dim=1).float()


def measure_gestures(
    frames: Tensor,
    index: Tensor,
    scale: Tensor,
    footprints: Tensor,
    cell: tuple[float, float],
    contact: float = Thresholds.contact,
) -> Measures:
    """Measure gestures given as distinct frames, each processed once.

    Args:
        frames: (U, H, W), Pa; a frame belongs to one gesture.
        index: (B, T), index of the frame.
        scale: (B, T), factor of the frame, 0 without touch.
        footprints: (S, H * W), area weights of each sensor that sum to 1.
        cell: extent (x, y) of a cell, m.
        contact: share of the gesture's peak cell above which a cell is in contact.
    """
    count, height, width = frames.shape
    flat = frames.flatten(1)
    highest = flat.amax(1)
    peak = (highest[index] * scale).amax(1)
    touched = highest[index] * scale > contact * peak[:, None]

    sensors, centre = _means(frames, footprints, cell)
    pressure = (sensors.amax(1)[index] * scale).amax(1)

    # The lowest pressure that counts as contact, where a frame is shown at its strongest.
    level = torch.full((count,), torch.inf).to(frames)
    lowest = contact * peak[:, None] / scale
    level.scatter_reduce_(0, index.flatten(), lowest.flatten(), "amin")
    # In parts that stay in the cache: the comparison of all cells at once would be as large as the movie.
    parts = zip(flat.split(_PART), level[:, None].split(_PART), strict=True)
    cells = torch.cat([(part > limit).sum(1) for part, limit in parts])
    area = cells[index].where(touched, 0).amax(1) / (height * width)

    first = touched.int().argmax(1)
    places = centre[index]
    distance = torch.linalg.vector_norm(places - places[torch.arange(len(places)), first][:, None], dim=-1)
    travel = distance.where(touched, 0).amax(1)
    return Measures(area, travel, longest_run(touched), pressure)


def _means(frames: Tensor, footprints: Tensor, cell: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Return the mean pressure over each footprint (U, S), Pa, and the centre of pressure (U, 2), m."""
    height, width = frames.shape[1:]
    y, x = torch.meshgrid(
        (torch.arange(height) + 0.5) * cell[1], (torch.arange(width) + 0.5) * cell[0], indexing="ij"
    )
    moments = torch.stack([torch.ones_like(x), x, y]).flatten(1)
    # One product reads the frames once for the footprints, the total and both first moments.
    means = frames.flatten(1) @ torch.cat([footprints.to(frames), moments.to(frames)]).T
    return means[:, :-3], means[:, -2:] / means[:, -3:-2].clamp(min=1e-30)


def longest_run(active: Tensor) -> Tensor:
    """Return the length of the longest run of true values over time, (B, ...), of active (B, T, ...)."""
    passed = active.cumsum(dim=1, dtype=torch.int32)
    before = torch.where(active, 0, passed).cummax(dim=1).values
    return (passed - before).amax(dim=1)


def movie_labels(
    pressure: Tensor,
    footprints: Tensor,
    cell: tuple[float, float],
    thresholds: Thresholds | None = None,
    rate: float = 10.0,
) -> Tensor:
    """Return the labels (B, 4) that a dense pressure movie gives.

    Args:
        pressure: (B, T, H, W), Pa.
        footprints: (S, H * W), area weights of each sensor that sum to 1.
        cell: extent (x, y) of a cell, m.
        thresholds: of the labels; None: those of the report.
        rate: frames per second, Hz.
    """
    thresholds = thresholds or Thresholds()
    batch, time = pressure.shape[:2]
    index = torch.arange(batch * time, device=pressure.device).view(batch, time)
    scale = torch.ones(batch, time).to(pressure)
    measures = measure_gestures(pressure.flatten(0, 1), index, scale, footprints, cell, thresholds.contact)
    return measures.labels(thresholds, rate)
