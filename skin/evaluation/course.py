"""Settings of an evaluation on streams; free of heavy imports, so that a mistake is reported at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt

from skin.errors import InputError
from skin.settings import check

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

    hours: Annotated[float, Gt(0)] = 1.0
    gap: tuple[Annotated[int, Ge(1)], Annotated[int, Ge(1)]] = (50, 1150)
    stride: Annotated[int, Ge(1)] = 1
    windows: Sequence[Annotated[int, Ge(1)]] = (20, 30, 60)

    def __post_init__(self) -> None:
        check(Course, vars(self), "measure")
        if self.gap[0] > self.gap[1]:
            raise InputError(f"measure.gap must be [least, most] frames, got {list(self.gap)}")
