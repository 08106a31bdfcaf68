"""Gesture settings, and the draws of shape, time and path."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from skin.errors import InputError
from skin.labels import Thresholds
from skin.touch._bodies import Fit, draw_bodies
from skin.touch.shapes import Shapes

__all__ = ["Draws", "GestureSettings", "draw_gestures", "draw_paths", "fold", "heading"]

Draws = dict[str, np.ndarray]
"""Named parameters of gestures, one entry each along the first axis."""


@dataclass(frozen=True)
class GestureSettings:
    """The difficulty of the task; ``conf/touch.yaml`` holds the same defaults and says each unit.

    Ranges are (least, most), drawn evenly, both ends included.

    Raises:
        InputError: a range that is empty, out of order, or on the wrong side of its threshold.
    """

    window: int = 30
    shapes: tuple[str, ...] = ("disc", "blurred_disc", "square", "bar", "fist", "hand", "fingertip")
    small_area: tuple[float, float] = (0.01, 0.30)
    big_area: tuple[float, float] = (0.30, 0.70)
    tap: tuple[int, int] = (1, 3)
    press: tuple[int, int] = (4, 20)
    safe_peak: tuple[float, float] = (10e3, 90.5e3)
    dangerous_peak: tuple[float, float] = (90.5e3, 180e3)
    speed: tuple[float, float] = (0.003, 0.020)
    path: float = 0.010
    spare: float = 0.010
    ramp: int = 3
    shear: float = 0.0
    redraws: int = 30
    stretch: float = 4.0
    leak: float = 0.6
    strict: bool = False
    gap: tuple[int, int] = (10, 60)
    stride: tuple[int, int] = (15, 45)
    thresholds: Thresholds = field(default_factory=Thresholds)

    @classmethod
    def of(cls, given: "Mapping[str, Any] | GestureSettings | None") -> "GestureSettings":
        """Return the settings that a configuration means; what it leaves out keeps its default."""
        if isinstance(given, GestureSettings):
            return given
        values = dict(given or {})
        limits = values.pop("thresholds", {})
        if isinstance(limits, Thresholds):
            limits = vars(limits)
        for keys, known, prefix in ((values, cls, "touch"), (limits, Thresholds, "touch.thresholds")):
            names = [entry.name for entry in fields(known)]
            if unknown := sorted(set(keys) - set(names)):
                raise InputError(f"{prefix} has no {', '.join(unknown)}: it takes {', '.join(names)}")
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        return cls(**values, thresholds=Thresholds(**limits))

    def __post_init__(self) -> None:
        lines = self.thresholds
        if not self.shapes or isinstance(self.shapes, str):
            raise InputError(
                f"touch.shapes must list at least one shape, got {self.shapes!r}: as in [disc,hand]"
            )
        # (name, lowest allowed, highest allowed): a range beyond its threshold would be redrawn for ever.
        for name, low, high in (
            ("small_area", 0, lines.area),
            ("big_area", lines.area, 1),
            ("tap", 1, min(lines.frames, self.window)),
            ("press", lines.frames + 1, self.window),
            ("safe_peak", 0, lines.pressure),
            ("dangerous_peak", lines.pressure, np.inf),
            ("speed", 0, np.inf),
        ):
            self._check(name, low, high)
        for name, low in (("path", 0), ("spare", 0), ("ramp", 2), ("redraws", 1)):
            if getattr(self, name) < low:
                raise InputError(f"touch.{name} must be at least {low}, got {getattr(self, name)}")
        if not 1 <= self.stretch < np.inf:
            raise InputError(
                f"touch.stretch is by how much a shape may be lengthened, 1 (not at all) or more, got "
                f"{self.stretch}"
            )
        if not 0.5 <= self.leak <= 1:
            raise InputError(
                f"touch.leak is a balanced accuracy from 0.5 to 1, got {self.leak}: as in touch.leak=0.6"
            )
        if not 0 <= self.shear < np.inf:
            raise InputError(
                f"touch.shear is a coefficient of friction from 0 up, got {self.shear}: as in touch.shear=0.5"
            )
        for name in ("gap", "stride"):
            given = getattr(self, name)
            if (
                len(given) != 2
                or any(value != int(value) for value in given)
                or not 1 <= given[0] <= given[1]
            ):
                raise InputError(
                    f"touch.{name} must be a range [least, most] of whole frames from 1 up, got {list(given)}"
                )
        if self.tap[1] < 2:
            raise InputError(
                f"a touch slides over at least 2 frames, got touch.tap={list(self.tap)}: use [1,3]"
            )
        if self.path > self.speed[1]:
            raise InputError(
                f"touch.path={self.path} m is longer than the fastest touch moves in a frame "
                f"({self.speed[1]} m): a tap of 2 frames could not slide so far; raise touch.speed"
            )

    def _check(self, name: str, low: float, high: float) -> None:
        given = getattr(self, name)
        if len(given) != 2 or not all(np.isfinite(given)) or given[0] > given[1] or given[1] <= 0:
            raise InputError(f"touch.{name} must be a range [least, most] above 0, got {list(given)}")
        if given[0] < low or given[1] > high or (name == "safe_peak" and given[0] == 0):
            raise InputError(
                f"touch.{name}={list(given)} must lie between {low:g} and {high:g}: touch.thresholds and "
                "touch.window decide; a pressure of 0 is no touch"
            )


def draw_gestures(
    labels: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    padded: bool,
    generator: np.random.Generator,
    fit: Fit | None = None,
    kept: np.ndarray | None = None,
) -> Draws:
    """Draw what the path does not change: shape, angle, stretch, area, duration, onset.

    The outline leaves ``spare`` along both axes of the sheet, for static and dynamic alike: then every shape
    has room to slide, and only the path tells sliding from standing.

    Args:
        labels: (B, 4), bool, the wanted combinations.
        settings: the difficulty.
        shapes: what presses, on which sheet.
        padded: the touch begins at a random frame of the window, not at its first.
        generator: where randomness comes from; it draws for all gestures in every round.
        fit, kept: as :func:`skin.touch._bodies.draw_bodies` takes them.

    Returns:
        What :func:`skin.touch._bodies.draw_bodies` gives, and duration and onset (frames).
    """
    dynamic, press = labels[:, 1], labels[:, 2]
    drawn = draw_bodies(labels[:, 0], settings, shapes, generator, fit, kept)
    least, most = np.where(press[:, None], settings.press, settings.tap).T
    least = np.where(dynamic, np.maximum(least, 2), least)
    chance = generator.random((len(labels), 2))
    duration = least + (chance[:, 0] * (most - least + 1)).astype(int)
    free = settings.window - duration if padded else np.zeros_like(duration)
    return drawn | {"duration": duration, "onset": (chance[:, 1] * (free + 1)).astype(int)}


def draw_paths(
    labels: np.ndarray,
    gestures: Draws,
    settings: GestureSettings,
    size: tuple[float, float],
    chance: np.ndarray,
) -> Draws:
    """Draw where gestures begin, where they go, how fast, and how hard they press.

    A sliding touch moves along a straight line at constant speed, reflected at the limits of its room, so
    that neither its duration nor its speed depends on its size.

    Args:
        labels: (B, 4), bool, the wanted combinations.
        gestures: what :func:`draw_gestures` gave, (B, ...).
        settings: the difficulty.
        size: extent (x, y) of the sheet, m.
        chance: (B, 5), 0 to 1.

    Returns:
        start (B, 2) within the room (m), room (B, 2) (m), direction (rad), speed (m per frame), peak (Pa).
    """
    dynamic, dangerous = labels[:, 1], labels[:, 3]
    room = size - (gestures["high"] - gestures["low"])
    slowest = np.maximum(settings.speed[0], settings.path / np.maximum(gestures["duration"] - 1, 1))
    speed = slowest + (settings.speed[1] - slowest) * chance[:, 3]
    least, most = np.where(dangerous[:, None], settings.dangerous_peak, settings.safe_peak).T
    return {
        "start": chance[:, :2] * room,
        "room": room,
        "direction": np.where(dynamic, 2 * np.pi * chance[:, 2], 0.0),
        "speed": np.where(dynamic, speed, 0.0),
        "peak": least + (most - least) * chance[:, 4],
    }


def fold(place: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Return places reflected at 0 and ``room``, as a ball between two walls (a triangle wave)."""
    round_trip = np.mod(place, 2 * room)
    return np.minimum(round_trip, 2 * room - round_trip)


def heading(way: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the unit vectors (U, 2) along which objects have come to their places; 0 where they stand still.

    A step that a wall reflects counts as what it is: from place to place. The first frame of a path, to which
    nothing has led, takes the direction of its first step.

    Args:
        way: (U, 2), m, the places of all paths, one path after another.
        first: (B,), ascending, where each path begins.
    """
    steps = np.diff(way, axis=0, prepend=way[:1])
    steps[first] = 0
    more = first[np.diff(first, append=len(way)) > 1]
    steps[more] = steps[more + 1]
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.divide(steps, length, out=np.zeros_like(steps), where=length > 0)
