"""Classify a stream of frames, without input or output."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import ceil, floor, inf
from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from skin.hardware.live.verdict import Debounce, DebounceSettings, Verdict
from skin.labels import Task
from skin.settings import checked
from skin.signal.contact_detection import DRIFT, ContactDetector
from skin.signal.decisions import DECISIONS, RELEASE, as_press, held_frames, longest_shown
from skin.signal.frame import Frame, StreamClock
from skin.signal.resampling import Window
from skin.wire.conversion import UnitConversion
from skin.wire.tare import EXPECTED, FROZEN

Classify = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Readings (B, T, S), float32, N, and valid (B, T, S), bool, of windows -> probabilities (B, L)."""

_GAP = 0.5  # s without a frame after which the history of the window is lost
_CHANGING = 0.3  # share of changes at the tare from which a channel must change within FROZEN
_ROUNDING = 1e-6  # s


@checked("detection")
@dataclass(frozen=True)
class Detection:
    """Settings of the contact detection.

    Attributes:
        threshold: N above the tared baseline.
        drift: N/s, largest rate at which the baseline follows the untouched skin.
        learned: use the model's label ``touch`` in addition.
        longest: s, longest touch of the training.

    Raises:
        InputError: an invalid value.
    """

    threshold: PositiveFloat
    drift: NonNegativeFloat = DRIFT
    learned: bool = False
    longest: float = 2.0


@dataclass(frozen=True)
class EngineSettings:
    """What an :class:`Engine` is built from.

    Attributes:
        classify, task, sensors, frames, rate, detection, patience, presses: as there.
    """

    classify: Classify
    task: Task
    sensors: int
    frames: int
    rate: float
    detection: Detection
    patience: DebounceSettings
    presses: np.ndarray | None = None

    def build(self) -> "Engine":
        """Return a new engine."""
        return Engine(**{entry.name: getattr(self, entry.name) for entry in fields(self)})


class _Decision(NamedTuple):
    """What is known at a tick before the window is classified.

    Attributes:
        frame: the latest.
        time: of the stream, s.
        readings, valid: of the window as the model sees it, (T, S).
        contact: something touches the skin now.
        risen: some reading of the window rises above the threshold.
        lasted: duration of the contact, s; None without contact.
        gap: frames are missing in the window.
        masked: sensors without a valid reading now.
        unknown: sensors at which a dangerous touch could not be felt.
        below: sensors that read below their rest.
        last: the stream is interrupted behind it.
    """

    frame: Frame
    time: float
    readings: np.ndarray
    valid: np.ndarray
    contact: bool
    risen: bool
    lasted: float | None
    gap: bool
    masked: tuple[int, ...]
    unknown: tuple[int, ...]
    below: tuple[int, ...]
    last: bool


class Engine:
    """Decides on the window of a stream twenty times per second of device time, or at every slower frame.

    When it decides does not depend on when the frames arrive, nor on how many at a time. After a start, a
    restart of the device, or a gap of half a second, the missing history counts as the tared rest.

    An alarm is latched: once raised, it stays until the contact ends, whatever the model predicts. A contact
    that lasts longer than any touch of the training is presented to the model as a press with the present
    readings after the last idle readings; otherwise a constant load would look like an untouched skin.

    Args:
        classify: gives the probabilities of windows.
        task: the labels.
        sensors: S.
        frames: T, frames of a window.
        rate: of the training, Hz.
        detection: settings of the contact detection.
        patience: settings of debouncing.
        presses: (S, S), N, readings of a press at the limit of ``dangerous`` on each sensor: where no valid
            one rises by the threshold, the place is unknown. None: each sensor feels what is on itself.

    Attributes:
        alarm: the latest verdict was dangerous, and the contact has not ended.
    """

    def __init__(
        self,
        classify: Classify,
        task: Task,
        sensors: int,
        frames: int,
        rate: float,
        detection: Detection,
        patience: DebounceSettings | None = None,
        presses: np.ndarray | None = None,
    ) -> None:
        self.window = Window(frames, rate, sensors)
        self.task = task
        self._classify, self._detection = classify, detection
        self._patience = patience or DebounceSettings()
        self._contact = ContactDetector(sensors, rate, detection.threshold, detection.drift)
        self._held = held_frames(detection.longest, rate, frames)
        self._shown = longest_shown(self._held, ceil(RELEASE * rate - 1e-9), frames)
        self._above = 0.5 if self._patience.above is None else self._patience.above
        responds = None if presses is None else presses >= detection.threshold
        self._responds = np.eye(sensors, dtype=bool) if responds is None else responds
        self._clock, self._freshness = StreamClock(), _Freshness(sensors)
        self._segment: int | None = None
        self._latest: tuple[Frame, float] | None = None
        self._tick = -1
        self._decided = True
        self.reset()

    @property
    def contact(self) -> bool:
        """Whether something touches the skin, at the latest decision."""
        return self._contact.since is not None

    @property
    def frozen(self) -> bool:
        """Whether no reading has changed for so long that the device cannot be working."""
        return self._freshness.frozen

    def reset(self) -> None:
        """Reset alarm and contact, after a tare of the untouched skin."""
        self._contact.reset()
        shape = self.window.frames, self.window.sensors
        self._idle = np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=bool)
        self.alarm, self._peak_probability = False, 0.0
        slow = self._patience.label, self._patience.label
        self._touch = Debounce(*slow)
        self._labels = {name: Debounce(*slow) for name in self.task.gated}
        self._labels |= {"dangerous": Debounce(self._patience.alarm, self._patience.calm)}
        self._agreeing = dict[str, float]()

    def push(self, frames: Sequence[Frame], conversion: UnitConversion | None) -> list[Verdict]:
        """Return the verdicts that are due with these frames, the latest one last.

        Args:
            frames: as the device sent them, in their order.
            conversion: of their values to N; None: not known yet, so that nothing can be decided.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        decisions = list[_Decision]()
        for frame in frames:
            decisions += self._add(frame, conversion)
        return self._judge(decisions)

    def _add(self, frame: Frame, conversion: UnitConversion | None) -> list[_Decision]:
        """Add a frame to the window; return the decisions that are due."""
        time, due = self._clock(frame), list[_Decision]()
        if self._interrupted(frame, time):
            # What came last before the interruption would be forgotten undecided.
            due += self._decide(conversion, last=True)
            self.window.clear()
        self._segment, self._latest, self._decided = frame.segment, (frame, time), False
        self.window.add(frame._replace(t=time, segment=0))
        self._freshness.add(frame, time, conversion)
        tick = floor((time + _ROUNDING) * DECISIONS)
        if tick != self._tick:
            self._tick = tick
            due += self._decide(conversion)
        return due

    def _interrupted(self, frame: Frame, time: float) -> bool:
        if self._latest is None:
            return False
        return frame.segment != self._segment or time - self._latest[1] > max(_GAP, 3 * self.window.period)

    def _decide(self, conversion: UnitConversion | None, last: bool = False) -> list[_Decision]:
        """Return the decision on the window that ends with the latest frame; none without a conversion."""
        seen = self.window.read(partial=True)
        if self._decided or conversion is None or seen is None or self._latest is None:
            return []
        self._decided = True
        frame, time = self._latest
        readings, valid = conversion(seen.values, seen.valid)
        if conversion.noise is not None:
            self._contact.noise = conversion.noise
        valid = valid & ~self._freshness.stuck
        below = self._contact.falls(readings, valid)
        contact = self._contact.update(readings, valid, time)
        risen = bool(self._contact.rises(readings, valid).any())
        # To the model a sensor below its rest is as one without a reading.
        valid = valid & ~below
        readings = np.where(valid, readings, 0.0).astype(np.float32)
        # Unknown history counts as the rest of the sensors that are valid now.
        readings[: seen.before] = self._contact.baseline
        valid[: seen.before] = valid[seen.before :].any(axis=0)
        if not contact and not risen:
            self._idle = readings, valid
        lasted = None if self._contact.since is None else time - self._contact.since
        unknown = ~self._responds[:, valid[-1]].any(axis=1)
        readings, known = self._presented(readings, valid, lasted or 0.0)
        return [
            _Decision(
                frame=frame,
                time=time,
                readings=readings,
                valid=known,
                contact=contact,
                risen=risen,
                lasted=lasted,
                gap=seen.gap,
                masked=_numbers(~valid[-1]),
                unknown=_numbers(unknown),
                below=_numbers(below[-1]),
                last=last,
            )
        ]

    def _presented(
        self, readings: np.ndarray, valid: np.ndarray, lasted: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the window (T, S) as the model sees it, during a contact of ``lasted`` s."""
        if lasted * self.window.rate <= self._shown:
            return readings, valid
        idle, known = self._idle
        return as_press(idle, readings, self._held), as_press(known, valid, self._held)

    def _judge(self, decisions: Sequence[_Decision]) -> list[Verdict]:
        """Classify the windows of decisions at once, and return their verdicts."""
        if not decisions:
            return []
        readings, valid = (
            np.stack([getattr(decision, name) for decision in decisions]) for name in ("readings", "valid")
        )
        chances = np.asarray(self._classify(readings, valid), dtype=float)
        return [self._verdict(*pair) for pair in zip(decisions, chances.tolist(), strict=True)]

    def _verdict(self, decision: _Decision, probabilities: Sequence[float]) -> Verdict:
        chances = dict(zip(self.task.names, probabilities, strict=True))
        learned = self._detection.learned and chances[self.task.gate or ""] > 0.5
        period = max(self.window.period, 1 / DECISIONS)
        # A touch that the window shows, but that has ended, raises no alarm.
        present = decision.contact or (learned and not decision.risen)
        self._update_alarm(present, chances, decision, period)
        # An alarm does not wait for the debounced touch.
        touched = decision.contact or decision.risen or learned
        touched = self._touch(touched, decision.time, period) or self.alarm
        labels = self._debounced(chances, decision.time, period)
        if "dangerous" in chances:
            labels["dangerous"] = self.alarm
            chances["dangerous"] = max(self._peak_probability, chances["dangerous"])
        return Verdict(
            decision.frame.t,
            decision.frame.t_host,
            chances,
            touched,
            labels if touched else {},
            self.alarm,
            decision.gap,
            decision.masked,
            decision.lasted,
            decision.unknown,
            decision.below,
            dict(self._agreeing),
        )

    def _update_alarm(
        self, touched: bool, chances: dict[str, float], decision: _Decision, period: float
    ) -> None:
        """Raise the alarm during a contact that is dangerous; keep it until the contact ends."""
        chance = chances.get("dangerous", 0.0)
        # A NaN probability must not make a touch safe.
        dangerous = touched and not chance <= self._above
        # No second decision can follow the last one before an interruption.
        period = inf if decision.last and dangerous else period
        raised = self._labels["dangerous"](dangerous, decision.time, period)
        self.alarm = raised or (self.alarm and decision.contact)
        self._peak_probability = max(self._peak_probability, chance) if self.alarm else 0.0

    def _debounced(self, chances: dict[str, float], time: float, period: float) -> dict[str, bool]:
        """Return the predicted labels but ``dangerous``: the likeliest one if they exclude each other."""
        if self.task.kind == "exclusive":
            best = max(chances, key=chances.__getitem__)
            predicted = {name: name == best for name in chances}
        else:
            predicted = {name: chance > 0.5 for name, chance in chances.items()}
        gated = [name for name in self.task.gated if name != "dangerous"]
        labels = {name: self._labels[name](predicted[name], time, period) for name in gated}
        # A word must not stand beside the probability of its opposite.
        self._agreeing |= {name: chances[name] for name in gated if labels[name] == predicted[name]}
        return labels


def _numbers(which: np.ndarray | np.bool) -> tuple[int, ...]:
    """Return the numbers of the sensors in a mask (S,)."""
    return tuple(np.flatnonzero(which).tolist())


class _Freshness:
    """Finds readings that do not change, though they did while the baseline was taken.

    Attributes:
        frozen: none of the readings has changed for :data:`FROZEN` s.
        stuck: (S,), bool, sensors whose readings have not changed for so long, unless they are at a limit.
    """

    def __init__(self, sensors: int) -> None:
        self.frozen, self.stuck = False, np.zeros(sensors, dtype=bool)
        self._values: np.ndarray | None = None
        self._changed_at, self._unchanged = np.zeros(sensors), 0

    def add(self, frame: Frame, time: float, conversion: UnitConversion | None) -> None:
        """Compare a frame with the one before."""
        if self._values is None or frame.after not in ("", "gap"):
            changed = np.ones(len(frame.values), dtype=bool)
        else:
            changed = frame.values != self._values
        self._changed_at[changed] = time
        self._unchanged = 0 if changed.any() else self._unchanged + 1
        self._values = frame.values
        changing = None if conversion is None else conversion.changing
        if changing is None:
            return
        silent = time - self._changed_at >= FROZEN - _ROUNDING
        limited = np.zeros_like(silent) if frame.saturated is None else frame.saturated
        self.stuck = silent & (changing >= _CHANGING) & ~limited
        # Noise alone would have changed some reading so many times.
        self.frozen = bool(silent.all() and self._unchanged * changing.sum() >= EXPECTED)
