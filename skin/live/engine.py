"""Classify a stream of frames, without input or output: verdicts, their debouncing, and the engine."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from math import ceil, floor, inf
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from pydantic import NonNegativeFloat, PositiveFloat

from skin.core.settings import checked
from skin.device.resampling import Frame, Resampled, StreamClock, Window
from skin.evaluation.decisions import (
    DECISIONS,
    DRIFT,
    ContactDetector,
    as_press,
    held_frames,
    longest_shown,
)
from skin.live.verdict import LASTING, Note, Verdict, order_notes
from skin.touch.labels import RELEASE, Task
from skin.wire.channels import EXPECTED, FROZEN, UnitConversion, fails_in_contact


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
        InputError: a negative time, an alarm that would be too late, or a value that is not a probability.
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


Classify = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Readings (B, T, S), float32, N, and valid (B, T, S), bool, of windows -> probabilities (B, L)."""

_DISTINCT = 10  # different frames of a block that is repeated
_GAP = 0.5  # s without a frame after which the history of the window is lost
_CHANGING = 0.3  # fraction of changes at the tare from which a channel must change within FROZEN
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
    """What an :class:`Engine` is built from: its arguments."""

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
    """A window that is to be classified.

    Attributes:
        draft: the verdict, without what the model says.
        time: of the stream, s.
        readings, valid: of the window as the model sees it, (T, S).
        risen: some reading of the window rises above the threshold.
        last: the stream is interrupted behind it.
    """

    draft: Verdict
    time: float
    readings: np.ndarray
    valid: np.ndarray
    risen: bool
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
        shares = (
            None
            if presses is None
            else presses / np.maximum(np.diagonal(presses), 1e-9)[:, None] - np.eye(sensors)
        )
        self._contact = ContactDetector(sensors, rate, detection.threshold, detection.drift, shares)
        self._held = held_frames(detection.longest, rate, frames)
        self._shown = longest_shown(self._held, ceil(RELEASE * rate - 1e-9), frames)
        self._above = 0.5 if self._patience.above is None else self._patience.above
        self._responds = np.eye(sensors, dtype=bool) if presses is None else presses >= detection.threshold
        self._clock, self._freshness, self._losses = StreamClock(), _Freshness(sensors), _Losses()
        self._latest: tuple[Frame, float, float] | None = None  # with its time, and that since the one before
        self._tick = -1
        self._decided = True
        self.reset()

    @property
    def contact(self) -> bool:
        """Whether something touches the skin, at the latest decision."""
        return self._contact.since is not None

    @property
    def baseline(self) -> np.ndarray:
        """Readings (S,), N, of the untouched skin by now."""
        return self._contact.baseline

    @property
    def frozen(self) -> "Frozen":
        """Why the device cannot be working; empty if it may be."""
        return self._freshness.frozen

    def reset(self, raised: np.ndarray | None = None) -> None:
        """Reset alarm and contact, after a tare of the untouched skin.

        Args:
            raised: (S,), N, baseline of the tare above the rest that is stored for the device: something may
                have touched it. None: no rest is stored.
        """
        raised = np.zeros(self.window.sensors) if raised is None else raised
        self._contact.reset(raised >= self._detection.threshold)
        shape = self.window.frames, self.window.sensors
        self._idle = np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=bool)
        self.alarm, self._peak_probability = False, 0.0
        slow = self._patience.label, self._patience.label
        self._touch = Debounce(*slow)
        self._labels = {name: Debounce(*slow) for name in self.task.gated}
        self._labels |= {"dangerous": Debounce(self._patience.alarm, self._patience.calm)}
        self._agreeing, self._doubts = dict[str, float](), dict[str, Note]()

    def push(self, frames: Sequence[Frame], conversion: UnitConversion | None) -> list[Verdict]:
        """Return the verdicts that are due with these frames, the latest one last.

        Args:
            frames: as the device sent them, in their order.
            conversion: of their values to N; None: not known yet, so that nothing can be decided.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        decisions = [decision for frame in frames for decision in self._add(frame, conversion)]
        if not decisions:
            return []
        readings, valid = (
            np.stack([getattr(decision, name) for decision in decisions]) for name in ("readings", "valid")
        )
        probabilities = np.asarray(self._classify(readings, valid), dtype=float)
        return [self._conclude(*pair) for pair in zip(decisions, probabilities.tolist(), strict=True)]

    def _add(self, frame: Frame, conversion: UnitConversion | None) -> Iterator[_Decision]:
        """Add a frame to the window; yield the decisions that are due."""
        time = self._clock(frame)
        pause = 0.0 if self._latest is None else time - self._latest[1]
        if self._interrupted(frame, time):
            # What came last before the interruption would be forgotten undecided.
            yield from self._decide(conversion, last=True)
            self.window.clear()
            if frame.after in ("reset", "reconnect"):
                self._contact.restart()
        self._latest, self._decided = (frame, time, pause), False
        self.window.add(frame._replace(t=time, segment=0))
        self._freshness.add(frame, time, conversion)
        self._losses.add(frame.lost + (not frame.valid.all()), time, self.contact)
        tick = floor((time + _ROUNDING) * DECISIONS)
        if tick != self._tick:
            self._tick = tick
            yield from self._decide(conversion)

    def _interrupted(self, frame: Frame, time: float) -> bool:
        if self._latest is None:
            return False
        latest, before, _ = self._latest
        pause = time - before
        return frame.segment != latest.segment or (pause > _GAP and pause > 3 * self.window.period)

    def _decide(self, conversion: UnitConversion | None, last: bool = False) -> Iterator[_Decision]:
        """Yield the decision on the window that ends with the latest frame; none without a conversion."""
        seen = self.window.read(partial=True)
        if self._decided or conversion is None or seen is None or self._latest is None:
            return
        self._decided = True
        frame, time, pause = self._latest
        # A tap may come and go; but a device of the rate of a slow model may lose two frames, too.
        pause = pause if pause > max(_GAP / 2, 2.5 / self.window.rate) else 0.0
        readings, valid, below = self._read_window(seen, conversion, time)
        risen = bool(self._contact.rises(readings, valid).any())
        readings, valid = self._fill_window(readings, valid & ~below & ~self._contact.lost, seen.before)
        if not self.contact and not risen:
            self._idle = readings, valid
        lasted = None if self._contact.since is None else time - self._contact.since
        responding = self._responds[:, valid[-1] & ~self._contact.void]
        unknown = np.asarray(~responding.any(axis=1) | (pause > 0))
        draft = Verdict(
            t=frame.t,
            t_host=frame.t_host,
            gap=seen.gap,
            masked=_numbers(~valid[-1]),
            contact=lasted,
            unknown=_numbers(unknown),
            notes=self._find_notes(unknown, below[-1], pause),
        )
        yield _Decision(draft, time, *self._cut_window(readings, valid, lasted or 0.0), risen, last)

    def _read_window(
        self, seen: Resampled, conversion: UnitConversion, time: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Update the contact; return readings, N, valid, and which of them are below rest, each (T, S)."""
        readings, valid = conversion(seen.values, seen.valid)
        if conversion.noise is not None:
            self._contact.noise = conversion.noise
        valid = valid & ~self._freshness.stuck
        below = self._contact.falls(readings, valid)
        self._contact.update(readings, valid, time)
        return readings, valid, below

    def _fill_window(
        self, readings: np.ndarray, valid: np.ndarray, before: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return readings and valid, (T, S), with the rest where there is none: in the first rows, too."""
        # To the model a sensor below its rest is as one without a reading.
        readings = np.where(valid, readings, 0.0).astype(np.float32)
        # Unknown history counts as the rest of the sensors that are valid now.
        readings[:before] = self._contact.baseline
        valid[:before] = valid[before:].any(axis=0)
        return readings, valid

    def _find_notes(self, unknown: np.ndarray, below: np.ndarray, pause: float) -> tuple[Note, ...]:
        """Return the notes on a decision.

        Args:
            unknown, below: (S,), bool, sensors where a touch would stay undetected; sensors below rest.
            pause: s without a frame before the latest; 0 if it was short.
        """
        void, beyond, lost = self._contact.void, self._contact.beyond, self._contact.lost
        masked = unknown & ~(void | below | beyond | lost | (pause > 0))
        sensors = {"below": below, "void": void, "over_range": beyond, "lost_wire": lost, "masked": masked}
        notes = [Note(code, _numbers(which)) for code, which in sensors.items() if which.any()]
        notes += [Note("unreadable")] * self._losses.excessive + [Note("pause", seconds=pause)] * (pause > 0)
        return tuple(notes)

    def _cut_window(
        self, readings: np.ndarray, valid: np.ndarray, lasted: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the window (T, S) as the model sees it, during a contact of ``lasted`` s."""
        if lasted * self.window.rate <= self._shown:
            return readings, valid
        idle, idle_valid = self._idle
        return as_press(idle, readings, self._held), as_press(idle_valid, valid, self._held)

    def _conclude(self, decision: _Decision, probabilities: Sequence[float]) -> Verdict:
        """Return the verdict on a decision, given the probabilities of its window, one per label."""
        chances = dict(zip(self.task.names, probabilities, strict=True))
        learned = self._detection.learned and chances[self.task.gate or ""] > 0.5
        period = max(self.window.period, 1 / DECISIONS)
        self._update_alarm(decision, chances, learned, period)
        touching = decision.draft.contact is not None or decision.risen or learned
        # An alarm does not wait for the touch.
        touched = self._touch(touching, decision.time, period) or self.alarm
        labels = self._debounce_labels(decision.time, chances, period)
        notes = self._collect_notes(decision.draft.notes, chances, touched)
        if "dangerous" in chances:
            labels |= {"dangerous": self.alarm}
            chances |= {"dangerous": max(self._peak_probability, chances["dangerous"])}
        return replace(
            decision.draft,
            chances=chances,
            touched=touched,
            labels=labels if touched else {},
            dangerous=self.alarm,
            notes=notes,
            agreeing=dict(self._agreeing),
        )

    def _update_alarm(
        self, decision: _Decision, chances: dict[str, float], learned: bool, period: float
    ) -> None:
        """Raise the alarm during a contact that is dangerous; keep it until the contact ends."""
        contact = decision.draft.contact is not None
        # A touch that the window shows, but that has ended, raises no alarm.
        present = contact or (learned and not decision.risen)
        chance = chances.get("dangerous", 0.0)
        # A NaN probability must not make a touch safe.
        dangerous = present and not chance <= self._above
        # No second decision can follow the last one before an interruption.
        period = inf if decision.last and dangerous else period
        raised = self._labels["dangerous"](dangerous, decision.time, period)
        self.alarm = raised or (self.alarm and contact)
        self._peak_probability = max(self._peak_probability, chance) if self.alarm else 0.0

    def _collect_notes(
        self, present: Sequence[Note], chances: dict[str, float], touched: bool
    ) -> tuple[Note, ...]:
        """Return the notes on a decision, those of the touch so far, and on its danger."""
        notes = self._doubts | {note.code: note for note in present}
        # What makes a touch doubtful holds until it ends.
        self._doubts = {code: note for code, note in notes.items() if code in LASTING and touched}
        if 0.5 < chances.get("dangerous", 0.0) <= self._above and touched and not self.alarm:
            notes["near_threshold"] = Note("near_threshold")
        return order_notes(notes.values())

    def _debounce_labels(self, time: float, chances: dict[str, float], period: float) -> dict[str, bool]:
        """Return the predicted labels but ``dangerous``: the likeliest one if they exclude each other."""
        best = max(chances, key=chances.__getitem__)
        exclusive = self.task.kind == "exclusive"
        labels = {}
        for name in self.task.gated:
            if name == "dangerous":
                continue
            predicted = name == best if exclusive else chances[name] > 0.5
            labels[name] = self._labels[name](predicted, time, period)
            # A word must not stand beside the probability of its opposite.
            if labels[name] == predicted:
                self._agreeing[name] = chances[name]
        return labels


def _numbers(which: np.ndarray | np.bool) -> tuple[int, ...]:
    """Return the numbers of the sensors in a mask (S,)."""
    return tuple(np.flatnonzero(which).tolist())


class _Losses:
    """Compares the frames lost in a contact, or without a value of some sensor, with those lost at rest.

    Attributes:
        excessive: since half a second before the present contact, so many frames were lost or unreadable that
            it is no accident: values beyond the range may make them unreadable.
    """

    def __init__(self) -> None:
        self.excessive = False
        self._recent = deque[tuple[float, int]]()
        self._rest, self._touched = np.zeros((2, 2), dtype=int)  # frames, and those that were lost

    def add(self, lost: int, time: float, contact: bool) -> None:
        """Add a frame, with which ``lost`` frames were lost."""
        self._recent.append((time, lost))
        if not contact:
            self._touched[:] = 0.0
        while time - self._recent[0][0] > _GAP:
            earlier = self._recent.popleft()[1]
            (self._touched if contact else self._rest)[:] += 1, earlier
        if not contact:
            self.excessive = False
        elif lost:
            failed = self._touched[1] + sum(before for _, before in self._recent)
            frames = self._touched[0] + len(self._recent) + failed
            self.excessive |= fails_in_contact(failed, frames, self._rest[1], self._rest.sum())


Frozen = Literal["", "still", "repeated"]
"""Why readings count as frozen: they do not; none has changed; a block of frames is sent again and again."""


class _Freshness:
    """Finds readings that do not change, though they did while the baseline was taken.

    Attributes:
        frozen: none of the readings has changed for :data:`FROZEN` s, or frames repeat those before.
        stuck: (S,), bool, sensors whose readings have not changed for so long, unless they are at a limit.
    """

    def __init__(self, sensors: int) -> None:
        self.frozen: Frozen = ""
        self.stuck = np.zeros(sensors, dtype=bool)
        self._values: np.ndarray | None = None
        self._changed_at, self._unchanged, self._time, self._clock = np.zeros(sensors), 0, 0.0, 0.0
        self._rows, self._equal = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)

    def add(self, frame: Frame, time: float, conversion: UnitConversion | None) -> None:
        """Compare a frame with the one before; nothing is known of a time without frames."""
        self._clock, self._time = self._clock + min(time - self._time, _GAP), time
        if self._values is None or frame.after not in ("", "gap"):
            changed = np.ones(len(frame.values), dtype=bool)
        else:
            changed = frame.values != self._values
        self._changed_at[changed] = self._clock
        self._unchanged = 0 if changed.any() else self._unchanged + 1
        self._values = frame.values
        if conversion is None or conversion.changing is None:
            return
        silent = self._clock - self._changed_at >= FROZEN - _ROUNDING
        limited = np.zeros_like(silent) if frame.saturated is None else frame.saturated
        self.stuck = silent & (conversion.changing >= _CHANGING) & ~limited
        # Noise alone would have changed some reading so many times.
        still = silent.all() and self._unchanged * conversion.changing.sum() >= EXPECTED
        self.frozen = "still" if still else "repeated" if self._repeats(frame, conversion.equal) else ""

    def _repeats(self, frame: Frame, equal: np.ndarray) -> bool:
        """Return whether the latest frames are, one after the other, those before them.

        Args:
            frame: the latest.
            equal: (L,), probability that a frame at rest equals that 1, 2, ... frames before.
        """
        if len(equal) != len(self._rows):
            self._rows, self._equal = (np.zeros(len(equal), dtype=np.int64) for _ in range(2))
        row = hash(frame.values.tobytes())
        self._equal = np.where(self._rows == row, self._equal + 1, 0)
        self._rows = np.concatenate([[row], self._rows[:-1]])
        likely = -self._equal * np.log(equal) < EXPECTED
        if likely.all():
            return False
        # Sensors at their limit, all but one, may repeat a few values.
        return len(np.unique(self._rows[: self._equal[~likely].max()])) >= _DISTINCT
