"""Contact detection: readings against the tared baseline, over time."""

from math import ceil

import numpy as np

from skin.signal.decisions import RELEASE

DRIFT = 0.2 / 600  # N/s: 0.2 N in ten minutes
_DOUBT = 1.0  # s of rest that end a contact whose sensor was invalid meanwhile
_LONGEST = 1.0  # s for which the baseline drifts at most between two updates
_NOISE = 5.0  # standard deviations that noise does not exceed
_LIFT = 0.1
"""Share of the largest reading below which no sensor beside a touch falls: 0.044 is the most that the solid
shows, with friction of 0.5."""


class ContactDetector:
    """Detects contact in a stream of tared readings.

    A contact begins where a reading rises by the threshold above the baseline. It ends where no reading did
    so for 0.3 s, however long it lasts. The baseline is 0 after a tare. It follows what the sensors read only
    while nothing touches, and by at most ``drift``: no touch becomes the baseline unless its force rises
    more slowly than that. A skin that drifts further than the threshold during a contact stays in contact
    until the next tare.

    A sensor that becomes invalid during a contact keeps its part in it until it is valid again and was at
    rest for a second.

    Args:
        sensors: S.
        rate: of the readings, Hz.
        threshold: N.
        drift: N/s.

    Attributes:
        baseline: (S,), N.
        noise: (S,), N, standard deviation of a reading of the untouched skin.
        since: s, when the contact began; None without contact.
    """

    def __init__(self, sensors: int, rate: float, threshold: float, drift: float = DRIFT) -> None:
        self._rate, self._threshold, self._drift = rate, threshold, drift
        self._recent, self._long = (max(1, ceil(span * rate - 1e-9)) for span in (RELEASE, _DOUBT))
        self._touched, self._doubtful = np.zeros(sensors, dtype=bool), np.zeros(sensors, dtype=bool)
        self.noise = np.zeros(sensors)
        self.reset()

    def reset(self) -> None:
        """Reset after a new tare."""
        self.baseline = np.zeros(len(self._touched))
        self._touched[:] = self._doubtful[:] = False
        self.since: float | None = None
        self._updated_at: float | None = None

    def rises(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, rise by the threshold above the baseline, (T, S), bool."""
        return valid & (readings - self.baseline >= self._threshold)

    def falls(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, are so far below the baseline that no touch explains it.

        The wire is broken, the values fall with force, or the tare was taken under a load.
        """
        rise = np.where(valid, readings - self.baseline, 0.0)
        least = np.maximum(self._threshold, _NOISE * self.noise)
        return np.asarray(rise < -(least + _LIFT * rise.max(axis=-1, keepdims=True)))

    def update(self, readings: np.ndarray, valid: np.ndarray, t: float) -> bool:
        """Update with the window that ends now; return whether something touches the skin.

        Args:
            readings: (T, S), N, tared.
            valid: (T, S), bool: measured, and possible.
            t: s, on a clock that never goes back.
        """
        risen, recent = self.rises(readings, valid), slice(-self._recent, None)
        rested = self._rested(risen[recent], valid[recent])
        rested_long = self._rested(risen[-self._long :], valid[-self._long :])
        self._doubtful |= self._touched & ~valid[-1]
        released = np.where(self._doubtful, rested_long, rested)
        self._touched = risen[recent].any(axis=0) | (self._touched & ~released)
        self._doubtful &= self._touched
        if self._touched.any():
            if self.since is None:
                idle = np.flatnonzero(~risen.any(axis=1))
                before = int(idle[-1]) if len(idle) else -1
                self.since = t - (len(risen) - 2 - before) / self._rate
        else:
            self.since = None
            passed = 0.0 if self._updated_at is None else min(t - self._updated_at, _LONGEST)
            self._follow(readings[recent], valid[recent], passed)
        self._updated_at = t
        return self.since is not None

    @staticmethod
    def _rested(risen: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which sensors were measured all the time (T, S) and did not rise, (S,)."""
        return np.asarray((valid & ~risen).all(axis=0))

    def _follow(self, readings: np.ndarray, valid: np.ndarray, passed: float) -> None:
        """Move the baseline towards the latest readings, as far as ``passed`` s allow."""
        known = np.where(valid, readings, self.baseline)
        away = np.median(known, axis=0) - self.baseline
        self.baseline = self.baseline + np.clip(away, -self._drift * passed, self._drift * passed)
