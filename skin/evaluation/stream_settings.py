"""Settings of an evaluation on streams, without heavy imports, so that errors are reported early."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import PositiveFloat

from skin.settings import RISING, checked


@checked("measure")
@dataclass(frozen=True)
class StreamSettings:
    """Settings of an evaluation on streams.

    Attributes:
        hours: length of the stream on which alarms are counted.
        gap: [least, most] time without touch between two touches, s.
        stride: time between two predictions, s.
        windows: window lengths to test the learner on, s.

    Raises:
        InputError: a value that cannot be used.
    """

    hours: PositiveFloat = 1.0
    gap: Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = (5.0, 115.0)
    stride: PositiveFloat = 0.1
    windows: Sequence[PositiveFloat] = (2.0, 3.0, 6.0)
