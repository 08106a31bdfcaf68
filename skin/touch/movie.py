"""Pressure movies of gestures; each distinct frame is kept once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from skin.gesture_measures import sliding


@dataclass(frozen=True)
class Movie:
    """Pressure movies of a batch of gestures; a static touch is one frame with a time profile.

    Attributes:
        frames: (U, H, W), Pa, the distinct frames at full force.
        index: (B, T), the frame at each time.
        scale: (B, T), its share of full force; 0 without contact.
        labels: (B, 4), 0 or 1, float32, in the order of ``skin.labels.TOUCH``.
        parameters: (B,) each: shape (index), angle (rad), stretch (``Shapes.render``), misfits (bodies drawn
            that had no room on the sheet), duration and onset (frames), direction (rad), speed (m per frame),
            peak (highest cell pressure, Pa), force (N, all cells at full force), draws (how many paths were
            drawn until one had the wanted labels), net_x and net_y (m, from the first place of the path to
            its last), x and y (m, that first place); area, travel, frames and pressure
            (``skin.gesture_measures.Measures``), which make the labels; and where pressure is solved for,
            unconverged (frames of all its draws that were not found).
        shear: (U, 2), tangential traction along x and y of each frame divided by its pressure: the
            coefficient of friction times the direction of motion, 0 for static touches; None: no friction.
    """

    frames: Tensor
    index: Tensor
    scale: Tensor
    labels: Tensor
    parameters: dict[str, Tensor]
    shear: Tensor | None = None

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: Tensor) -> "Movie":
        """Return the movies of some gestures, without unused frames."""
        index = self.index[rows]
        shown = torch.zeros(len(self.frames), dtype=torch.bool)
        shown[index.flatten()] = True
        return Movie(
            self.frames if shown.all() else self.frames[shown],
            (shown.cumsum(0) - 1)[index],
            self.scale[rows],
            self.labels[rows],
            {name: values[rows] for name, values in self.parameters.items()},
            None if self.shear is None else self.shear[shown],
        )

    @property
    def force(self) -> Tensor:
        """Applied force, (B, T), N."""
        return self.parameters["force"][:, None] * self.scale

    @property
    def slides(self) -> Tensor:
        """Cosines of the sliding directions, (B, 2); see ``skin.gesture_measures.sliding``."""
        known = self.parameters
        net = torch.stack([known["net_x"], known["net_y"]], dim=1)
        return sliding(net, known["speed"] * (known["duration"] - 1))

    def pressure(self) -> Tensor:
        """Return the dense movie, (B, T, H, W), Pa."""
        return self.frames[self.index] * self.scale[..., None, None]


def join_movies(movies: Sequence[Movie]) -> Movie:
    """Return one movie of all gestures of ``movies``, in order."""
    starts = np.cumsum([0, *(len(movie.frames) for movie in movies)])
    shears = [movie.shear for movie in movies if movie.shear is not None]
    return Movie(
        torch.cat([movie.frames for movie in movies]),
        torch.cat([movie.index + int(start) for movie, start in zip(movies, starts, strict=False)]),
        torch.cat([movie.scale for movie in movies]),
        torch.cat([movie.labels for movie in movies]),
        {name: torch.cat([movie.parameters[name] for movie in movies]) for name in movies[0].parameters},
        torch.cat(shears) if shears else None,
    )
