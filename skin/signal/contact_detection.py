"""Contact detection: readings against the tared baseline, over time."""

from math import ceil

import numpy as np

DRIFT = 0.2 / 600  # N/s: 0.2 N in ten minutes
_RELEASE = 0.3  # s below the threshold that end a contact


class ContactDetector:
    """Detects contact in a stream of tared readings.

    A contact begins where a reading rises by the threshold above the baseline. It ends where no reading did
    so for 0.3 s, however long it lasts. The baseline is 0 after a tare. It follows what the sensors read only
    while nothing touches, and by at most ``drift``: no touch becomes the baseline unless its force rises
    more slowly than that. A skin that drifts further than the threshold during a contact stays in contact
    until the next tare. A reading below the baseline by more than the threshold shows that the tare was taken
    under a load; there the baseline follows within seconds.

    A sensor that becomes invalid during a contact keeps its part in it until it is valid again.

    Args:
        sensors: S.
        rate: of the readings, Hz.
        threshold: N.
        drift: N/s.

    Attributes:
        baseline: (S,), N.
        since: s, when the contact began; None without contact.
    """

    def __init__(self, sensors: int, rate: float, threshold: float, drift: float = DRIFT) -> None:
        self._rate, self._threshold, self._drift = rate, threshold, drift
        self._recent = max(1, ceil(_RELEASE * rate - 1e-9))
        self._touched = np.zeros(sensors, dtype=bool)
        self.reset()

    def reset(self) -> None:
        """Reset after a new tare."""
        self.baseline = np.zeros(len(self._touched))
        self._touched[:] = False
        self.since: float | None = None
        self._at: float | None = None

    def rises(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, rise by the threshold above the baseline, (T, S), bool."""
        return valid & (readings - self.baseline >= self._threshold)

    def update(self, readings: np.ndarray, valid: np.ndarray, t: float) -> bool:
        """Update with the window that ends now; return whether something touches the skin.

        Args:
            readings: (T, S), N, tared.
            valid: (T, S), bool.
            t: s, on a clock that never goes back.
        """
        risen, last = self.rises(readings, valid), slice(-self._recent, None)
        self._touched = np.where(valid[last].any(axis=0), risen[last].any(axis=0), self._touched)
        if self._touched.any():
            if self.since is None:
                idle = np.flatnonzero(~risen.any(axis=1))
                before = int(idle[-1]) if len(idle) else -1
                self.since = t - (len(risen) - 2 - before) / self._rate
        else:
            self.since = None
            self._follow(readings[last], valid[last], 0.0 if self._at is None else t - self._at)
        self._at = t
        return self.since is not None

    def _follow(self, readings: np.ndarray, valid: np.ndarray, passed: float) -> None:
        """Move the baseline towards the latest readings, as far as ``passed`` s allow."""
        known = np.where(valid, readings, self.baseline)
        away = np.median(known, axis=0) - self.baseline
        loaded = known.max(axis=0) < self.baseline - self._threshold
        fall = np.where(loaded, self._threshold, self._drift) * passed
        self.baseline = self.baseline + np.clip(away, -fall, self._drift * passed)
