"""Pressure movies of gestures; each distinct frame is kept once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.touch.labels import Thresholds

# Measures of gestures, from which their labels follow.


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
    area: Tensor | None = None,
) -> Measures:
    """Measure gestures given as distinct frames, each processed once.

    Args:
        frames: (U, H, W), Pa; a frame belongs to one gesture.
        index: (B, T), index of the frame.
        scale: (B, T), factor of the frame, 0 without touch.
        footprints: (S, H * W), area weights of each sensor that sum to 1.
        cell: extent (x, y) of a cell, m.
        contact: share of the gesture's peak cell above which a cell is in contact.
        area: (U,), share of the sheet in contact in each frame; None: cells are counted.
    """
    flat = frames.flatten(1)
    highest = flat.amax(1)
    peak = (highest[index] * scale).amax(1)
    touched = highest[index] * scale > contact * peak[:, None]

    sensors, centre = _means(frames, footprints, cell)
    pressure = (sensors.amax(1)[index] * scale).amax(1)

    shares = _areas(flat, index, contact * peak[:, None] / scale) if area is None else area
    area = shares[index].where(touched, 0).amax(1)

    first = touched.int().argmax(1)
    places = centre[index]
    distance = torch.linalg.vector_norm(places - places[torch.arange(len(places)), first][:, None], dim=-1)
    travel = distance.where(touched, 0).amax(1)
    return Measures(area, travel, longest_run(touched), pressure)


def _areas(flat: Tensor, index: Tensor, lowest: Tensor) -> Tensor:
    """Return the share of cells of frames (U, H * W) in contact, (U,).

    Args:
        flat: Pa.
        index: (B, T), the frame at each time.
        lowest: (B, T), the lowest pressure of a frame that counts as contact, Pa.
    """
    # That where a frame is shown at its strongest.
    level = torch.full((len(flat),), torch.inf).to(flat)
    level.scatter_reduce_(0, index.flatten(), lowest.flatten(), "amin")
    # In parts that stay in the cache: the comparison of all cells at once would be as large as the movie.
    parts = zip(flat.split(_PART), level[:, None].split(_PART), strict=True)
    return torch.cat([(part > limit).sum(1) for part, limit in parts]) / flat.shape[1]


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


@dataclass(frozen=True)
class Movie:
    """Pressure movies of a batch of gestures; a static touch is one frame with a time profile.

    Attributes:
        frames: (U, H, W), Pa, the distinct frames at full force, as loads of the simulator: mean pressures of
            cells, or moments of the pressure (:mod:`skin.touch.splines`).
        index: (B, T), the frame at each time.
        scale: (B, T), its share of full force; 0 without contact.
        labels: (B, 4), 0 or 1, float32, in the order of ``skin.touch.labels.TOUCH``.
        parameters: (B,) each: shape (index), angle (rad), stretch (``Shapes.render``), misfits (bodies drawn
            that had no room on the sheet), duration and onset (frames), direction (rad), speed (m per frame),
            peak (highest cell pressure, Pa), force (N, all cells at full force), draws (how many paths were
            drawn until one had the wanted labels), net_x and net_y (m, from the first place of the path to
            its last), x and y (m, that first place); area, travel, frames and pressure
            (``skin.touch.movie.Measures``), which make the labels; and where pressure is solved for,
            unconverged (frames of all its draws that were not found).
        shear: (U, 2), tangential traction along x and y of each frame divided by its pressure: the
            coefficient of friction times the direction of motion, 0 for static touches; None: no friction.
        contacts: (B, T, K, 5), of fingertips: x, y, radius (m), force (N) and peak pressure (Pa) of each at
            each time, NaN where there is none; None: unknown.
    """

    frames: Tensor
    index: Tensor
    scale: Tensor
    labels: Tensor
    parameters: dict[str, Tensor]
    shear: Tensor | None = None
    contacts: Tensor | None = None

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: Tensor) -> "Movie":
        """Return the movies of some gestures, without unused frames."""
        index = self.index[rows]
        used = torch.zeros(len(self.frames), dtype=torch.bool)
        used[index.flatten()] = True
        return Movie(
            self.frames if used.all() else self.frames[used],
            (used.cumsum(0) - 1)[index],
            self.scale[rows],
            self.labels[rows],
            {name: values[rows] for name, values in self.parameters.items()},
            None if self.shear is None else self.shear[used],
            None if self.contacts is None else self.contacts[rows],
        )

    @property
    def force(self) -> Tensor:
        """Applied force, (B, T), N."""
        return self.parameters["force"][:, None] * self.scale

    @property
    def slides(self) -> Tensor:
        """Cosines of the sliding directions, (B, 2); see ``skin.touch.movie.sliding``."""
        parameters = self.parameters
        net = torch.stack([parameters["net_x"], parameters["net_y"]], dim=1)
        return sliding(net, parameters["speed"] * (parameters["duration"] - 1))

    def pressure(self) -> Tensor:
        """Return the dense movie, (B, T, H, W), Pa."""
        return self.frames[self.index] * self.scale[..., None, None]


def join_movies(movies: Sequence[Movie]) -> Movie:
    """Return one movie of all gestures of ``movies``, in order."""
    starts = np.cumsum([0, *(len(movie.frames) for movie in movies)])
    shears = [movie.shear for movie in movies if movie.shear is not None]
    contacts = [movie.contacts for movie in movies if movie.contacts is not None]
    return Movie(
        torch.cat([movie.frames for movie in movies]),
        torch.cat([movie.index + int(start) for movie, start in zip(movies, starts, strict=False)]),
        torch.cat([movie.scale for movie in movies]),
        torch.cat([movie.labels for movie in movies]),
        {name: torch.cat([movie.parameters[name] for movie in movies]) for name in movies[0].parameters},
        torch.cat(shears) if shears else None,
        torch.cat(contacts) if contacts else None,
    )
