"""Contact detection: readings against the tared baseline, over time."""

from math import ceil

import numpy as np

from skin.touch.labels import RELEASE

# When the alarm is decided, and on which window: shared by the live view and its simulation.


DECISIONS = 20.0
"""Decisions per second of device time; one per frame of a slower device."""


def held_frames(longest: float, rate: float, window: int) -> int:
    """Return the largest number of frames in contact that a model has seen in its training.

    Args:
        longest: touch of the training, s.
        rate: of the model, Hz.
        window: T, frames.
    """
    return min(max(1, round(longest * rate)), max(1, window - 2))


def longest_shown(held: int, recent: int, window: int) -> int:
    """Return the frames of a contact up to which the model sees its window as it is.

    A touch as long as the longest of the training lies across one more interval, and its contact ends some
    frames later.

    Args:
        held: as :func:`held_frames` gives it.
        recent: frames without a rise that end a contact.
        window: T, frames.
    """
    return min(held + recent + 1, max(1, window - 2))


def as_press(idle: np.ndarray, present: np.ndarray, held: int) -> np.ndarray:
    """Return a window in which a contact that lasts too long appears as a press.

    A constant load would otherwise look like an untouched skin.

    Args:
        idle: (T, ...), the latest window without contact.
        present: (T, ...), the window that ends now.
        held: frames of contact that the result shows, from :func:`held_frames`.
    """
    before = (len(present) - held) // 2
    return np.concatenate([idle[:before], present[-held:], idle[before + held :]])


DRIFT = 0.2 / 600  # N/s: 0.2 N in ten minutes
_DOUBT = 1.0  # s of rest that end a contact whose sensor was invalid meanwhile
_LONGEST = 1.0  # s for which the baseline drifts at most between two updates
_SINK = 1.0  # thresholds per second by which the baseline follows downwards
_MARGIN = 0.5  # of the threshold, below the baseline, from which on it does so
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
    until the next tare. Downwards the baseline of an untouched sensor follows within seconds, which hides no
    touch: the tare may have been taken under a load.

    A sensor that becomes invalid during a contact, or jumps below its rest, keeps its part in the contact
    until it was valid and at rest for a second.

    Args:
        sensors: S.
        rate: of the readings, Hz.
        threshold: N.
        drift: N/s.

    Attributes:
        baseline: (S,), N, above which readings rise.
        rest: (S,), N, readings of the untouched skin: the baseline, but for sensors that jumped below it.
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
        self.baseline, self.rest = np.zeros(len(self._touched)), np.zeros(len(self._touched))
        self._touched[:] = self._doubtful[:] = False
        self.since: float | None = None
        self._updated_at: float | None = None

    def rises(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, rise by the threshold above the baseline, (T, S), bool."""
        # Back at the rest of the tare is no rise: a wire has contact again.
        rested = np.abs(readings - self.rest) < self._threshold
        return valid & (readings - self.baseline >= self._threshold) & ~rested

    def falls(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, are so far below their rest that no touch explains it.

        The wire is broken, the values fall with force, or the tare was taken under a load.
        """
        rise = np.where(valid, readings - self.rest, 0.0)
        least = np.maximum(self._threshold, _NOISE * self.noise)
        return np.asarray(rise < -(least + _LIFT * rise.max(axis=-1, keepdims=True)))

    def update(self, readings: np.ndarray, valid: np.ndarray, t: float) -> bool:
        """Update with the window that ends now; return whether something touches the skin.

        Args:
            readings: (T, S), N, tared.
            valid: (T, S), bool.
            t: s, on a clock that never goes back.
        """
        risen, recent = self.rises(readings, valid), slice(-self._recent, None)
        sound = valid & ~self.falls(readings, valid)
        rested, rested_long = ((sound & ~risen)[-span:].all(axis=0) for span in (self._recent, self._long))
        self._doubtful |= self._touched & ~sound[-1]
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
        self._follow(readings[recent], valid[recent], sound[recent].all(axis=0), passed)
        self._updated_at = t
        return self.since is not None

    def _follow(self, readings: np.ndarray, valid: np.ndarray, sound: np.ndarray, passed: float) -> None:
        """Move baseline and rest towards the latest readings, as far as ``passed`` s allow.

        Args:
            readings, valid: the latest, (T, S).
            sound: (S,), bool, sensors that have been valid and not below their rest.
            passed: s since the last update.
        """
        middle = np.median(np.where(valid, readings, self.baseline), axis=0)
        rise = 0.0 if self.since is not None else self._drift * passed
        self.baseline = self.baseline + self._step(middle - self.baseline, rise, passed)
        step = self._step(np.median(np.where(valid, readings, self.rest), axis=0) - self.rest, rise, passed)
        self.rest = self.rest + np.where(sound, step, 0.0)
        back = sound & ~self._touched & (np.abs(readings - self.rest) < self._threshold).all(axis=0)
        self.baseline = np.where(back, self.rest, self.baseline)

    def _step(self, away: np.ndarray, rise: float, passed: float) -> np.ndarray:
        """Return how far baselines (S,) move in ``passed`` s towards readings that are ``away``, N."""
        fast = _SINK * self._threshold * passed
        slow = np.clip(away, -rise, rise)
        # Noise alone must not lower the baseline, because it rises slowly.
        far = np.clip(away + _MARGIN * self._threshold, -fast, 0.0)
        return np.where(self._touched, 0.0, np.where(far < 0, far, slow))
