"""Which channels mean something: none that is saturated, stuck or dead."""

from typing import Literal

import numpy as np

__all__ = ["Health", "State"]

State = Literal["ok", "saturated", "stuck", "dead"]

_SILENT = 5.0  # s without any change
_LIVELY = 1.0  # s within which most channels change, if their noise can be seen at all


class Health:
    """Judges channels frame by frame.

    A value at a limit is saturated. A channel that does not change at all for five seconds in which most
    others kept changing is stuck, or dead if it never changed. Where the noise of an untouched skin is below
    one count, neither can be told, and neither is. One change, and the channel counts again.

    Args:
        limits: smallest and largest value a channel can send; None where a value at rest may lie there, as
            at 0 of a resistor that conducts only under load.
    """

    def __init__(self, limits: tuple[float | None, float | None] = (None, None)) -> None:
        low, high = limits
        self._low = -np.inf if low is None else low
        self._high = np.inf if high is None else high
        self.restart()

    def restart(self) -> None:
        """Forget the past: the device started anew."""
        self._last: np.ndarray | None = None

    def valid(self, values: np.ndarray, t: float) -> np.ndarray:
        """Return which values (S,) mean something, (S,), bool.

        Args:
            values: as sent.
            t: s, rising.
        """
        if self._last is None or len(values) != len(self._last):
            self._begin(values, t)
        self._saturated = (values >= self._high) | (values <= self._low)
        changed = values != self._last
        self._last = values
        self._changed_at[changed] = t
        self._ever |= changed
        silent = t - self._changed_at
        if 2 * np.count_nonzero(silent < _LIVELY) <= len(values):
            self._lively_since = t
        self._silent = (silent >= _SILENT) & (t - self._lively_since >= _SILENT)
        return ~(self._saturated | self._silent)

    def states(self) -> tuple[State, ...]:
        """Return what is wrong with each channel as of the last frame; empty before the first."""
        if self._last is None:
            return ()
        dead = self._silent & ~self._ever
        kinds: list[State] = ["ok", "saturated", "stuck", "dead"]
        worst = np.where(dead, 3, np.where(self._silent, 2, np.where(self._saturated, 1, 0)))
        return tuple(kinds[number] for number in worst)

    def _begin(self, values: np.ndarray, t: float) -> None:
        self._last = values
        self._changed_at = np.full(len(values), t)
        self._ever = np.zeros(len(values), dtype=bool)
        self._saturated = self._silent = np.zeros(len(values), dtype=bool)
        self._lively_since = t
