"""Sampled gestures and their pressure movies, each frame rendered once."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skin.body.sheet import Sheet
from skin.errors import InputError
from skin.gesture import Draws, GestureSettings, draw_gestures, draw_paths, fold
from skin.labels import TOUCH, measure
from skin.shapes import Shapes
from skin.simulator.base import AbstractSimulator, Response

__all__ = ["Movie", "TouchSampler", "balanced"]

_ATTEMPTS = 50


@dataclass(frozen=True)
class Movie:
    """Pressure movies of a batch of gestures; a touch that stands still is one frame under a time profile.

    Attributes:
        frames: (U, H, W), Pa, the distinct frames at full force.
        index: (B, T), which frame is shown.
        scale: (B, T), its share of full force; 0 where nothing touches.
        labels: (B, 4), 0 or 1, float32, in the order of ``skin.labels.TOUCH``.
        parameters: (B,) each: shape (index), angle (rad), duration and onset (frames), direction (rad), speed
            (m per frame), peak (highest cell pressure, Pa), force (N, all cells at full force), area (largest
            share of the sheet in contact), draws (how many were drawn until one had the wanted labels).
    """

    frames: Tensor
    index: Tensor
    scale: Tensor
    labels: Tensor
    parameters: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.index)

    @property
    def force(self) -> Tensor:
        """Applied force, (B, T), N."""
        return self.parameters["force"][:, None] * self.scale

    def pressure(self) -> Tensor:
        """Return the dense movie, (B, T, H, W), Pa."""
        return self.frames[self.index] * self.scale[..., None, None]

    def respond(self, simulator: AbstractSimulator, displacement: bool = True) -> Response:
        """Return a simulator's readings (B, T, S), N, and displacement (B, T, S, 2), m.

        The displacement is None if the simulator knows none, or if it is not asked for.
        """
        home = next(simulator.buffers(), self.frames).device
        readings, moves = simulator(self.frames.to(home))
        index, scale = self.index.to(home), self.scale.to(home)
        if not displacement or moves is None:
            return Response(readings[index] * scale[..., None], None)
        return Response(readings[index] * scale[..., None], moves[index] * scale[..., None, None])


def balanced(count: int, generator: np.random.Generator) -> np.ndarray:
    """Return label combinations (count, 4), bool: all 16 equally often, to within one, in random order."""
    order = generator.permutation(16)[np.arange(count) % 16]
    return (generator.permutation(order)[:, None] >> np.arange(4) & 1).astype(bool)


class TouchSampler:
    """Draws gestures of wanted labels and renders their movies.

    The label is what the movie gives. Where it differs from the wanted one the path is drawn again (start,
    direction, speed, peak), up to ``redraws`` times; only then the whole gesture.

    Args:
        body: the sheet.
        footprints: (S, H * W), area weights of each sensor that sum to 1 (``Sheet.footprints``).
        settings: the difficulty, as ``conf/touch.yaml`` gives it.
        padded: gestures begin at a random frame of the window, not at its first.

    Raises:
        InputError: settings or pictures that cannot be used.
    """

    def __init__(
        self,
        body: Sheet,
        footprints: np.ndarray,
        settings: Mapping[str, Any] | GestureSettings | None = None,
        padded: bool = True,
    ) -> None:
        self.body = body
        self.settings = GestureSettings.of(settings)
        self.padded = padded
        self.footprints = torch.as_tensor(footprints, dtype=torch.float32)
        self.shapes = Shapes(self.settings.shapes, body, self.settings.thresholds.contact)

    @torch.no_grad()
    def sample(self, count: int, generator: np.random.Generator, labels: np.ndarray | None = None) -> Movie:
        """Return the movies of ``count`` gestures.

        Args:
            count: B.
            generator: where all randomness comes from.
            labels: (B, 4), bool, the wanted combinations; None: balanced.

        Raises:
            InputError: some combination of labels is never met on this sheet with these settings.
        """
        wanted = balanced(count, generator) if labels is None else labels
        settings, reel = self.settings, _Reel(count, self.settings.window)
        pending = np.arange(count)
        for _ in range(_ATTEMPTS):
            # Every round draws for the whole batch, so that one gesture's redraws never move another's.
            gestures = draw_gestures(wanted, settings, self.shapes, self.padded, generator)
            for _ in range(settings.redraws):
                chance = generator.random((count, 5))
                paths = draw_paths(wanted, gestures, settings, self.body.size, chance)
                # Sorted by scale, because frames of one texture level are rendered together.
                pending = pending[np.argsort(gestures["scale"][pending], kind="stable")]
                trial = {name: values[pending] for name, values in (gestures | paths).items()}
                pending = pending[~reel.keep(pending, wanted[pending], *self._press(trial))]
                if not len(pending):
                    return reel.movie(torch.from_numpy(wanted).float())
        raise _never(wanted[pending[0]], settings)

    def _press(self, gestures: Draws) -> tuple[Tensor, Tensor, Tensor, Tensor, Draws]:
        """Render gestures (B,): frames, index and scale as in :class:`Movie`, labels, parameters."""
        body, settings = self.body, self.settings
        duration, onset, sliding = gestures["duration"], gestures["onset"], gestures["speed"] > 0
        time = np.arange(settings.window) - onset[:, None]
        rise = duration[:, None] // settings.ramp + 1
        scale = np.clip(np.minimum(time + 1, duration[:, None] - time) / rise, 0, 1)

        counts = np.where(sliding, duration, 1)
        first = np.cumsum(counts) - counts
        index = first[:, None] + np.clip(time, 0, counts[:, None] - 1)
        owner = np.repeat(np.arange(len(counts)), counts)
        step = (np.arange(len(owner)) - first[owner])[:, None]
        velocity = gestures["speed"] * np.stack(
            [np.cos(gestures["direction"]), np.sin(gestures["direction"])]
        )
        way = fold(gestures["start"][owner] + step * velocity.T[owner], gestures["room"][owner])
        shape, angle, size = (gestures[name][owner] for name in ("shape", "angle", "scale"))
        frames = self.shapes.render(shape, angle, size, way - gestures["low"][owner])

        # Equation 2: the drawn peak is the largest cell of the whole movie.
        shown, shares = torch.from_numpy(index), torch.from_numpy(scale).float()
        highest = (frames.flatten(1).amax(1)[shown] * shares).amax(1).double().numpy()
        cell = body.cell[0] * body.cell[1]
        force = gestures["peak"] * cell / highest
        frames *= torch.from_numpy(force / cell).float()[torch.from_numpy(owner), None, None]
        measures = measure(frames, shown, shares, self.footprints, body.cell, settings.thresholds.contact)
        labels = measures.labels(settings.thresholds)
        parameters = gestures | {"force": force, "area": measures.area.numpy()}
        return frames, shown, shares, labels, parameters


class _Reel:
    """Collects accepted gestures of a batch, round after round, until their movie is complete."""

    _NAMES = ("shape", "angle", "duration", "onset", "direction", "speed", "peak", "force", "area")

    def __init__(self, count: int, window: int) -> None:
        self.frames: list[Tensor] = []
        self.length = 0
        self.index = torch.zeros(count, window, dtype=torch.long)
        self.scale = torch.zeros(count, window)
        self.parameters = {name: torch.zeros(count) for name in (*self._NAMES, "draws")}

    def keep(
        self,
        rows: np.ndarray,
        wanted: np.ndarray,
        frames: Tensor,
        index: Tensor,
        scale: Tensor,
        labels: Tensor,
        parameters: Draws,
    ) -> np.ndarray:
        """Keep the gestures that have the wanted labels; return which of ``rows`` they are, bool."""
        found = (labels.numpy() == wanted).all(axis=1)
        accepted, places = torch.from_numpy(found), torch.from_numpy(rows)
        self.parameters["draws"][places] += 1
        kept = torch.zeros(len(frames), dtype=torch.bool)
        kept[index[accepted].flatten()] = True
        self.index[places[accepted]] = (kept.cumsum(0) - 1 + self.length)[index[accepted]]
        self.scale[places[accepted]] = scale[accepted]
        for name in self._NAMES:
            self.parameters[name][places[accepted]] = torch.from_numpy(parameters[name][found]).float()
        self.frames.append(frames[kept])
        self.length += len(self.frames[-1])
        return found

    def movie(self, labels: Tensor) -> Movie:
        """Return what was collected."""
        return Movie(torch.cat(self.frames), self.index, self.scale, labels, self.parameters)


def _never(labels: np.ndarray, settings: GestureSettings) -> InputError:
    names = ", ".join(name if on else f"not {name}" for name, on in zip(TOUCH.names, labels, strict=True))
    return InputError(
        f"no gesture in {_ATTEMPTS * settings.redraws} draws was {names}: on this sheet, with these sensors, "
        "the ranges under touch rule it out; sensors far apart hardly feel a small dangerous touch, so raise "
        "touch.small_area or touch.dangerous_peak, or add sensors"
    )
