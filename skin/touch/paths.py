"""Settings that all kinds of touches share, draws of their times and paths, and their distinct frames."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, inf
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Self

import numpy as np
import torch
from annotated_types import Ge, Le, MinLen
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from skin.body.base import AbstractBody
from skin.core.settings import RISING, check_settings, configured
from skin.errors import InputError
from skin.touch.labels import RELEASE, TOUCH_OR_NOT, TOUCH_SLIDING, Label, Limits, Thresholds
from skin.touch.shapes import Pose

if TYPE_CHECKING:
    from skin.touch.movie import AbstractContact, AbstractSampler

Draws = dict[str, np.ndarray]
"""Named parameters of gestures, one entry each along the first axis."""
From0 = Annotated[tuple[NonNegativeFloat, PositiveFloat], RISING]
"""Range whose lower limit may be 0."""
Above0 = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]
"""Range above 0."""


class GestureFrames(NamedTuple):
    """Durations in frames of the model, and speeds in m per frame; ranges are (least, most).

    Attributes:
        window: T.
        tap, press: frames in contact.
        speed: m per frame.
        gap: idle frames between two touches of a stream.
        stride: frames between the starts of two windows of a stream.
        duration: frames of the longest tap; see ``Thresholds.duration``.
        slide: fewest frames in contact of a sliding touch: those of its path at the highest speed.
    """

    window: int
    tap: tuple[int, int]
    press: tuple[int, int]
    speed: tuple[float, float]
    gap: tuple[int, int]
    stride: tuple[int, int]
    duration: int
    slide: int


@dataclass(frozen=True)
class TouchSettings(ABC):
    """Settings that all kinds of touches share: their times, their motion and their labels.

    Ranges are (least, most), drawn uniformly, both ends included. Durations are in s and speeds in m/s.
    Touches are drawn in frames of the model: a duration has ``round(seconds * rate)`` frames.

    Attributes:
        over_sensors: a touch is dangerous if the mean pressure over the footprint of a sensor exceeds the
            threshold; False: over an equal area anywhere on the sheet, so that touches between the sensors
            count.
        ongoing: fraction of touches whose window ends at some moment from their begin to 0.3 s after their
            end, as the windows of a live view do. Labels are those of what the window shows. It has no effect
            on touches that begin at the first frame.
        limits: that decide what is dangerous (:class:`skin.touch.labels.Limits`); None: the pressure of
            ``thresholds``. Ranges of peaks are then relative to the limits.
        labels: labels of one's own by name, behind those of the report. Touches are not drawn for them: each
            has those that its movie gives.

    Raises:
        InputError: a range that is empty, out of order, or on the wrong side of its threshold.
    """

    rate: PositiveFloat = 10.0
    window: PositiveFloat = 3.0
    shapes: Annotated[tuple[str, ...], MinLen(1)] = ("disc",)
    tap: Above0 = (0.1, 0.3)
    press: Above0 = (0.4, 2.0)
    speed: From0 = (0.03, 0.20)
    path: NonNegativeFloat = 0.010
    spare: NonNegativeFloat = 0.010
    ramp: Annotated[int, Ge(2)] = 3
    shear: NonNegativeFloat = 0.0
    redraws: PositiveInt = 30
    over_sensors: bool = True
    ongoing: Annotated[float, Ge(0), Le(1)] = 0.0
    gap: Above0 = (1.0, 6.0)
    stride: Above0 = (1.5, 4.5)
    thresholds: Thresholds = field(default_factory=Thresholds)
    limits: Limits | None = None
    labels: Mapping[str, Label] = field(default_factory=dict)

    @cached_property
    def danger(self) -> Limits:
        """The limits that decide what is dangerous."""
        return self.limits or Limits(self.thresholds.pressure, tap_pressure=self.thresholds.pressure)

    @cached_property
    def frames(self) -> GestureFrames:
        """The durations in frames of the model, ``round(seconds * rate)``, and the speeds per frame."""

        def frames(seconds: tuple[float, float]) -> tuple[int, int]:
            return round(seconds[0] * self.rate), round(seconds[1] * self.rate)

        return GestureFrames(
            round(self.window * self.rate),
            frames(self.tap),
            frames(self.press),
            (self.speed[0] / self.rate, self.speed[1] / self.rate),
            frames(self.gap),
            frames(self.stride),
            round(self.thresholds.duration * self.rate),
            # A path of a whole number of steps must not get one more by rounding.
            1 + max(1, ceil(self.path * self.rate / self.speed[1] - 1e-9)),
        )

    def __post_init__(self) -> None:
        frames, rate = self.frames, self.rate
        for name, (minimum, maximum), low, high in (
            ("window", (frames.window, frames.window), 1, inf),
            ("tap", frames.tap, 1, min(frames.duration, frames.window)),
            ("press", frames.press, frames.duration + 1, frames.window),
            ("gap", frames.gap, 1, inf),
            ("stride", frames.stride, 1, inf),
        ):
            if not low <= minimum <= maximum <= high:
                counts = f"{minimum}" if minimum == maximum else f"{minimum} to {maximum}"
                within = (
                    f"{low} to {high} ({low / rate:g} to {high / rate:g} s) with this touch.window and "
                    "touch.thresholds.duration"
                )
                raise InputError(
                    f"{self._shown(name)} gives {counts} frames at touch.rate={rate:g} Hz, valid are "
                    + (within if high < inf else f"at least {low} ({low / rate:g} s)")
                )
        if frames.tap[1] < frames.slide:
            raise InputError(
                f"{self._shown('tap')} gives at most {frames.tap[1]} frames at touch.rate={rate:g} Hz, "
                f"but a tap that slides over touch.path={self.path:g} m at the highest touch.speed lasts "
                f"{frames.slide} ({frames.slide / rate:g} s): raise touch.tap or touch.speed, or lower "
                "touch.path"
            )

    def _shown(self, name: str) -> str:
        value = getattr(self, name)
        return f"touch.{name}={list(value) if isinstance(value, tuple) else value} s"

    @classmethod
    def of(cls, settings: Mapping[str, Any] | Self | None) -> Self:
        """Return the settings of a configuration; missing ones keep their default."""
        if isinstance(settings, cls):
            return settings
        if settings is not None and not isinstance(settings, Mapping):
            raise InputError(f"touch must be settings by name, got {settings!r}")
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in (settings or {}).items()
        }
        if not isinstance(limits := values.get("thresholds", {}), Thresholds):
            values["thresholds"] = configured(Thresholds, limits, "touch.thresholds")
        values["limits"] = Limits.of(values.get("limits"))
        if not isinstance(labels := values.get("labels", {}), Mapping):
            raise InputError(f"touch.labels must be labels by name, got {labels!r}")
        if taken := sorted(set(labels) & {*TOUCH_OR_NOT.names, *TOUCH_SLIDING.names}):
            raise InputError(f"touch.labels.{taken[0]} is a label already: give yours another name")
        values["labels"] = {
            name: label if isinstance(label, Label) else configured(Label, label, f"touch.labels.{name}")
            for name, label in labels.items()
        }
        return configured(cls, values, "touch")

    @abstractmethod
    def sampler(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: "AbstractContact",
        padded: bool,
        moments: np.ndarray | None,
    ) -> "AbstractSampler":
        """Return what draws such touches; the arguments are those of the sampler."""


def model_window(touch: Mapping[str, Any] | TouchSettings | None) -> tuple[int, float]:
    """Return the frames of the model's window, and its rate, Hz.

    Only these settings are checked: a real skin draws no gestures.

    Args:
        touch: as :func:`skin.touch.fingertips.read_touch` takes it.

    Raises:
        InputError: a window or a rate that cannot be used.
    """
    if isinstance(touch, TouchSettings):
        return touch.frames.window, float(touch.rate)
    settings = {name: value for name, value in (touch or {}).items() if name in ("window", "rate")}
    check_settings(TouchSettings, settings, "touch")
    window, rate = (float(settings.get(name, getattr(TouchSettings, name))) for name in ("window", "rate"))
    if not round(window * rate):
        raise InputError(
            f"touch.window={window:g} s is no frame at touch.rate={rate:g} Hz: raise it to "
            f"{1 / rate:g} or more"
        )
    return round(window * rate), rate


def draw_times(
    labels: np.ndarray, settings: TouchSettings, padded: bool, generator: np.random.Generator
) -> Draws:
    """Return duration and onset (frames) of touches with labels (B, 4), bool.

    With ``padded``, a touch begins at a random frame of the window instead of its first.
    """
    _, dynamic, press, _ = labels.T
    frames = settings.frames
    minimum, maximum = np.where(press[:, None], frames.press, frames.tap).T
    minimum = np.where(dynamic, np.maximum(minimum, frames.slide), minimum)
    random = generator.random((len(labels), 2))
    duration = minimum + (random[:, 0] * (maximum - minimum + 1)).astype(int)
    onset = (random[:, 1] * (1 + padded * (frames.window - duration))).astype(int)
    if padded and settings.ongoing:
        ongoing, moment = generator.random((2, len(labels)))
        # Whether a touch is a press, and whether it moves, shows after so many frames.
        earliest = np.where(press, frames.duration + 1, 1 + dynamic)
        latest = np.minimum(duration + round(RELEASE * settings.rate), frames.window)
        shown = earliest + (moment * (latest - earliest + 1)).astype(int)
        onset = np.where(ongoing < settings.ongoing, frames.window - shown, onset)
    return {"duration": duration, "onset": onset}


def draw_until_fit(
    count: int, draw: Callable[[np.ndarray], Draws], refuse: Callable[[], InputError], tries: int = 2000
) -> Draws:
    """Draw touches again until each fits on the sheet.

    Args:
        count: B.
        draw: gives the draws of the rows (b,) that it is called with, and ``fits`` (b,), bool.
        refuse: gives the error if some touch does not fit.
        tries: largest number of rounds.

    Returns:
        The draws (B, ...), and misfits: number of touches drawn before that did not fit.
    """
    drawn, todo = {"misfits": np.zeros(count)}, np.arange(count)
    for _ in range(tries):
        values = draw(todo)
        fits = values.pop("fits")
        for name, value in values.items():
            drawn.setdefault(name, np.empty((count, *value.shape[1:]), value.dtype))[todo] = value
        todo = todo[~fits]
        drawn["misfits"][todo] += 1
        if not len(todo):
            return drawn
    raise refuse()


def draw_motion(
    dynamic: np.ndarray,
    gestures: Draws,
    settings: TouchSettings,
    size: tuple[float, float],
    random: np.ndarray,
) -> Draws:
    """Draw start, direction and speed of touches.

    A sliding touch moves along a straight line at constant speed and is reflected at the limits of its span,
    so that neither its duration nor its speed depends on its size.

    Args:
        dynamic: (B,), bool, those that slide.
        gestures: low and high (B, 2), m, of what moves around its position, and duration (B,), frames.
        settings: ranges of the touches.
        size: extent (x, y) of the sheet, m.
        random: (B, 4), 0 to 1.

    Returns:
        start (B, 2) within the span (m), span (B, 2) (m), direction (rad), speed (m per frame).
    """
    span = size - (gestures["high"] - gestures["low"])
    minimum_speed, maximum_speed = settings.frames.speed
    slowest = np.maximum(minimum_speed, settings.path / np.maximum(gestures["duration"] - 1, 1))
    speed = slowest + (maximum_speed - slowest) * random[:, 3]
    return {
        "start": random[:, :2] * span,
        "span": span,
        "direction": np.where(dynamic, 2 * np.pi * random[:, 2], 0.0),
        "speed": np.where(dynamic, speed, 0.0),
    }


def fold(position: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Return positions reflected at 0 and ``span`` (a triangle wave)."""
    round_trip = np.mod(position, 2 * span)
    return np.minimum(round_trip, 2 * span - round_trip)


def heading(position: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the unit vectors (U, 2) of the last step to each position; 0 for objects at rest.

    A reflected step points from position to position. The first frame of a path takes the direction of the
    first step.

    Args:
        position: (U, 2), m, the positions of all paths, one path after another.
        first: (B,), ascending, the first frame of each path.
    """
    steps = np.diff(position, axis=0, prepend=position[:1])
    steps[first] = 0
    longer = first[np.diff(first, append=len(position)) > 1]
    steps[longer] = steps[longer + 1]
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.divide(steps, length, out=np.zeros_like(steps), where=length > 0)


@dataclass(frozen=True)
class Trajectories:
    """Gestures (B,) as distinct frames (U,); the frames of one gesture are adjacent.

    Attributes:
        owner: (U,), the gesture of each frame, ascending.
        poses: (U,).
        fraction: (U,), the largest fraction of full force at which a frame is shown.
        index: (B, T), the frame at each time.
        profile: (B, T), its fraction of full force; 0 without contact.
        peak: (B,), the wanted highest cell pressure, Pa.
        wanted: (B, 4), bool, the wanted labels in the order of ``skin.touch.labels.TOUCH``.
        position: (U, 2), position of each frame within the gesture's span, m.
        first: (B,), the first frame of each gesture.
        net: (B, 2), from its first position to its last, m.
        travel: (B,), largest distance from its first position, m.
    """

    owner: np.ndarray
    poses: Pose
    fraction: np.ndarray
    index: Tensor
    profile: Tensor
    peak: np.ndarray
    wanted: np.ndarray
    position: np.ndarray
    first: np.ndarray
    net: np.ndarray
    travel: np.ndarray


def sample_paths(
    gestures: Draws, wanted: np.ndarray, settings: TouchSettings, proportional: bool
) -> Trajectories:
    """Return the distinct frames of gestures.

    A sliding touch has one per step. A static touch has one, or one per force level where pressure is not
    proportional to force.

    Args:
        gestures: the draws of ``draw_gestures`` and ``draw_paths``, (B, ...).
        wanted: (B, 4), bool, the wanted labels.
        settings: ranges of the gestures.
        proportional: whether pressure is proportional to force.
    """
    duration, onset, sliding = gestures["duration"], gestures["onset"], gestures["speed"] > 0
    time = np.arange(settings.frames.window) - onset[:, None]
    rise = duration[:, None] // settings.ramp + 1
    level = np.clip(np.minimum(time + 1, duration[:, None] - time), 0, rise)
    scale = level / rise

    peak_level = level.max(axis=1)
    counts = np.where(sliding, duration, 1 if proportional else peak_level)
    first = np.cumsum(counts) - counts
    column = np.where(sliding[:, None], time, level - 1)
    index = first[:, None] + np.clip(column, 0, counts[:, None] - 1)
    owner = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(owner)) - first[owner]
    velocity = gestures["speed"] * np.stack([np.cos(gestures["direction"]), np.sin(gestures["direction"])])
    position = fold(gestures["start"][owner] + step[:, None] * velocity.T[owner], gestures["span"][owner])

    shape, angle, scales, stretch = (gestures[name][owner] for name in ("shape", "angle", "scale", "stretch"))
    poses = Pose(shape, angle, scales, position - gestures["low"][owner], stretch)
    fraction = np.zeros(len(owner))
    np.maximum.at(fraction, index, scale)
    from_first = position - position[first[owner]]
    travel = np.maximum.reduceat(np.hypot(*from_first.T), first)
    return Trajectories(
        owner,
        poses,
        fraction,
        torch.from_numpy(index),
        torch.from_numpy(scale).float(),
        gestures["peak"],
        wanted,
        position,
        first,
        from_first[first + counts - 1],
        travel,
    )
