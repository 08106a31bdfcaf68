"""State of each channel: ok, saturated (valid, at its limit), stuck, dead, or impossible (out of range)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

ChannelState = Literal["ok", "saturated", "stuck", "dead", "impossible"]
Limits = tuple[float | None, float | None]

_SILENT = 5.0  # s without any change
_LIVELY = 1.0  # s within which most channels change, if their noise can be seen at all
_BELOW = 0.01  # share of the range below 0 that an offset explains
_FAR = 20  # smallest steps of a channel: more than its noise ranges over


@dataclass(frozen=True)
class RawRange:
    """Values that a device can send.

    Attributes:
        least, most: of a channel; None: unknown.
        whole: it sends whole numbers.
        limits: at which a channel is saturated.
    """

    least: float | None = None
    most: float | None = None
    whole: bool = False
    limits: Limits = (None, None)

    @property
    def known(self) -> bool:
        """Whether the scale can be checked: too large or too small a force would leave the range."""
        return self.most is not None

    def rounded(self, values: np.ndarray) -> np.ndarray:
        """Return values as the device would send them."""
        least = -np.inf if self.least is None else self.least
        most = np.inf if self.most is None else self.most
        return np.clip(np.round(values) if self.whole else values, least, most)


class ChannelHealth:
    """Checks channels frame by frame.

    A value at a limit is saturated and valid: the force is at least that. A channel that does not change for
    five seconds while most others do is stuck, or dead if it has never changed. Neither state is detected if
    the noise of the untouched skin is below one count. A single change makes the channel valid again. A
    channel that stays at the largest value it has ever sent, far above its smallest, is saturated at an
    unknown limit rather than stuck, because a held press must not be masked.

    A value that the converter cannot give is invalid at once.

    Args:
        limits: smallest and largest value of a channel; None where an untouched channel may have this value,
            such as 0 of a resistor that conducts only under load.

    Attributes:
        limits: as given; a new value applies from the next frame on.
        largest: largest count of the converter, whose smallest is 0; None: unknown.
    """

    def __init__(self, limits: Limits = (None, None)) -> None:
        self.limits = limits
        self.largest: float | None = None
        self._last: np.ndarray | None = None
        self._begin_time = True
        self._ever, self._smallest = np.zeros(0, dtype=bool), np.zeros(0)

    def restart(self) -> None:
        """Reset the times after a restart of the device; the known range of each channel is kept."""
        self._begin_time = True

    def check(self, values: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return which values (S,) are valid and which are saturated, (S,), bool each.

        Args:
            values: as sent.
            t: s, rising.
        """
        if self._last is None or len(values) != len(self._last):
            self._last = self._begin(values)
        if self._begin_time:
            self._changed_at, self._lively_since, self._begin_time = np.full(len(values), t), t, False
        step = np.abs(values - self._last)
        changed = step > 0
        self._last = values
        self._changed_at[changed] = t
        self._ever |= changed
        self._smallest = np.minimum(self._smallest, np.where(changed, step, np.inf))
        np.minimum(self._least, values, out=self._least)
        np.maximum(self._most, values, out=self._most)
        silent = t - self._changed_at
        if 2 * np.count_nonzero(silent < _LIVELY) <= len(values):
            self._lively_since = t
        self._silent = (silent >= _SILENT) & (t - self._lively_since >= _SILENT)
        low, high = self.limits
        at_limit = (values >= (np.inf if high is None else high)) | (
            values <= (-np.inf if low is None else low)
        )
        loaded = self._ever & (self._most - self._least >= _FAR * self._smallest)
        self._saturated = at_limit | (self._silent & loaded & (values >= self._most))
        self._silent &= ~self._saturated
        self._impossible = self._outside(values)
        self._saturated &= ~self._impossible
        return ~self._silent & ~self._impossible, self._saturated

    def _outside(self, values: np.ndarray) -> np.ndarray:
        """Return which values the converter cannot give."""
        if self.largest is None:
            return np.zeros(len(values), dtype=bool)
        return (values > self.largest) | (values < -_BELOW * self.largest)

    def states(self) -> tuple[ChannelState, ...]:
        """Return the state of each channel at the last frame; empty before the first."""
        if self._last is None:
            return ()
        dead = self._silent & ~self._ever
        kinds: list[ChannelState] = ["ok", "saturated", "stuck", "dead", "impossible"]
        worst = np.where(dead, 3, np.where(self._silent, 2, np.where(self._saturated, 1, 0)))
        worst = np.where(self._impossible, 4, worst)
        return tuple(kinds[number] for number in worst)

    def _begin(self, values: np.ndarray) -> np.ndarray:
        self._begin_time = True
        self._least, self._most = np.array(values, dtype=float), np.array(values, dtype=float)
        self._smallest = np.full(len(values), np.inf)
        self._ever = np.zeros(len(values), dtype=bool)
        self._saturated, self._silent = self._ever.copy(), self._ever.copy()
        self._impossible = self._ever.copy()
        return values
