"""Durations of gestures in frames of the model."""

from __future__ import annotations

from math import ceil, inf
from typing import TYPE_CHECKING, NamedTuple

from skin.errors import InputError

if TYPE_CHECKING:
    from skin.touch.gesture import GestureSettings


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
    def of(cls, settings: GestureSettings) -> GestureFrames:
        """Return ``round(seconds * rate)`` for every duration of the settings."""
        rate = settings.rate

        def frames(given: tuple[float, float]) -> tuple[int, int]:
            return round(given[0] * rate), round(given[1] * rate)

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

    def check(self, settings: GestureSettings) -> None:
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
            if low <= least and most <= high:
                continue
            within = f"at least {low} ({low / rate:g} s)"
            if high < inf:
                within = (
                    f"{low} to {high} ({low / rate:g} to {high / rate:g} s) with this touch.window and "
                    "touch.thresholds.duration"
                )
            counts = f"{least}" if least == most else f"{least} to {most}"
            raise InputError(
                f"{_shown(settings, name)} gives {counts} frames at touch.rate={rate:g} Hz, valid are "
                f"{within}"
            )
        if self.tap[1] < self.slide:
            raise InputError(
                f"{_shown(settings, 'tap')} gives at most {self.tap[1]} frames at touch.rate={rate:g} Hz, "
                f"but a tap that slides over touch.path={settings.path:g} m at the highest touch.speed lasts "
                f"{self.slide} ({self.slide / rate:g} s): raise touch.tap or touch.speed, or lower touch.path"
            )


def _shown(settings: GestureSettings, name: str) -> str:
    given = getattr(settings, name)
    return f"touch.{name}={list(given) if isinstance(given, tuple) else given} s"
