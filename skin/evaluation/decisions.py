"""Contact detection: readings against the tared baseline, over time."""

from dataclasses import dataclass
from math import ceil

import numpy as np

from skin.touch.labels import RELEASE

# When the alarm is decided, and on which window: shared by the live view and its simulation.


DECISIONS = 20.0
"""Decisions per second of device time; one per frame of a slower device."""


@dataclass(frozen=True)
class LiveConditions:
    """How a live view watches a skin.

    Attributes:
        rate: of the device, Hz.
        contact: N above the baseline that count as contact.
        longest: s, longest touch of the training.
        patience: s for which decisions must be dangerous before the alarm is raised.
        column: of ``dangerous`` among the labels of the learner.
        aligned: a device at the model's rate gives the frames of the model, as the simulator does; otherwise
            it reads at any phase of their intervals.
    """

    rate: float
    contact: float
    longest: float
    patience: float
    column: int
    aligned: bool = False

    def decisions(self, rate: float) -> int:
        """Return how many decisions in a row raise the alarm, for a device of ``rate``, Hz."""
        return max(1, ceil(self.patience * min(DECISIONS, rate) - 1e-6))


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


def present_as_press(idle: np.ndarray, present: np.ndarray, held: int) -> np.ndarray:
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


@dataclass(frozen=True)
class ContactLimits:
    """Limits of :class:`ContactDetector`; thresholds are those of contact.

    Attributes:
        rest: s without a rise that end a contact whose sensor was invalid meanwhile.
        step: s for which the baseline drifts at most between two updates.
        sink: thresholds per second by which the baseline follows downwards.
        margin: of the threshold, below the baseline, from which on it does so.
        noise: standard deviations that noise does not exceed.
        high: thresholds that a reading in the middle of a touch reaches.
        begun: thresholds that a reading at the beginning of a touch reaches.
        faint: thresholds: smallest reading that shows a touch beside a sensor, if there is no noise.
        lift: fraction of the largest reading below which no sensor beside a touch falls. The largest that the
            solid shows, with friction of 0.5, is 0.044.
    """

    rest: float = 1.0
    step: float = 1.0
    sink: float = 1.0
    margin: float = 0.5
    noise: float = 5.0
    high: float = 2.0
    begun: float = 0.5
    faint: float = 0.1
    lift: float = 0.1


_LIMITS = ContactLimits()


def minimum_visible(noise: np.ndarray, threshold: float) -> np.ndarray:
    """Return the readings (S,), N, half of which is no noise, given its standard deviation (S,), N."""
    return 2 * np.maximum(_LIMITS.noise * noise, _LIMITS.faint * threshold)


class ContactDetector:
    """Detects contact in a stream of tared readings.

    A contact begins where a reading rises by the threshold above the baseline. It ends where no reading did
    so for 0.3 s, however long it lasts. The baseline is 0 after a tare. It follows what the sensors read only
    while nothing touches, and by at most ``drift``: no touch becomes the baseline unless its force rises
    more slowly than that. A skin that drifts further than the threshold during a contact stays in contact
    until the next tare. Downwards the baseline of an untouched sensor follows within seconds, which hides no
    touch: the tare may have been taken under a load.

    A sensor that becomes invalid during a contact, or jumps below its rest, keeps its part in the contact
    until it was valid and at rest for a second. After a restart of the device, which may have tared itself, a
    sensor in contact keeps its part until it falls.

    Args:
        sensors: S.
        rate: of the readings, Hz.
        threshold: N.
        drift: N/s.
        fractions: (S, S), reading of each sensor under a touch on another, as a fraction of its reading;
            None: no sensor feels what is on another.
        along: (S,), bool, channels of sites with three axes that measure along the surface: a touch lowers
            them as well as it raises them.

    Attributes:
        baseline: (S,), N, above which readings rise.
        rest: (S,), N, readings of the untouched skin: the baseline, but for sensors that jumped below it.
        noise: (S,), N, standard deviation of a reading of the untouched skin.
        since: s, when the contact began; None without contact.
        void: (S,), bool, sensors that read below the baseline, faster than it may drift: something touched
            them when it was taken, or the device has changed it. They stay void until the next tare.
        beyond: (S,), bool, sensors that became invalid, or lost values, while their reading was high.
        lost: (S,), bool, sensors that fell to rest at once, though none of the others fell in proportion,
            until they rise again.
    """

    def __init__(
        self,
        sensors: int,
        rate: float,
        threshold: float,
        drift: float = DRIFT,
        fractions: np.ndarray | None = None,
        along: np.ndarray | bool = False,
    ) -> None:
        self._rate, self._threshold, self._drift, self._along = rate, threshold, drift, along
        self._recent, self._long = (max(1, ceil(span * rate - 1e-9)) for span in (RELEASE, _LIMITS.rest))
        self._fractions = np.zeros((sensors, sensors)) if fractions is None else fractions
        self._witnesses = np.zeros((sensors, sensors), dtype=bool)
        self._touched, self._doubtful, self._held = (np.zeros(sensors, dtype=bool) for _ in range(3))
        self.noise = np.zeros(sensors)
        self.reset(np.zeros(sensors, dtype=bool))

    def reset(self, void: np.ndarray) -> None:
        """Reset after a new tare, which is void for some sensors (S,)."""
        self.baseline, self.rest = np.zeros(len(void)), np.zeros(len(void))
        self._touched[:] = self._doubtful[:] = self._held[:] = False
        self.void, self.beyond, self.lost = void.copy(), void & False, void & False
        self._top, self._levels, self._peak = np.full(len(void), -np.inf), np.full(len(void), np.inf), 0.0
        self.since: float | None = None
        self._updated_at: float | None = None

    def restart(self) -> None:
        """Take note that the device was restarted."""
        self._held = self._touched.copy()
        self._top[:] = -np.inf

    def rises(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (..., S), N, rise by the threshold above the baseline, (..., S), bool."""
        risen = valid & (readings - self.baseline >= self._threshold)
        # Back at the rest of the tare is no rise: a wire has contact again.
        return risen & (np.abs(readings - self.rest) >= self._threshold)

    def falls(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which readings (T, S), N, are so far below their rest that no touch explains it.

        The wire is broken, the values fall with force, or the tare was taken under a load.
        """
        rise = np.where(valid, readings - self.rest, 0.0)
        return np.asarray(rise < -(self._minimum + _LIMITS.lift * rise.max(axis=-1, keepdims=True)))

    @property
    def _minimum(self) -> np.ndarray:
        """(S,), N, that a reading falls below its rest where neither noise, drift nor a touch explains it."""
        return np.where(self._along, np.inf, np.maximum(self._threshold, _LIMITS.noise * self.noise))

    def update(
        self, readings: np.ndarray, valid: np.ndarray, t: float, hidden: np.ndarray | bool = False
    ) -> bool:
        """Update with the window that ends now; return whether something touches the skin.

        Args:
            readings: (T, S), N, tared.
            valid: (T, S), bool.
            t: s, on a clock that never goes back.
            hidden: (S,), bool, sensors that have lost values since the last update, while they were high.
        """
        risen, recent = self.rises(readings, valid), slice(-self._recent, None)
        sound = valid & ~self.falls(readings, valid)
        rested, rested_long = ((sound & ~risen)[-span:].all(axis=0) for span in (self._recent, self._long))
        self._doubtful |= self._touched & ~sound[-1]
        released = np.where(self._doubtful, rested_long, rested) | self._fall(readings, valid)
        self._touched = risen[recent].any(axis=0) | (self._touched & ~released) | self._held
        self._touched |= self._find_faults(readings, valid, risen[-1], hidden)
        self._doubtful &= self._touched
        if self._touched.any():
            if self.since is None:
                self._peak = 0.0
                idle = np.flatnonzero(~risen.any(axis=1))
                before = int(idle[-1]) if len(idle) else -1
                self.since = min(t, t - (len(risen) - 2 - before) / self._rate)
        else:
            self.since = None
        passed, self._updated_at = t - (t if self._updated_at is None else self._updated_at), t
        self._follow(readings[recent], valid[recent], sound[recent].all(axis=0), min(passed, _LIMITS.step))
        return self.since is not None

    def _fall(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return which sensors, held since a restart, have fallen, (S,); find void baselines."""
        rises = np.where(valid, readings - self.rest, np.inf)[-self._recent :].max(axis=0)
        self._top = np.where(valid[-1], np.maximum(self._top, readings[-1] - self.rest), self._top)
        fallen = self._held & (rises <= self._top - self._threshold)
        self._held &= ~fallen
        # The skin may sink below its rest for a while after a touch.
        self.void |= rises < -(self._minimum + _LIMITS.lift * self._peak)
        self._peak = max(self._peak, float(np.where(valid[-1], readings[-1] - self.rest, 0.0).max()))
        return fallen

    def _find_faults(
        self, readings: np.ndarray, valid: np.ndarray, risen: np.ndarray, hidden: np.ndarray | bool
    ) -> np.ndarray:
        """Find sensors whose range ends, or whose wire breaks, while something presses them.

        Args:
            readings, valid: (T, S), the latest of a window of three or more.
            risen: (S,), bool, of the latest readings.
            hidden: as of :meth:`update`.

        Returns:
            (S,), bool, such sensors that something still presses.
        """
        self.lost &= ~risen
        # Sensors that lag may fall a little later than others.
        before, latest, now = np.where(valid, readings - self.rest, np.nan)[-3:]
        self.beyond = hidden | ~valid[-1] & (
            self.beyond | self._touched | (latest >= _LIMITS.begun * self._threshold)
        )
        expected, visible = before[:, None] * self._fractions, minimum_visible(self.noise, self._threshold)
        shown = expected >= visible
        steady = np.abs(now - before) < expected / 2
        witnesses = shown & steady & (np.minimum(before, now) >= expected / 2)
        fell = (before >= _LIMITS.high * self._threshold) & (np.abs(now) < self._threshold) & ~self.lost
        fell &= witnesses.any(axis=1) & (steady | ~shown).all(axis=1)
        if fell.any():
            self.lost |= fell
            self._witnesses[fell], self._levels = witnesses[fell], before
        still = now >= np.maximum(self._levels / 2, visible)
        return self.beyond | self.lost & (self._witnesses & still).any(axis=1)

    def _follow(self, readings: np.ndarray, valid: np.ndarray, sound: np.ndarray, passed: float) -> None:
        """Move baseline and rest towards the latest readings, as far as ``passed`` s allow.

        Args:
            readings, valid: the latest, (T, S).
            sound: (S,), bool, sensors that have been valid and not below their rest.
            passed: s since the last update.
        """
        middle = np.median(np.where(valid, readings, self.baseline), axis=0)
        rise = 0.0 if self.since is not None else self._drift * passed
        # What a touch lifts comes back when it ends.
        lift = _LIMITS.lift * float(np.where(valid, readings - self.rest, 0.0).max())
        self.baseline = self.baseline + self._step(middle - self.baseline, rise, lift, passed)
        away = np.median(np.where(valid, readings, self.rest), axis=0) - self.rest
        self.rest = self.rest + np.where(sound, self._step(away, rise, lift, passed), 0.0)
        back = sound & ~self._touched & (np.abs(readings - self.rest) < self._threshold).all(axis=0)
        self.baseline = np.where(back, self.rest, self.baseline)

    def _step(self, away: np.ndarray, rise: float, lift: float, passed: float) -> np.ndarray:
        """Return how far baselines (S,) move in ``passed`` s towards readings that are ``away``, N.

        They rise by ``rise`` at most, and fall fast to what a touch may ``lift``, N, below it by the drift.
        """
        falls = [[-_LIMITS.sink * self._threshold * passed], [-self._drift * passed]]
        # Noise alone must not lower the baseline, because it rises slowly.
        least = np.stack([away + max(lift, 0.0), away]) + _LIMITS.margin * self._threshold
        far = np.clip(least, falls, 0.0).min(axis=0)
        pressed = self._touched | self._along & self._touched.any()
        return np.where(pressed, 0.0, np.where(far < 0, far, np.clip(away, -rise, rise)))
