"""Settings of evaluations, without heavy imports, so that errors are reported early."""

from collections.abc import Sequence
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


def check_evaluation(settings: Evaluation | None) -> Evaluation:
    """Return the settings of an evaluation, or raise InputError where they cannot be used."""
    assert settings is not None
    for name, minimum in (("devices", 0), ("layouts", 0)):
        if getattr(settings, name) < minimum:
            raise InputError(f"evaluation.{name}={getattr(settings, name)} must be at least {minimum}")
    if not 0 < settings.false_alarm_rate < 1:
        raise InputError(
            f"a false-alarm rate is between 0 and 1, got {settings.false_alarm_rate:g}: "
            "use evaluation.false_alarm_rate=0.02"
        )
    if settings.miss_rate is not None and not 0 < settings.miss_rate < 0.5:
        raise InputError(
            "a miss rate is a fraction of dangerous touches between 0 and 0.5, got "
            f"{settings.miss_rate:g}: use evaluation.miss_rate=0.001"
        )
    if settings.safe_gestures < 1:
        raise InputError(
            "the alarm's threshold is chosen on 1 safe gesture or more, got "
            f"{settings.safe_gestures}: use evaluation.safe_gestures={ENOUGH}"
        )
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
