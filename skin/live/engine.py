"""Classify a stream of readings, without input or output: verdicts, their debouncing, and the engine."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, floor, inf
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from pydantic import NonNegativeFloat, PositiveFloat

from skin.core.settings import checked
from skin.device.resampling import Frame, Window
from skin.evaluation.decisions import (
    DECISIONS,
    DRIFT,
    ContactDetector,
    held_frames,
    longest_shown,
    present_as_press,
)
from skin.evaluation.guarantee import Guarantee
from skin.evaluation.operating_point import DangerScore
from skin.live.verdict import LASTING, Note, Verdict, order_notes
from skin.touch.labels import ALARM, RELEASE, Task
from skin.wire.channels import NewtonFrame, Reason, fails_in_contact


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
        since = t if self._since is None else self._since
        # Rounding of the clock must not cost a frame.
        if t - since + period >= (self.rise if answer else self.fall) - 1e-6:
            self.state = answer
        self._since = None if answer == self.state else since
        return self.state


Classify = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Readings (B, T, S), float32, N, and valid (B, T, S), bool, of windows -> probabilities (B, L)."""

_GAP = 0.5
"""s without a frame after which the history of the window is lost: longer than any burst of a bridge."""
_RUN = 4
"""Frames lost in a row that are no accident: of a link that loses a tenth, one run in 10,000 is as long."""


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


@dataclass(eq=False)
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
        presses: (S, S), N, readings of a press at the limit of ``dangerous`` on each sensor; None: each
            sensor feels what is on itself.
        danger: combines the model's probability of ``dangerous`` with the largest reading; None: the model's.
        guarantee: of the threshold; it lapses while a watch reports a sensor. None: there is none.
        along: (S,), bool, channels along the surface, as in :class:`ContactDetector`.

    Attributes:
        window: of the latest readings, N.
        detector: of contact, with what the untouched skin reads by now.
        above: probability above which a touch is dangerous.
        alarm: the latest verdict was dangerous, and the contact has not ended.
        changed: sensors that a watch reports, whose positions are unknown.
        short: (S,), bool, sensors whose range ends below what a dangerous touch may read.
        device_rate: frames a second, Hz, as measured; 0: unknown.
    """

    classify: Classify
    task: Task
    sensors: int
    frames: int
    rate: float
    detection: Detection
    patience: DebounceSettings = field(default_factory=DebounceSettings)
    presses: np.ndarray | None = None
    danger: DangerScore | None = None
    guarantee: Guarantee | None = None
    along: np.ndarray | bool = False
    changed: tuple[int, ...] = field(default=(), init=False)
    device_rate: float = field(default=0.0, init=False)
    short: np.ndarray | bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.window = Window(self.frames, self.rate, self.sensors)
        self.detector = ContactDetector(
            self.sensors,
            self.rate,
            self.detection.threshold,
            self.detection.drift,
            self.fractions,
            self.along,
        )
        self._held = held_frames(self.detection.longest, self.rate, self.frames)
        self._shown = longest_shown(self._held, ceil(RELEASE * self.rate - 1e-9), self.frames)
        self.above = 0.5 if self.patience.above is None else self.patience.above
        self._losses = _Losses()
        self._latest: NewtonFrame | None = None
        # The pause is the time between the latest readings and those before, s.
        self._pause, self._tick, self._decided = 0.0, -1, True
        self.reset()

    @property
    def fractions(self) -> np.ndarray | None:
        """(S, S), readings of other sensors under a touch, relative to that of the sensor; None: unknown."""
        if self.presses is None:
            return None
        own = np.maximum(np.diagonal(self.presses), 1e-9)[:, None]
        return np.where(self.along, 0.0, self.presses / own - np.eye(self.sensors))

    def reset(self, raised: np.ndarray | None = None, noise: np.ndarray | None = None) -> None:
        """Forget readings, alarm and contact, after a tare of the untouched skin.

        Args:
            raised: (S,), N, baseline of the tare above the rest that is stored for the device: something may
                have touched it. None: no rest is stored.
            noise: (S,), N, standard deviation of the readings of the untouched skin; None: as before.
        """
        self._high = self._hidden = np.zeros(self.sensors, dtype=bool)
        self.detector.reset(self._high if raised is None else raised >= self.detection.threshold)
        self.detector.noise = self.detector.noise if noise is None else noise
        self.window.clear()
        self._idle = (
            np.zeros((self.frames, self.sensors), dtype=np.float32),
            np.ones((self.frames, self.sensors), dtype=bool),
        )
        self.alarm, self._peak_probability, self._ended = False, 0.0, -inf
        label, patience = self.patience.label, self.patience
        self._touch, self._danger = Debounce(label, label), Debounce(patience.alarm, patience.calm)
        self._labels = {name: Debounce(label, label) for name in self.task.gated if name != "dangerous"}
        self._agreeing, self._lasting = dict[str, float](), dict[str, Note]()

    def remember(self, stream: Sequence[NewtonFrame]) -> None:
        """Take readings on which nothing is decided: those before the first tare."""
        for readings in stream:
            self._add(readings)

    def push(self, stream: Sequence[NewtonFrame]) -> list[Verdict]:
        """Return the verdicts that are due with these readings, the latest one last.

        Args:
            stream: readings in their order.

        Raises:
            InputError: the stream is slower than the model's rate.
        """
        decisions = [decision for readings in stream for decision in self._take(readings)]
        if not decisions:
            return []
        readings, valid = (
            np.stack([getattr(decision, name) for decision in decisions]) for name in ("readings", "valid")
        )
        probabilities = np.asarray(self.classify(readings, valid), dtype=float)
        if self.danger is not None:
            column = self.task.names.index(ALARM)
            largest = np.where(valid, readings, 0.0).max(axis=(1, 2))
            probabilities[:, column] = self.danger.probability(probabilities[:, column], largest)
        return [self._conclude(*pair) for pair in zip(decisions, probabilities.tolist(), strict=True)]

    def _take(self, readings: NewtonFrame) -> Iterator[_Decision]:
        """Add readings to the window; yield the decisions that are due."""
        if self._interrupted(readings):
            # What came last before the interruption would be forgotten undecided.
            yield from self._decide(last=True)
        if self._add(readings):
            yield from self._decide()

    def _interrupted(self, readings: NewtonFrame) -> bool:
        """Return whether the history of the window is lost with these readings."""
        latest = self._latest or readings
        pause = readings.t - latest.t  # the period takes long to compute
        restarted = readings.frame.segment != latest.frame.segment
        return restarted or (pause > _GAP and pause > 3 * self.window.period)

    def _add(self, readings: NewtonFrame) -> bool:
        """Add readings to the window; return whether a decision is due."""
        frame, t = readings.frame, readings.t
        if self._interrupted(readings):
            self.window.clear()
            if frame.after in ("reset", "reconnect"):
                self.detector.restart()
        before, self._latest, self._decided = self._latest or readings, readings, False
        self._pause = t - before.t
        # What is frozen now is left out of this whole window, and of no later one. An interval with a
        # reading that no skin can have is unknown: the force may be beyond the range.
        sent = readings._replace(mask=readings.mask & ~(Reason.FROZEN | Reason.IMPLAUSIBLE))
        newtons = np.where(readings.mask & Reason.IMPLAUSIBLE, np.inf, readings.newtons)
        self.window.add(Frame(None, t, t, newtons, sent.usable, 0, frame.lost, frame.after, sent.saturated))
        no_number = readings.mask & (Reason.MISSING | Reason.IMPOSSIBLE | Reason.IMPLAUSIBLE)
        # What is lost in a touch, more than by chance, may be a force beyond the range, and all of a tap.
        self._hidden = (
            self._hidden
            | self._high & (((no_number > 0) & ~before.usable) | (frame.lost >= _RUN > before.frame.lost))
            | readings.saturated & self.short
        )
        self._high = np.where(no_number, self._high, self.detector.rises(readings.newtons, no_number == 0))
        # What a channel does all the time must not hide what frames do in a contact.
        failed = no_number & ~before.mask & ~Reason.IMPLAUSIBLE
        self._losses.add(frame.lost + failed.any(), t, self.detector.since is not None)
        tick, self._tick = self._tick, floor((t + 1e-6) * DECISIONS)  # a rounding of the clock
        return tick != self._tick

    def _decide(self, last: bool = False) -> Iterator[_Decision]:
        """Yield the decision on the window that ends with the latest readings."""
        window, latest = self.window.read(partial=True), self._latest
        if self._decided or window is None or latest is None:
            return
        self._decided = True
        readings, valid = window.values.astype(np.float32), window.valid & (latest.mask & Reason.FROZEN == 0)
        below = self.detector.falls(readings, valid)
        self.detector.update(readings, valid, latest.t, self._hidden)
        self._hidden = np.zeros_like(self._hidden)
        risen = bool(self.detector.rises(readings, valid).any())
        readings, valid = self._fill(readings, valid & ~below & ~self.detector.lost, window.before)
        blind, notes = self._find_blind(valid[-1], below[-1])
        contact = None if self.detector.since is None else latest.t - self.detector.since
        draft = Verdict(
            t=latest.frame.t,
            t_host=latest.frame.t_host,
            gap=window.gap,
            masked=_numbers(~valid[-1]),
            contact=contact,
            unknown=blind,
            notes=notes,
        )
        if contact is None and not risen:
            self._idle = readings, valid
        if (contact or 0.0) * self.rate > self._shown:
            pairs = zip(self._idle, (readings, valid), strict=True)
            readings, valid = (present_as_press(idle, present, self._held) for idle, present in pairs)
        yield _Decision(draft, latest.t, readings, valid, risen, last)

    def _fill(self, readings: np.ndarray, valid: np.ndarray, before: int) -> tuple[np.ndarray, np.ndarray]:
        """Return readings and valid, (T, S), with the rest where there is none: in the first rows, too."""
        # A skin that has sunk since the tare, by more than noise, would hide as much of each touch. A reading
        # that is back at its rest is none, though its baseline has followed a broken wire.
        sunk = np.where(self.detector.baseline < -self.detection.threshold / 2, self.detector.baseline, 0.0)
        # To the model a sensor below its rest is as one without a reading.
        shift = np.where(
            np.abs(readings - self.detector.rest) < self.detection.threshold,
            np.maximum(sunk, np.minimum(self.detector.rest, 0.0)),
            sunk,
        )
        readings = np.where(valid, readings - shift, 0.0).astype(np.float32)
        # Unknown history counts as the rest of the sensors that are valid now.
        readings[:before] = self.detector.baseline - sunk
        valid[:before] = valid[before:].any(axis=0)
        return readings, valid

    def _find_blind(self, valid: np.ndarray, below: np.ndarray) -> tuple[tuple[int, ...], tuple[Note, ...]]:
        """Return the sensors where a touch may stay undetected, and the notes on a decision.

        Args:
            valid, below: (S,), bool, sensors whose latest reading can be used; sensors below rest.
        """
        void, beyond, lost = self.detector.void, self.detector.beyond, self.detector.lost
        # A tap may come and go; but a device of the rate of a slow model may lose two frames, too.
        paused = bool(self._pause > max(_GAP / 2, 2.5 / self.rate))
        changed = np.isin(np.arange(self.sensors), self.changed)
        # A neighbour that responds need not tell a dangerous press from others.
        blind = ~valid | void | paused | changed
        sensors = {
            "below": below,
            "void": void,
            "over_range": beyond,
            "lost_wire": lost,
            "changed": changed,
            "masked": ~(valid | void | below | beyond | lost | paused | changed),
        }
        notes = [Note(code, _numbers(which)) for code, which in sensors.items() if which.any()]
        if self.guarantee is not None:
            guarantee = self.guarantee.at(self.device_rate) if self.device_rate else self.guarantee
            notes.append(Note(f"guarantee_{guarantee.state(self.changed)}", detail=guarantee.sentence()))
        notes += [Note("unreadable")] * self._losses.excessive + [Note("pause", seconds=self._pause)] * paused
        return _numbers(blind), tuple(notes)

    def _conclude(self, decision: _Decision, outputs: Sequence[float]) -> Verdict:
        """Return the verdict on a decision, given the outputs of its window, probabilities, one per label."""
        probabilities = dict(zip(self.task.names, outputs, strict=True))
        learned = self.detection.learned and probabilities[self.task.gate or ""] > 0.5
        period = max(self.window.period, 1 / DECISIONS)
        self._update_alarm(decision, probabilities, learned, period)
        touching = decision.draft.contact is not None or decision.risen or learned
        # An alarm does not wait for the touch.
        touched = self._touch(touching, decision.time, period) or self.alarm
        if decision.draft.contact is not None or learned:
            self._ended = decision.time
        # A touch that leaves the window looks shorter than it was, so a press would become a tap.
        finished = touched and decision.time - self._ended > 2 * self.patience.label
        labels = self._debounce_labels({} if finished else probabilities, decision.time, period)
        notes = self._collect_notes(decision.draft.notes, probabilities, touched or touching)
        if "dangerous" in probabilities:
            labels |= {"dangerous": self.alarm}
            probabilities |= {"dangerous": max(self._peak_probability, probabilities["dangerous"])}
        return replace(
            decision.draft,
            probabilities=probabilities,
            touched=touched,
            labels=labels if touched else {},
            dangerous=self.alarm,
            notes=notes,
            agreeing=dict(self._agreeing),
        )

    def _update_alarm(
        self, decision: _Decision, probabilities: dict[str, float], learned: bool, period: float
    ) -> None:
        """Raise the alarm during a contact that is dangerous; keep it until the contact ends."""
        contact = decision.draft.contact is not None
        # A touch that the window shows, but that has ended, raises no alarm.
        present = contact or (learned and not decision.risen)
        probability = probabilities.get("dangerous", 0.0)
        # A NaN probability must not make a touch safe.
        dangerous = present and not probability <= self.above
        # No second decision can follow the last one before an interruption.
        period = inf if decision.last and dangerous else period
        self.alarm = self._danger(dangerous, decision.time, period) or (self.alarm and contact)
        self._peak_probability = max(self._peak_probability, probability) if self.alarm else 0.0

    def _collect_notes(
        self, present: Sequence[Note], probabilities: dict[str, float], touched: bool
    ) -> tuple[Note, ...]:
        """Return the notes on a decision, those of the touch so far, and on its danger."""
        notes = self._lasting | {note.code: note for note in present}
        # What makes a touch uncertain holds until it ends.
        self._lasting = {code: note for code, note in notes.items() if code in LASTING and touched}
        near = 0.5 < probabilities.get("dangerous", 0.0) <= self.above and touched and not self.alarm
        return order_notes([*notes.values(), *[Note("near_threshold")] * near])

    def _debounce_labels(
        self, probabilities: dict[str, float], time: float, period: float
    ) -> dict[str, bool]:
        """Return the labels but ``dangerous``: the likeliest one if they exclude each other.

        Without probabilities, they stay as they are.
        """
        best = max(probabilities, key=probabilities.__getitem__, default="")
        for name in self._labels.keys() & probabilities:
            debounce = self._labels[name]
            predicted = name == best if self.task.kind == "exclusive" else probabilities[name] > 0.5
            # A word must not stand beside the probability of its opposite.
            if debounce(predicted, time, period) == predicted:
                self._agreeing[name] = probabilities[name]
        return {name: debounce.state for name, debounce in self._labels.items()}


def _numbers(which: np.ndarray | np.bool) -> tuple[int, ...]:
    """Return the numbers of the sensors in a mask (S,)."""
    return tuple(np.flatnonzero(which).tolist())


class _Losses:
    """Compares the frames lost in a contact, or with which some sensor loses its value, with those at rest.

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
            self._touched[:], self.excessive = 0, False
        while time - self._recent[0][0] > _GAP:
            earlier = self._recent.popleft()[1]
            (self._touched if contact else self._rest)[:] += 1, earlier
        if contact and lost:
            failed = self._touched[1] + sum(before for _, before in self._recent)
            frames = self._touched[0] + len(self._recent) + failed
            self.excessive |= fails_in_contact(failed, frames, self._rest[1], self._rest.sum())
