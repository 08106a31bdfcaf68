"""Gesture settings, random draws of shape, timing and path, and the frames sampled from them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
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
from skin.core.settings import RISING, check_settings, checked, configured
from skin.errors import InputError
from skin.touch.labels import RELEASE, Thresholds
from skin.touch.shapes import Fit, Shapes, draw_bodies

if TYPE_CHECKING:
    from skin.touch.sampler import AbstractContact, AbstractSampler

Draws = dict[str, np.ndarray]
"""Named parameters of gestures, one entry each along the first axis."""
_From0 = Annotated[tuple[NonNegativeFloat, PositiveFloat], RISING]
_Above0 = Annotated[tuple[PositiveFloat, PositiveFloat], RISING]


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

    @classmethod
    def of(cls, settings: "TouchSettings") -> "GestureFrames":
        """Return ``round(seconds * rate)`` for every duration of the settings."""
        rate = settings.rate

        def frames(seconds: tuple[float, float]) -> tuple[int, int]:
            return round(seconds[0] * rate), round(seconds[1] * rate)

        return cls(
            round(settings.window * rate),
            frames(settings.tap),
            frames(settings.press),
            (settings.speed[0] / rate, settings.speed[1] / rate),
            frames(settings.gap),
            frames(settings.stride),
            round(settings.thresholds.duration * rate),
            # A path of a whole number of steps must not get one more by rounding.
            1 + max(1, ceil(settings.path * rate / settings.speed[1] - 1e-9)),
        )

    def check(self, settings: "TouchSettings") -> None:
        """Check that every duration has a frame, and taps and presses are on their sides of the threshold.

        Raises:
            InputError: naming the setting in s.
        """
        rate = settings.rate
        for name, (least, most), low, high in (
            ("window", (self.window, self.window), 1, inf),
            ("tap", self.tap, 1, min(self.duration, self.window)),
            ("press", self.press, self.duration + 1, self.window),
            ("gap", self.gap, 1, inf),
            ("stride", self.stride, 1, inf),
        ):
            if not low <= least <= most <= high:
                counts = f"{least}" if least == most else f"{least} to {most}"
                within = (
                    f"{low} to {high} ({low / rate:g} to {high / rate:g} s) with this touch.window and "
                    "touch.thresholds.duration"
                )
                raise InputError(
                    f"{_shown(settings, name)} gives {counts} frames at touch.rate={rate:g} Hz, valid are "
                    + (within if high < inf else f"at least {low} ({low / rate:g} s)")
                )
        if self.tap[1] < self.slide:
            raise InputError(
                f"{_shown(settings, 'tap')} gives at most {self.tap[1]} frames at touch.rate={rate:g} Hz, "
                f"but a tap that slides over touch.path={settings.path:g} m at the highest touch.speed lasts "
                f"{self.slide} ({self.slide / rate:g} s): raise touch.tap or touch.speed, or lower touch.path"
            )


def _shown(settings: "TouchSettings", name: str) -> str:
    value = getattr(settings, name)
    return f"touch.{name}={list(value) if isinstance(value, tuple) else value} s"


@dataclass(frozen=True)
class TouchSettings(ABC):
    """Settings that all kinds of touches share: their times, their motion and their labels.

    Ranges are (least, most), drawn uniformly, both ends included. Durations are in s and speeds in m/s.
    Touches are drawn in frames of the model: a duration has ``round(seconds * rate)`` frames.

    Attributes:
        over_sensors: a touch is dangerous if the mean pressure over the footprint of a sensor exceeds the
            threshold; False: over an equal area anywhere on the sheet, so that touches between the sensors
            count.
        ongoing: share of touches whose window ends at some moment from their begin to 0.3 s after their end,
            as the windows of a live view do. Labels are those of what the window shows. It has no effect on
            touches that begin at the first frame.

    Raises:
        InputError: a range that is empty, out of order, or on the wrong side of its threshold.
    """

    rate: PositiveFloat = 10.0
    window: PositiveFloat = 3.0
    shapes: Annotated[tuple[str, ...], MinLen(1)] = ("disc",)
    tap: _Above0 = (0.1, 0.3)
    press: _Above0 = (0.4, 2.0)
    speed: _From0 = (0.03, 0.20)
    path: NonNegativeFloat = 0.010
    spare: NonNegativeFloat = 0.010
    ramp: Annotated[int, Ge(2)] = 3
    shear: NonNegativeFloat = 0.0
    redraws: PositiveInt = 30
    over_sensors: bool = True
    ongoing: Annotated[float, Ge(0), Le(1)] = 0.0
    gap: _Above0 = (1.0, 6.0)
    stride: _Above0 = (1.5, 4.5)
    thresholds: Thresholds = field(default_factory=Thresholds)

    @cached_property
    def frames(self) -> GestureFrames:
        """The durations in frames of the model, and the speeds per frame."""
        return GestureFrames.of(self)

    def __post_init__(self) -> None:
        self.frames.check(self)

    @classmethod
    def of(cls, settings: Mapping[str, Any] | Self | None) -> Self:
        """Return the settings of a configuration; missing ones keep their default."""
        if isinstance(settings, cls):
            return settings
        if settings is not None and not isinstance(settings, Mapping):
            raise InputError(f"touch must be settings by name, got {settings!r}")
        values = dict(settings or {})
        limits = values.pop("thresholds", {})
        if not isinstance(limits, Thresholds):
            limits = configured(Thresholds, limits, "touch.thresholds")
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
        return configured(cls, values | {"thresholds": limits}, "touch")

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


@checked("touch")
@dataclass(frozen=True)
class GestureSettings(TouchSettings):
    """Ranges of the report's gestures; ``conf/touch/gestures.yaml`` holds the same defaults and their units.

    Attributes:
        second: share of touches with a second gesture at the same time (:mod:`skin.touch.pairs`).

    Raises:
        InputError: as :class:`TouchSettings`, or two gestures at a time that slide with friction.
    """

    shapes: Annotated[tuple[str, ...], MinLen(1)] = (
        "disc",
        "blurred_disc",
        "square",
        "bar",
        "fist",
        "hand",
        "fingertip",
    )
    small_area: _From0 = (0.01, 0.30)
    big_area: _From0 = (0.30, 0.70)
    safe_peak: _Above0 = (10e3, 90.5e3)
    dangerous_peak: _Above0 = (90.5e3, 180e3)
    stretch: Annotated[float, Ge(1)] = 4.0
    leak: Annotated[float, Ge(0.5), Le(1)] = 0.6
    second: Annotated[float, Ge(0), Le(1)] = 0.0

    def __post_init__(self) -> None:
        if self.second and self.shear:
            raise InputError(
                "two gestures at a time have no common direction of friction: set touch.second=0 or "
                "touch.shear=0"
            )
        lines = self.thresholds
        # (name, lowest allowed, highest allowed): a range beyond its threshold would be redrawn forever.
        for name, low, high in (
            ("small_area", 0, lines.area),
            ("big_area", lines.area, 1),
            ("safe_peak", 0, lines.pressure),
            ("dangerous_peak", lines.pressure, np.inf),
        ):
            limits = getattr(self, name)
            if limits[0] < low or limits[1] > high:
                raise InputError(
                    f"touch.{name}={list(limits)} must lie between {low:g} and {high:g}: "
                    "touch.thresholds decides"
                )
        super().__post_init__()

    def sampler(
        self,
        body: AbstractBody,
        footprints: np.ndarray,
        contact: "AbstractContact",
        padded: bool,
        moments: np.ndarray | None,
    ) -> "AbstractSampler":
        """Return what draws gestures."""
        from skin.touch.sampler import TouchSampler

        return TouchSampler(body, footprints, contact, self, padded, moments)


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
    check_settings(GestureSettings, settings, "touch")
    window, rate = (float(settings.get(name, getattr(GestureSettings, name))) for name in ("window", "rate"))
    if not round(window * rate):
        raise InputError(
            f"touch.window={window:g} s is no frame at touch.rate={rate:g} Hz: raise it to "
            f"{1 / rate:g} or more"
        )
    return round(window * rate), rate


def draw_gestures(
    labels: np.ndarray,
    settings: GestureSettings,
    shapes: Shapes,
    padded: bool,
    generator: np.random.Generator,
    fit: Fit | None = None,
    kept: np.ndarray | None = None,
) -> Draws:
    """Draw the parameters that do not depend on the path: shape, angle, stretch, area, duration, onset.

    The outline leaves ``spare`` along both axes of the sheet, for static and sliding touches alike. Every
    shape can then slide, and only the path distinguishes sliding from static touches.

    Args:
        labels: (B, 4), bool, the wanted combinations.
        settings: ranges of the gestures.
        shapes: the shapes and the sheet.
        padded: whether a touch begins at a random frame of the window instead of its first.
        generator: source of randomness; it draws for all gestures in every round.
        fit, kept: see :func:`skin.touch.shapes.draw_bodies`.

    Returns:
        The result of :func:`skin.touch.shapes.draw_bodies`, and duration and onset (frames).
    """
    drawn = draw_bodies(labels[:, 0], settings, shapes, generator, fit, kept)
    return drawn | draw_times(labels, settings, padded, generator)


def draw_times(
    labels: np.ndarray, settings: TouchSettings, padded: bool, generator: np.random.Generator
) -> Draws:
    """Return duration and onset (frames) of touches with labels (B, 4), bool; see :func:`draw_gestures`."""
    dynamic, press = labels[:, 1], labels[:, 2]
    frames = settings.frames
    least, most = np.where(press[:, None], frames.press, frames.tap).T
    least = np.where(dynamic, np.maximum(least, frames.slide), least)
    chance = generator.random((len(labels), 2))
    duration = least + (chance[:, 0] * (most - least + 1)).astype(int)
    free = frames.window - duration if padded else np.zeros_like(duration)
    onset = (chance[:, 1] * (free + 1)).astype(int)
    if padded and settings.ongoing:
        ongoing, moment = generator.random((2, len(labels)))
        # Whether a touch is a press, and whether it moves, shows after so many frames.
        earliest = np.where(press, frames.duration + 1, 1 + dynamic)
        latest = np.minimum(duration + round(RELEASE * settings.rate), frames.window)
        shown = earliest + (moment * (latest - earliest + 1)).astype(int)
        onset = np.where(ongoing < settings.ongoing, frames.window - shown, onset)
    return {"duration": duration, "onset": onset}


def draw_paths(
    labels: np.ndarray,
    gestures: Draws,
    settings: GestureSettings,
    size: tuple[float, float],
    chance: np.ndarray,
) -> Draws:
    """Draw the path and the peak pressure of gestures.

    Args:
        labels: (B, 4), bool, the wanted combinations.
        gestures: the draws of :func:`draw_gestures`, (B, ...).
        settings: ranges of the gestures.
        size: extent (x, y) of the sheet, m.
        chance: (B, 5), 0 to 1.

    Returns:
        The result of :func:`draw_motion`, and peak (Pa).
    """
    least, most = np.where(labels[:, 3:], settings.dangerous_peak, settings.safe_peak).T
    motion = draw_motion(labels[:, 1], gestures, settings, size, chance[:, :4])
    return motion | {"peak": least + (most - least) * chance[:, 4]}


def draw_motion(
    dynamic: np.ndarray,
    gestures: Draws,
    settings: TouchSettings,
    size: tuple[float, float],
    chance: np.ndarray,
) -> Draws:
    """Draw start, direction and speed of touches.

    A sliding touch moves along a straight line at constant speed and is reflected at the limits of its span,
    so that neither its duration nor its speed depends on its size.

    Args:
        dynamic: (B,), bool, those that slide.
        gestures: low and high (B, 2), m, of what moves around its place, and duration (B,), frames.
        settings: ranges of the touches.
        size: extent (x, y) of the sheet, m.
        chance: (B, 4), 0 to 1.

    Returns:
        start (B, 2) within the span (m), span (B, 2) (m), direction (rad), speed (m per frame).
    """
    span = size - (gestures["high"] - gestures["low"])
    least_speed, most_speed = settings.frames.speed
    slowest = np.maximum(least_speed, settings.path / np.maximum(gestures["duration"] - 1, 1))
    speed = slowest + (most_speed - slowest) * chance[:, 3]
    return {
        "start": chance[:, :2] * span,
        "span": span,
        "direction": np.where(dynamic, 2 * np.pi * chance[:, 2], 0.0),
        "speed": np.where(dynamic, speed, 0.0),
    }


def fold(place: np.ndarray, span: np.ndarray) -> np.ndarray:
    """Return places reflected at 0 and ``span`` (a triangle wave)."""
    round_trip = np.mod(place, 2 * span)
    return np.minimum(round_trip, 2 * span - round_trip)


def heading(place: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the unit vectors (U, 2) of the last step to each place; 0 for objects at rest.

    A reflected step points from place to place. The first frame of a path takes the direction of the first
    step.

    Args:
        place: (U, 2), m, the places of all paths, one path after another.
        first: (B,), ascending, the first frame of each path.
    """
    steps = np.diff(place, axis=0, prepend=place[:1])
    steps[first] = 0
    longer = first[np.diff(first, append=len(place)) > 1]
    steps[longer] = steps[longer + 1]
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.divide(steps, length, out=np.zeros_like(steps), where=length > 0)


@dataclass(frozen=True)
class Trajectories:
    """Gestures (B,) as distinct frames (U,); the frames of one gesture are adjacent.

    Attributes:
        owner: (U,), the gesture of each frame, ascending.
        shape, angle, scale: (U,), as ``Shapes.render`` takes them.
        place: (U, 2), m.
        share: (U,), the largest share of full force at which a frame is shown.
        index: (B, T), the frame at each time.
        profile: (B, T), its share of full force; 0 without contact.
        peak: (B,), the wanted highest cell pressure, Pa.
        wanted: (B, 4), bool, the wanted labels in the order of ``skin.touch.labels.TOUCH``.
        stretch: (U,), as ``Shapes.render`` takes it.
    """

    owner: np.ndarray
    shape: np.ndarray
    angle: np.ndarray
    scale: np.ndarray
    place: np.ndarray
    share: np.ndarray
    index: Tensor
    profile: Tensor
    peak: np.ndarray
    wanted: np.ndarray
    stretch: np.ndarray | None = None

    @property
    def poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Arguments of ``Shapes.render`` and ``Shapes.solids``."""
        return self.shape, self.angle, self.scale, self.place, self.stretch


class SampledPaths(NamedTuple):
    """Sampled trajectories of gestures.

    Attributes:
        trajectories: the frames (U,) of gestures (B,).
        place: (U, 2), place of each frame within the gesture's span, m.
        first: (B,), the first frame of each gesture.
        net: (B, 2), from its first place to its last, m.
        travel: (B,), largest distance from its first place, m.
    """

    trajectories: Trajectories
    place: np.ndarray
    first: np.ndarray
    net: np.ndarray
    travel: np.ndarray


def sample_paths(
    gestures: Draws, wanted: np.ndarray, settings: TouchSettings, proportional: bool
) -> SampledPaths:
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
    place = fold(gestures["start"][owner] + step[:, None] * velocity.T[owner], gestures["span"][owner])

    share = np.zeros(len(owner))
    np.maximum.at(share, index, scale)
    trajectories = Trajectories(
        owner,
        gestures["shape"][owner],
        gestures["angle"][owner],
        gestures["scale"][owner],
        place - gestures["low"][owner],
        share,
        torch.from_numpy(index),
        torch.from_numpy(scale).float(),
        gestures["peak"],
        wanted,
        gestures["stretch"][owner],
    )
    from_first = place - place[first[owner]]
    travel = np.zeros(len(first))
    np.maximum.at(travel, owner, np.hypot(*from_first.T))
    return SampledPaths(trajectories, place, first, from_first[first + counts - 1], travel)
