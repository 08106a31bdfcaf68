"""Settings of an evaluation on streams; free of heavy imports, so that a mistake is reported at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import PositiveFloat, PositiveInt

from skin.settings import RISING, checked


@checked("measure")
@dataclass(frozen=True)
class StreamSettings:
    """The stream on which alarms are counted, and what else is tried.

    Attributes:
        hours: length of the stream.
        gap: [least, most] idle frames between two of its touches.
        stride: frames from one verdict to the next.
        windows: lengths of window on which the learner is tried, frames.

    Raises:
        InputError: a value that cannot be used.
    """

    hours: PositiveFloat = 1.0
    gap: Annotated[tuple[PositiveInt, PositiveInt], RISING] = (50, 1150)
    stride: PositiveInt = 1
    windows: Sequence[PositiveInt] = (20, 30, 60)
