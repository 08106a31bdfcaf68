"""Settings of evaluations, without heavy imports, so that errors are reported early."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import PositiveFloat

from skin.core.settings import RISING, checked
from skin.errors import InputError

ENOUGH = 2000
"""Safe gestures; where 2 % are wanted, the true rate is then 1.4 to 2.7 % (95 %). 5000: 1.6 to 2.4 %."""


@dataclass
class Evaluation:
    """Test data of a trained learner (``conf/train.yaml``)."""

    devices: int
    layouts: int
    false_alarm_rate: float
    safe_gestures: int = 5000
    profile: str | None = None
    miss_rate: float | None = None


_RULES: dict[str, tuple[Callable[[float], bool], str, object]] = {
    "devices": (lambda count: count >= 0, "a number of devices is 0 or more", 10),
    "layouts": (lambda count: count >= 0, "a number of layouts is 0 or more", 10),
    "false_alarm_rate": (lambda rate: 0 < rate < 1, "a false-alarm rate is between 0 and 1", 0.02),
    "miss_rate": (
        lambda rate: 0 < rate < 0.5, "a miss rate is a fraction of dangerous touches between 0 and 0.5", 0.001
    ),
    "safe_gestures": (
        lambda count: count >= 1, "the alarm's threshold is chosen on 1 safe gesture or more", ENOUGH
    ),
}  # fmt: skip
"""Setting -> which values are valid, the same in words, and an example."""


def check_evaluation(settings: Evaluation | None) -> Evaluation:
    """Return the settings of an evaluation, or raise InputError where they cannot be used."""
    assert settings is not None
    for name, (valid, rule, example) in _RULES.items():
        if (value := getattr(settings, name)) is not None and not valid(value):
            raise InputError(f"{rule}, got {value:g}: use evaluation.{name}={example}")
    return settings


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
