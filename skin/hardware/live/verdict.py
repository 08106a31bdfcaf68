"""The verdict on a window, and its debouncing."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt
from pydantic import NonNegativeFloat

from skin.labels import OPPOSITE
from skin.settings import checked

State = Literal["touch", "no touch", "unknown"]
_NAMED = 3  # sensors


def sensor_list(sensors: Sequence[int]) -> str:
    """Return the numbers of sensors in words."""
    more = f" and {len(sensors) - _NAMED} more" if len(sensors) > _NAMED else ""
    numbers = ", ".join(map(str, sensors[:_NAMED]))
    return f"sensor{'s' * (len(sensors) > 1)} {numbers}{more}"


@dataclass(frozen=True)
class Verdict:
    """Classification of a window.

    Attributes:
        t: s, the device's clock at the latest frame.
        t_host: s, the host's clock at that frame.
        chances: label -> its probability in this window; of ``dangerous`` the largest since the alarm was
            raised, while it lasts.
        touched: debounced; if False, nothing touches the skin and the labels are meaningless.
        labels: label -> debounced prediction; empty without touch.
        dangerous: the alarm, which lasts until the contact ends.
        gap: whether frames are missing in the window.
        masked: sensors without a valid reading.
        contact: duration of the contact, s; None without contact.
        unknown: sensors at which a dangerous touch could not be felt, because no valid sensor would respond.
        below: sensors that read below their rest: their wire is broken, their values fall with force, or the
            tare was taken under a load.
        shown: label -> its probability in the latest window that agreed with the debounced label; where it
            is missing, that of this window.
    """

    t: float
    t_host: float
    chances: dict[str, float]
    touched: bool
    labels: dict[str, bool]
    dangerous: bool
    gap: bool
    masked: tuple[int, ...] = ()
    contact: float | None = None
    unknown: tuple[int, ...] = ()
    below: tuple[int, ...] = ()
    shown: dict[str, float] = field(default_factory=dict)

    @property
    def state(self) -> State:
        """``touch``; ``unknown``, where a dangerous touch on a sensor could not be felt; or ``no touch``."""
        return "touch" if self.touched else "unknown" if self.unknown else "no touch"

    @property
    def reason(self) -> str:
        """Where the state is unknown and why, in words; empty where it is known everywhere."""
        if not self.unknown:
            return ""
        text = f"unknown near {sensor_list(self.unknown)}"
        if self.below:
            return f"{text}, below rest: a broken wire, device.scale of the wrong sign, or a tare under load"
        return f"{text}, without a valid reading"

    def words(self) -> list[tuple[str, float]]:
        """Return the predicted classes, each with its probability; empty without touch."""
        chances = self.chances | self.shown
        pairs = [
            (name, chances[name]) if yes else (OPPOSITE.get(name, ""), 1 - chances[name])
            for name, yes in self.labels.items()
        ]
        return [(word, chance) for word, chance in pairs if word]


@checked("live.patience")
@dataclass(frozen=True)
class DebounceSettings:
    """Durations for which a prediction must last before it is shown, and be absent before it is removed, s.

    Attributes:
        label: of any label but ``dangerous``, and of touch.
        alarm: of ``dangerous`` before it is shown: two decisions of a device of 20 Hz or more. One alone
            would raise several times as many false alarms; more than 0.1 s would come too late.
        calm: without ``dangerous`` before the alarm is removed.
        above: probability above which a touch is dangerous; None: that of the run.

    Raises:
        InputError: a negative time, an alarm that would be too late, or a value that is no probability.
    """

    label: NonNegativeFloat = 0.15
    alarm: Annotated[float, Ge(0), Le(0.1)] = 0.1
    calm: NonNegativeFloat = 2.0
    above: Annotated[float, Gt(0), Lt(1)] | None = None


@dataclass
class Debounce:
    """Turns on after ``rise`` seconds of True, and off after ``fall`` seconds of False.

    If frames are further apart than that, one frame is enough.

    Attributes:
        rise: s.
        fall: s.
        state: the debounced value.
    """

    rise: float
    fall: float
    state: bool = False
    _since: float | None = field(default=None, repr=False)

    def __call__(self, answer: bool, t: float, period: float) -> bool:
        """Return the debounced value after an answer at ``t`` that lasts for ``period``, s."""
        if answer == self.state:
            self._since = None
            return self.state
        self._since = t if self._since is None else self._since
        # Rounding of the clock must not cost a frame.
        if t - self._since + period >= (self.rise if answer else self.fall) - 1e-6:
            self.state, self._since = answer, None
        return self.state
