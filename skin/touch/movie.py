"""Pressure movies of gestures, each distinct frame kept once; their measures; the samplers that draw them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from skin.body.base import AbstractBody
from skin.touch.labels import TOUCH, report_labels
from skin.touch.paths import Draws, TouchSettings, Trajectories, heading
from skin.touch.shapes import Shapes

if TYPE_CHECKING:
    from skin.touch.gestures import GestureSettings


class Measures(NamedTuple):
    """Measures of each gesture of a movie; every tensor is (B,).

    Attributes:
        area: largest fraction of the sheet in contact in one frame.
        travel: furthest distance of the centre of pressure from its first position, m.
        frames: longest run of consecutive frames in contact.
        pressure: largest surface pressure over a sensor's footprint, Pa.
    """

    area: Tensor
    travel: Tensor
    frames: Tensor
    pressure: Tensor


def measure_gestures(
    frames: Tensor,
    index: Tensor,
    scale: Tensor,
    footprints: Tensor,
    cell: tuple[float, float],
    contact: float = 0.02,
    area: Tensor | None = None,
) -> Measures:
    """Measure gestures given as distinct frames, each processed once.

    Args:
        frames: (U, H, W), Pa; a frame belongs to one gesture.
        index: (B, T), index of the frame.
        scale: (B, T), factor of the frame, 0 without touch.
        footprints: (S, H * W), area weights of each sensor that sum to 1.
        cell: extent (x, y) of a cell, m.
        contact: fraction of the gesture's peak cell above which a cell is in contact.
        area: (U,), fraction of the sheet in contact in each frame; None: cells are counted.
    """
    flat = frames.flatten(1)
    highest = flat.amax(1)
    peak = (highest[index] * scale).amax(1)
    touched = highest[index] * scale > contact * peak[:, None]

    sensors, centre = _means(frames, footprints, cell)
    pressure = (sensors.amax(1)[index] * scale).amax(1)

    fractions = _areas(flat, index, contact * peak[:, None] / scale) if area is None else area
    area = fractions[index].where(touched, 0).amax(1)

    first = touched.int().argmax(1)
    path = centre[index]
    distance = torch.linalg.vector_norm(path - path[torch.arange(len(path)), first][:, None], dim=-1)
    travel = distance.where(touched, 0).amax(1)
    return Measures(area, travel, longest_run(touched), pressure)


def _areas(flat: Tensor, index: Tensor, lowest: Tensor, part: int = 256) -> Tensor:
    """Return the fraction of cells of frames (U, H * W) in contact, (U,).

    Args:
        flat: Pa.
        index: (B, T), the frame at each time.
        lowest: (B, T), the lowest pressure of a frame that counts as contact, Pa.
        part: number of frames compared at once: all cells at once would be as large as the movie, and these
            stay in the cache.
    """
    # The lowest pressure at the time when the frame has its largest scale.
    level = torch.full((len(flat),), torch.inf).to(flat)
    level.scatter_reduce_(0, index.flatten(), lowest.flatten(), "amin")
    parts = zip(flat.split(part), level[:, None].split(part), strict=True)
    return torch.cat([(values > limit).sum(1) for values, limit in parts]) / flat.shape[1]


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


def sliding(net: Tensor, length: Tensor, straight: float = 0.5) -> Tensor:
    """Return the cosines (B, 2) of the directions in which touches slide; 0, 0 where they have none.

    It is the direction from where a touch begins to where it ends. A path that was reflected at the edges so
    often that it leads away by less than half its length has no direction, like a static touch.

    Args:
        net: (B, 2), m, from the first position to the last.
        length: (B,), m, of the path.
        straight: fraction of the length.
    """
    distance = torch.linalg.vector_norm(net, dim=1)
    directed = (distance > 0) & (distance >= straight * length)
    return net / distance.where(directed, 1)[:, None] * directed[:, None]


@dataclass(frozen=True)
class Movie:
    """Pressure movies of a batch of gestures; a static touch is one frame with a time profile.

    Attributes:
        frames: (U, H, W), Pa, the distinct frames at full force, as loads of the simulator: mean pressures of
            cells, or moments of the pressure (:mod:`skin.touch.shapes`).
        index: (B, T), the frame at each time.
        scale: (B, T), its fraction of full force; 0 without contact.
        labels: (B, L), 0 or 1, float32: those of ``skin.touch.labels.TOUCH``, then labels of one's own.
        parameters: (B,) each: shape (index), angle (rad), stretch (``Shapes.render``), misfits (bodies drawn
            that had no room on the sheet), duration and onset (frames), direction (rad), speed (m per frame),
            peak (highest cell pressure, Pa), force (N, all cells at full force), draws (how many paths were
            drawn until one had the wanted labels), net_x and net_y (m, from the first position of the path
            to its last), x and y (m, that first position); area, travel, frames and pressure
            (``skin.touch.movie.Measures``), of which the labels are made; excess where there are limits
            (:meth:`skin.touch.labels.Limits.excess`, of one gesture); and where pressure is solved for,
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


# A second gesture at the same time, beside the first: sums of two movies of gestures.


def add_second(movie: Movie, fraction: float, contact: float, generator: np.random.Generator) -> Movie:
    """Return gestures of which a fraction has another gesture of the movie added.

    The second gesture overlaps the first in time, nowhere on the sheet, and has no label that the first does
    not have. The sum then keeps the labels of the first: a label holds if it holds for one of the two.
    A gesture that leaves no room for any other of the movie stays alone. The second one ends in the window.

    Args:
        movie: gestures (B,), whose pressures add up; without friction.
        fraction: of the gestures that get a second one, 0 to 1.
        contact: fraction of a frame's peak above which a cell is in contact.
        generator: source of randomness.

    Returns:
        The gestures (B,). The parameter ``contacts`` is the number of gestures at a time, 1 or 2; onset and
        duration are those of both together, force and the measures the largest.
    """
    first = torch.from_numpy(np.flatnonzero(generator.random(len(movie)) < fraction))
    random = torch.from_numpy(generator.random((len(first), len(movie) + 1)))
    whole = movie.parameters["onset"] + movie.parameters["duration"] <= movie.index.shape[1]
    kept = (movie.labels <= movie.labels[first][:, None]).all(dim=2)
    allowed = whole & kept & _apart(movie, first, contact)
    score, second = random[:, :-1].where(allowed, -1).max(dim=1)
    first, second, moment = first[score >= 0], second[score >= 0], random[score >= 0, -1]
    begin, times = _overlapping(movie, first, second, moment)

    fractions = movie.scale[first], movie.scale[second].gather(1, times)
    index = movie.index[first], movie.index[second].gather(1, times)
    full = movie.parameters["force"][:, None]
    total = full[first] * fractions[0] + full[second] * fractions[1]
    force = total.amax(dim=1)
    scale = total / force[:, None]
    touched = scale > 0
    one, other = (
        part[touched][:, None, None] * movie.frames[rows[touched]]
        for part, rows in zip(fractions, index, strict=True)
    )
    counts = touched.sum(dim=1)
    column = (touched.cumsum(dim=1) - 1).clamp(min=0) + (counts.cumsum(0) - counts)[:, None]

    parameters = {name: values.clone() for name, values in movie.parameters.items()}
    parameters["contacts"] = torch.ones(len(movie)).index_fill_(0, first, 2)
    for name in parameters.keys() & {"peak", "excess", *Measures._fields}:
        parameters[name][first] = torch.maximum(parameters[name][first], movie.parameters[name][second])
    onset = torch.minimum(movie.parameters["onset"][first], begin.float())
    parameters["onset"][first], parameters["duration"][first] = onset, counts.float()
    parameters["force"][first] = force
    indices, scales = movie.index.clone(), movie.scale.clone()
    indices[first], scales[first] = column + len(movie.frames), scale
    sums = Movie(
        torch.cat([movie.frames, (one + other) / scale[touched][:, None, None]]),
        indices,
        scales,
        movie.labels,
        parameters,
    )
    return sums[torch.arange(len(movie))]  # without the frames of first gestures alone


def _apart(movie: Movie, first: Tensor, contact: float) -> Tensor:
    """Return whether gestures never touch a cell that the ``first`` (N,) touch, (N, B), bool."""
    owner = torch.zeros(len(movie.frames), dtype=torch.long)
    owner[movie.index.flatten()] = torch.arange(len(movie)).repeat_interleave(movie.index.shape[1])
    flat = movie.frames.flatten(1)
    pressed = (flat > contact * flat.amax(dim=1, keepdim=True)).float()
    covered = torch.zeros(len(movie), flat.shape[1]).index_add_(0, owner, pressed).clamp_(max=1)
    return covered[first] @ covered.T == 0


def _overlapping(movie: Movie, first: Tensor, second: Tensor, moment: Tensor) -> tuple[Tensor, Tensor]:
    """Return when the second gestures begin, (N,), and what frame of theirs is at each time, (N, T).

    Args:
        movie: the gestures.
        first, second: (N,), the gestures that overlap.
        moment: (N,), 0 to 1, of the begins that make them overlap within the window.
    """
    window = movie.index.shape[1]
    onset, duration = (movie.parameters[name].long() for name in ("onset", "duration"))
    earliest = (onset[first] - duration[second] + 1).clamp(min=0)
    latest = torch.minimum(onset[first] + duration[first] - 1, window - duration[second])
    begin = earliest + (moment * (latest - earliest + 1)).long()
    return begin, (torch.arange(window) - (begin - onset[second])[:, None]) % window


# Samplers, which draw touches with given labels, and the contact that presses them.


class ContactProblem(NamedTuple):
    """The touched body and the criteria for labels.

    Attributes:
        shapes: the shapes and the body.
        footprints: (S, H * W), area weights of each sensor that sum to 1, float32.
        settings: ranges of the gestures, and the thresholds of the labels.
    """

    shapes: Shapes
    footprints: Tensor
    settings: "GestureSettings"


class ContactResult(NamedTuple):
    """The pressure of trajectories.

    Attributes:
        frames: (U, H, W), Pa, float32, each divided by its fraction of full force, so that all frames of a
            gesture have the same total force.
        force: (B,), full force, N.
        peak: (B,), peak cell pressure of the gesture, Pa.
        refused: (B,), bool, gestures whose frames are not valid, because no force gives the wanted labels or
            the contact did not converge.
        hopeless: (B,), bool, the refused gestures for which no other path can succeed.
        unconverged: (B,), number of frames that did not converge to the tolerance; None where all are exact.
        area: (U,), fraction of the sheet in contact, where the frames are moments of the pressure
            (:mod:`skin.touch.shapes`); None: frames are mean pressures of cells.
    """

    frames: Tensor
    force: np.ndarray
    peak: np.ndarray
    refused: np.ndarray
    hopeless: np.ndarray
    unconverged: np.ndarray | None = None
    area: np.ndarray | None = None


class AbstractContact(ABC):
    """Computes the pressure of objects on the cells of the skin.

    Attributes:
        proportional: whether pressure is proportional to force. A static touch is then one frame for any time
            profile, and the centre of pressure moves with the object.
        advice: end of the error message where the wanted labels do not occur.
    """

    proportional: ClassVar[bool]
    advice: ClassVar[str] = ""

    @abstractmethod
    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures at a force that gives the wanted labels, if there is one."""


def balanced(
    count: int, generator: np.random.Generator, kinds: Sequence[int] = range(2 ** len(TOUCH))
) -> np.ndarray:
    """Return label combinations (count, 4), bool, equally frequent, to within one, in random order.

    Args:
        count: B.
        generator: source of randomness.
        kinds: the combinations; bit n tells whether label n of ``TOUCH`` holds.
    """
    codes = generator.permutation(generator.permutation(kinds)[np.arange(count) % len(kinds)])
    return codes[:, None] >> np.arange(len(TOUCH)) & 1 > 0


class AbstractSampler(ABC):
    """Draws touches of a kind and renders their movies.

    Args:
        body: the sheet.
        footprints: (S, H * W), area weights of each sensor that sum to 1 (``AbstractBody.footprints``).
        contact: computes the pressure of touches.
        settings: of the touches.
        padded: whether touches begin at a random frame of the window instead of its first.
        moments: (S, H * W), weights of moments of the pressure in place of ``footprints``
            (:func:`skin.mechanics.geometry.footprints`). The frames of movies are then moments. None: they
            are mean pressures of cells.

    Attributes:
        labels: all labels by name: those of ``TOUCH``, then labels of one's own.
        leak: see :func:`skin.device.simulated.check_label_leakage`.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    def __init__(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: AbstractContact,
        settings: TouchSettings,
        padded: bool = True,
        moments: np.ndarray | None = None,
    ) -> None:
        self.body, self.contact, self.padded = body, contact, padded
        self.settings, self.leak = settings, float(getattr(settings, "leak", 1.0))
        self.labels = report_labels(settings.thresholds, settings.rate, settings.limits)
        self.labels |= settings.labels
        self.footprints = torch.as_tensor(footprints, dtype=torch.float32)
        self.moments = None if moments is None else torch.as_tensor(moments, dtype=torch.float32)
        self.shapes = Shapes(settings.shapes, body, settings.thresholds.contact, moments is not None)

    @property
    def kinds(self) -> Sequence[int]:
        """The combinations of labels that touches are drawn for, as of :func:`balanced`."""
        return range(2 ** len(TOUCH))

    @property
    def chosen(self) -> list[str]:
        """The labels that touches can be drawn for; the others follow."""
        return [name for bit, name in enumerate(TOUCH.names) if any(kind >> bit & 1 for kind in self.kinds)]

    def balanced(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return label combinations (count, 4), bool, that can be drawn, balanced, in random order."""
        return balanced(count, generator, self.kinds)

    @abstractmethod
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` touches.

        Args:
            count: B.
            generator: source of randomness.
            labels: (B, 4), bool, the wanted combinations; None: balanced.

        Raises:
            InputError: a combination of labels that does not occur on this sheet with these settings.
        """

    def _movie(
        self,
        frames: Tensor,
        drawn: Draws,
        paths: Trajectories,
        measures: Measures,
        contacts: Tensor | None = None,
    ) -> Movie:
        """Return the movie of touches (B,), whose labels follow from its parameters and frames.

        Args:
            frames: (U, H, W), Pa, or moments.
            drawn: of the touches, (B, ...), with peak (Pa), force (N) and number of paths drawn.
            paths: of the touches.
            measures: of the movie.
            contacts: of fingertips; see :class:`skin.touch.movie.Movie`.
        """
        drawn = drawn | dict(zip(("net_x", "net_y"), paths.net.T, strict=True))
        drawn |= dict(zip("xy", paths.poses.position[paths.first].T, strict=True))
        floats = {name: torch.from_numpy(drawn[name]).float() for name in _PARAMETERS}
        floats |= {name: value.float() for name, value in measures._asdict().items()}
        friction = self.settings.shear
        if limits := self.settings.limits:
            force = floats["force"] * paths.profile.amax(1)
            press = measures.frames > self.settings.frames.duration
            excess = limits.excess(floats["pressure"].numpy(), force.numpy(), press.numpy())
            floats["excess"] = torch.from_numpy(excess).float()
        drag = torch.from_numpy(friction * heading(paths.position, paths.first)).float()
        movie = Movie(
            frames,
            paths.index,
            paths.profile,
            torch.empty(0),
            floats,
            drag if friction else None,
            contacts,
        )
        held = [label.measure(movie, self.body) > label.above for label in self.labels.values()]
        return replace(movie, labels=torch.stack(held, dim=1).float())


_PARAMETERS = (
    *("shape", "angle", "stretch", "misfits", "duration", "onset", "direction", "speed"),
    *("peak", "force", "draws", "net_x", "net_y", "x", "y"),
)
