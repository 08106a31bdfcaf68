"""The verdict on a window, and how long it must persist before it is shown."""

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt
from pydantic import NonNegativeFloat

from skin.labels import OPPOSITE
from skin.settings import checked


@dataclass(frozen=True)
class Verdict:
    """What a window is said to show.

    Attributes:
        t: s, the device's clock at the latest frame.
        t_host: s, the host's clock at that frame.
        chances: label -> its probability in this window; of ``dangerous`` the largest since the alarm was
            raised, as long as it lasts.
        touched: debounced; False: nothing touches the skin, and the labels mean nothing.
        labels: label -> debounced answer; empty without touch.
        dangerous: what alarms, until the contact ends; never without touch.
        gap: frames are missing in the window.
        masked: sensors that say nothing in the whole window.
        contact: for how long something has touched the skin, s; None: nothing does now.
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

    def words(self) -> list[tuple[str, float]]:
        """Return what is said in words, each with its probability in this window; nothing without touch."""
        pairs = [
            (name, self.chances[name]) if yes else (OPPOSITE.get(name, ""), 1 - self.chances[name])
            for name, yes in self.labels.items()
        ]
        return [(word, chance) for word, chance in pairs if word]


@checked("live.patience")
@dataclass(frozen=True)
class DebounceSettings:
    """How long an answer must hold before it is said, and be gone before it is taken back, s.

    Attributes:
        label: of any label but ``dangerous``, and of touch.
        alarm: of ``dangerous`` before it is said; after more than 0.03 s it would be said too late,
            50 ms after the frame that shows it.
        calm: before it is taken back.
        above: probability above which a touch is said to be dangerous; None: as the run stores it.

    Raises:
        InputError: a negative time, an alarm that would come too late, or no probability.
    """

    label: NonNegativeFloat = 0.15
    alarm: Annotated[float, Ge(0), Le(0.03)] = 0.02
    calm: NonNegativeFloat = 0.5
    above: Annotated[float, Gt(0), Lt(1)] | None = None


@dataclass
class Debounce:
    """Says yes once that was the answer for ``rise`` seconds, and no after ``fall`` seconds of no.

    Where frames come less often than that, one frame is enough.

    Attributes:
        rise: s.
        fall: s.
        state: what is said.
    """

    rise: float
    fall: float
    state: bool = False
    _since: float | None = field(default=None, repr=False)

    def __call__(self, answer: bool, t: float, period: float) -> bool:
        """Return what is said after an answer at ``t`` that holds for ``period``, s."""
        if answer == self.state:
            self._since = None
            return self.state
        self._since = t if self._since is None else self._since
        # Rounding of the clock must not cost a frame.
        if t - self._since + period >= (self.rise if answer else self.fall) - 1e-6:
            self.state, self._since = answer, None
        return self.state
