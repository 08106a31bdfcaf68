"""Classify a stream of frames, without input or output."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from skin.hardware.live.verdict import Debounce, DebounceSettings, Verdict
from skin.labels import Task
from skin.settings import checked
from skin.signal.contact_detection import DRIFT, ContactDetector
from skin.signal.frame import Frame
from skin.signal.resampling import Resampled, Window
from skin.wire.conversion import UnitConversion

Classify = Callable[[np.ndarray, np.ndarray], Sequence[float]]
"""Readings (T, S), float32, N, and valid (T, S), bool, of a window -> the probability of each label."""


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


class Engine:
    """Classifies at every frame the window that ends there.

    An alarm is latched: once raised, it stays until the contact ends, whatever the model predicts. A contact
    that lasts longer than any touch of the training is presented to the model as a press with the present
    readings after the last idle readings; otherwise a constant load would look like an untouched skin.

    Args:
        classify: gives the probabilities of a window.
        task: the labels.
        sensors: S.
        frames: T, frames of a window.
        rate: of the training, Hz.
        detection: settings of the contact detection.
        patience: settings of debouncing.

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
    ) -> None:
        self.window = Window(frames, rate, sensors)
        self.task = task
        self._classify, self._detection = classify, detection
        self._patience = patience or DebounceSettings()
        self._contact = ContactDetector(sensors, rate, detection.threshold, detection.drift)
        self._held = min(max(1, round(detection.longest * rate)), max(1, frames - 2))
        self._above = 0.5 if self._patience.above is None else self._patience.above
        self._segment: int | None = None
        self.reset()

    def reset(self) -> None:
        """Reset alarm and contact, after a tare of the untouched skin."""
        self._contact.reset()
        shape = self.window.frames, self.window.sensors
        self._idle = np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=bool)
        self.alarm, self._peak_probability = False, 0.0
        self._restart()

    def _restart(self) -> None:
        patience = self._patience
        slow = patience.label, patience.label
        self._touch = Debounce(*slow)
        self._labels = {name: Debounce(*slow) for name in self.task.gated}
        self._labels |= {"dangerous": Debounce(patience.alarm, patience.calm)}

    def add(self, frame: Frame) -> None:
        """Add a frame to the window without classifying it.

        Args:
            frame: as the device sent it.
        """
        if frame.segment != self._segment:
            self._segment = frame.segment
            self._restart()
        self.window.add(frame)

    def push(self, frame: Frame, conversion: UnitConversion) -> Verdict | None:
        """Return the verdict on the window that ends with this frame.

        Args:
            frame: as the device sent it.
            conversion: of its values to N.

        Returns:
            None while the window is not full, unless an alarm is latched.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        self.add(frame)
        seen = self.window.read()
        return self._waiting(frame, conversion) if seen is None else self._verdict(seen, frame, conversion)

    def _waiting(self, frame: Frame, conversion: UnitConversion) -> Verdict | None:
        """Return a latched alarm while the window fills again after a restart of the device."""
        if not self.alarm:
            return None
        seen = self.window.read(partial=True)
        if seen is not None and not self._contact.update(*conversion(seen.values, seen.valid), frame.t_host):
            self.alarm = False
            return None
        chances, labels = {"dangerous": self._peak_probability}, {"dangerous": True}
        return Verdict(frame.t, frame.t_host, chances, True, labels, True, True, (), self._since(frame))

    def _since(self, frame: Frame) -> float | None:
        """Return the duration of the contact, s; None without contact."""
        since = self._contact.since
        return None if since is None else frame.t_host - since

    def _verdict(self, seen: Resampled, frame: Frame, conversion: UnitConversion) -> Verdict:
        readings, valid = conversion(seen.values, seen.valid)
        contact = self._contact.update(readings, valid, frame.t_host)
        risen = bool(self._contact.rises(readings, valid).any())
        if not contact and not risen:
            self._idle = readings, valid
        chances = self._probabilities(readings, valid, self._since(frame) or 0.0)
        touched = contact or risen or (self._detection.learned and chances[self.task.gate or ""] > 0.5)
        masked = tuple(np.flatnonzero(~valid.any(axis=0)).tolist())
        period = self.window.period

        def debounced(debounce: Debounce, answer: bool) -> bool:
            return debounce(answer, frame.t, period)

        chance = chances.get("dangerous", 0.0)
        # A NaN probability must not make a touch safe.
        raised = debounced(self._labels["dangerous"], touched and not chance <= self._above)
        self.alarm = raised or (self.alarm and contact)
        self._peak_probability = max(self._peak_probability, chance) if self.alarm else 0.0
        # An alarm does not wait for the debounced touch.
        shown = debounced(self._touch, touched) or self.alarm
        answer = self._answers(chances)
        labels = {
            name: debounced(self._labels[name], answer[name])
            for name in self.task.gated
            if name != "dangerous"
        }
        if "dangerous" in self.task.names:
            labels["dangerous"] = self.alarm
            chances["dangerous"] = max(self._peak_probability, chance)
        labels, since = labels if shown else {}, self._since(frame)
        return Verdict(frame.t, frame.t_host, chances, shown, labels, self.alarm, seen.gap, masked, since)

    def _probabilities(self, readings: np.ndarray, valid: np.ndarray, lasted: float) -> dict[str, float]:
        """Return label -> probability of a window (T, S), N, at the end of a contact of ``lasted`` s."""
        if lasted * self.window.rate > self._held:
            before = (len(readings) - self._held) // 2
            readings, valid = (
                np.concatenate([idle[:before], now[-self._held :], idle[before + self._held :]])
                for idle, now in zip(self._idle, (readings, valid), strict=True)
            )
        return dict(zip(self.task.names, self._classify(readings, valid), strict=True))

    def _answers(self, chances: dict[str, float]) -> dict[str, bool]:
        """Return the predicted labels of this window: the likeliest one if they exclude each other."""
        if self.task.kind == "exclusive":
            best = max(chances, key=chances.__getitem__)
            return {name: name == best for name in chances}
        return {name: chance > 0.5 for name, chance in chances.items()}
