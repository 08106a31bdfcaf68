"""Settings of an evaluation on streams; free of heavy imports, so that a mistake is reported at once."""

from collections.abc import Sequence
from dataclasses import dataclass

from skin.errors import InputError

__all__ = ["Course"]


@dataclass(frozen=True)
class Course:
    """The stream on which alarms are counted, and what else is tried.

    Attributes:
        hours: length of the stream.
        gap: [least, most] idle frames between two of its touches.
        stride: frames from one verdict to the next.
        windows: lengths of window on which the learner is tried, frames.

    Raises:
        InputError: no stream, or no range.
    """

    hours: float = 1.0
    gap: Sequence[int] = (50, 1150)
    stride: int = 1
    windows: Sequence[int] = (20, 30, 60)

    def __post_init__(self) -> None:
        if not self.hours > 0 or self.stride < 1:
            raise InputError(
                "a stream needs hours above 0 and a stride from 1 up, got "
                f"stream.hours={self.hours} stream.stride={self.stride}"
            )
        if len(self.gap) != 2 or not 1 <= self.gap[0] <= self.gap[1]:
            raise InputError(f"stream.gap must be [least, most] frames from 1 up, got {list(self.gap)}")
