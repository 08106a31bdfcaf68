"""Measures of gestures, from which their labels follow."""

from typing import NamedTuple

import torch
from torch import Tensor

from skin.labels import Thresholds

_PART = 256
_STRAIGHT = 0.5


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
