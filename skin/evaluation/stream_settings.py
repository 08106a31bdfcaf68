"""Settings of an evaluation on streams, without heavy imports, so that errors are reported early."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import PositiveFloat, PositiveInt

from skin.settings import RISING, checked


@checked("measure")
@dataclass(frozen=True)
class StreamSettings:
    """Settings of an evaluation on streams.

    Attributes:
        hours: length of the stream on which alarms are counted.
        gap: [least, most] idle frames between two touches.
        stride: frames between two predictions.
        windows: window lengths to test the learner on, frames.

    Raises:
        InputError: a value that cannot be used.
    """

    hours: PositiveFloat = 1.0
    gap: Annotated[tuple[PositiveInt, PositiveInt], RISING] = (50, 1150)
    stride: PositiveInt = 1
    windows: Sequence[PositiveInt] = (20, 30, 60)
