"""The live loop: read frames, classify, and share the state with views."""

import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from threading import Event, Lock, RLock, Thread
from time import monotonic
from typing import Any, Literal

import numpy as np

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.live.contacts import LiveContacts, unknown_contacts
from skin.live.engine import Engine, Frozen
from skin.live.verdict import Note, Verdict, order_notes, sensor_list, summarize_notes
from skin.wire.channels import Tare, UnitConversion
from skin.wire.reader import SkinDisconnected, SkinTimeout
from skin.wire.skin import Skin

_log = logging.getLogger(__name__)

Told = tuple[Verdict | None, str, bool]
"""What is said of the skin: the present verdict, else None; why there is none; and the alarm."""

Observer = Callable[[Verdict | None, str, bool], None]
"""Takes what is said of the skin; it must return at once."""

TareRequest = Literal["", "tare", "forced"]
"""A request for a new baseline: none, from the next quiet stretch, or from the next frames."""

_KEPT = 8192  # frames that are kept for slow views
_ONSET = 10  # frames of a touch before its contact is decided
_AGE = 0.5  # s after which a decision is old where the next is not overdue
_TOGETHER = 0.02  # s: decisions of one delivery
_USUAL = 5.0  # s over which the usual interval between decisions is taken
_OFTEN = 0.1  # s between two looks at the age of a verdict
_CONFIRM = 60.0  # s after a refusal in which a tare may be forced
Refusal = Literal["", "touched", "unforced"]
REFUSALS: dict[Refusal, str] = {
    "": "",
    "touched": "tare refused: something touches the skin; if nothing does, confirm it "
    "(terminal: force and Enter)",
    "unforced": "there is nothing to force",
}
"""Why the latest request for a new baseline was refused, in words."""
_TARES = {"tare": "new tare", "tare_forced": "tare forced by the operator"}

STALE = 1.5
"""s without frames after which nothing is known of the skin."""
OLD_READINGS = f"the latest readings are over {STALE:g} s old"
LATE = "no decision for longer than usual"
FROZEN_READINGS: dict[Frozen, str] = {
    "still": "readings are frozen: no channel has changed for 5 s",
    "repeated": "readings are frozen: the same frames come again and again",
}


@dataclass(frozen=True)
class DisplayInfo:
    """Constant information about a live view.

    Attributes:
        title: of the run.
        port: source of the frames.
        positions: (S, 3), m.
        size: extent (x, y) of the sheet, m.
        top: upper end of the colour scale, N.
        window: length of the classified window, s.
    """

    title: str
    port: str
    positions: np.ndarray
    size: tuple[float, float]
    top: float
    window: float = 3.0


@dataclass(frozen=True)
class DisplayState:
    """State of the live view at one moment.

    Attributes:
        number: of frames so far, to be passed to the next :meth:`Display.state`.
        values: (S,), N, the largest of each sensor since the last call, so that no peak is missed; the limit
            of a saturated sensor, 0 of an invalid one.
        valid: (S,), bool, of the latest frame.
        saturated: (S,), bool, since the last call: the force is at least the value.
        verdict: the latest one; None if there is none now.
        alarm: the latest verdict was dangerous, and the contact has not ended as far as known.
        line: text with rate, lost frames and latency.
        peak: (S,), N, the largest of each sensor in the touch that the verdict is about; 0 without touch.
        notes: on what may be wrong, the gravest first.
        contacts: what is known of them, as in :func:`skin.live.contacts.contact_message`.
    """

    number: int
    values: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    verdict: Verdict | None
    line: str
    alarm: bool
    peak: np.ndarray
    notes: tuple[Note, ...]
    contacts: dict[str, Any]

    @property
    def reason(self) -> str:
        """The gravest note in words, and the number of the others."""
        return summarize_notes(self.notes)

    @property
    def held(self) -> bool:
        """Whether the verdict is about a touch that has ended, or an alarm is on: show :attr:`peak`."""
        ended = self.verdict is not None and self.verdict.touched and self.verdict.contact is None
        return self.alarm or ended

    @property
    def map(self) -> np.ndarray:
        """Forces (S,), N, at the time of the verdict."""
        return self.peak if self.held else self.values


class Display:
    """The latest frames, verdict and status, shared by one writing thread and any number of views.

    A verdict that is older than half a second and the usual interval between decisions, or than
    :data:`STALE`, counts as none, whatever the reason. An alarm is shown for ``calm`` s at least, even if it
    was raised for frames that came late.

    Args:
        info: constant information.
        contacts: tells what is known of them.
        calm: s.

    Attributes:
        info: as given.
        notes: on the whole session.
        contacts: the latest estimate of them.
        closed: event, set at the end.
        observers: called with each verdict, in the thread that classifies.
        listeners: called with the name of each event of the operator, such as ``tare``.
    """

    def __init__(self, info: DisplayInfo, contacts: LiveContacts | None = None, calm: float = 2.0) -> None:
        self.info, self.closed, self.contacts = info, Event(), contacts or LiveContacts()
        self.notes: tuple[Note, ...] = ()
        self.observers: list[Observer] = []
        self.listeners: list[Callable[[str], None]] = []
        self._lock, self._telling = RLock(), Lock()
        sensors = len(info.positions)
        first = np.zeros(sensors), np.zeros(sensors, dtype=bool)
        self._frames: deque[tuple[np.ndarray, np.ndarray]] = deque([first], maxlen=_KEPT)
        self._valid, self._alarm = np.ones(sensors, dtype=bool), False
        self._peak, self._contact = np.zeros(sensors), False
        self._number = 0
        self._verdict: Verdict | None = None
        self._calm, self._alarm_at, self._decided = calm, -inf, deque([-inf])
        self._told: Told | None = None
        self._trouble, self._line = "waiting for the first frame", ""
        self._request: TareRequest = ""
        self._refusal: Refusal = ""
        self._refused_at = -inf

    def add_frame(self, frame: Frame, conversion: UnitConversion) -> None:
        """Add a frame as sent, with the conversion of its values to N."""
        values, valid = conversion(frame.values, frame.valid)
        saturated = np.zeros_like(valid) if frame.saturated is None else frame.saturated & valid
        with self._lock:
            self._number += 1
            self._frames.append((values, saturated))
            self._valid = valid
            self._peak = np.maximum(self._peak, np.where(valid, values, 0.0))

    def set_verdict(
        self, verdict: Verdict | None, trouble: str = "", alarm: bool = False, now: float | None = None
    ) -> None:
        """Set the verdict; or None with the reason and whether an alarm continues.

        Args:
            verdict: made at ``now``.
            trouble: why there is none.
            alarm: whether one continues without a verdict.
            now: s, the host's monotonic clock; None: that of the call.
        """
        now = monotonic() if now is None else now
        with self._lock:
            self._verdict, self._trouble = verdict, trouble
            if verdict is not None:
                if now - self._decided[-1] < _TOGETHER:
                    self._decided.pop()
                self._decided.append(now)
                while now - self._decided[0] > _USUAL:
                    self._decided.popleft()
            alarm = alarm if verdict is None else verdict.dangerous
            self._alarm_at = now if alarm and not self._alarm else self._alarm_at
            self._alarm = alarm
            contact = verdict is not None and verdict.contact is not None
            touched = contact or (verdict is not None and verdict.touched)
            if not self._alarm and (not touched or (contact and not self._contact)):
                # A new touch; its first frames came before the decision.
                recent = [values for values, _ in list(self._frames)[-_ONSET:]]
                self._peak = np.max(recent, axis=0) if contact else np.zeros_like(self._peak)
            self._contact = contact
        self._tell(now)

    def refresh(self, now: float) -> None:
        """Tell the observers if the latest verdict has become too old, or a late alarm ends."""
        if self.told(now) != self._told:
            self._tell(now)

    def _tell(self, now: float) -> None:
        with self._telling:
            self._told = self.told(now)
            for observer in self.observers:
                observer(*self._told)

    def told(self, now: float | None = None) -> Told:
        """Return what is said of the skin at ``now``, s, on the host's monotonic clock; None: of the call."""
        now = monotonic() if now is None else now
        with self._lock:
            alarm = self._alarm or now - self._alarm_at < self._calm
            # A single pause is not usual.
            gaps = sorted(np.diff(self._decided))
            usual = gaps[-2] if len(gaps) > 2 else 0.0
            if self._verdict is None or now - self._decided[-1] > min(_AGE + usual, STALE):
                return None, self._trouble or LATE, alarm
            late = alarm and not self._verdict.dangerous
            return self._verdict.in_alarm if late else self._verdict, "", alarm

    def add_note(self, note: Note) -> None:
        """Add a note on the whole session."""
        with self._lock:
            self.notes = (*(other for other in self.notes if other.code != note.code), note)

    def set_status(self, line: str) -> None:
        """Set the text with rate, lost frames and latency."""
        with self._lock:
            self._line = line

    def request_tare(self, force: bool = False) -> str:
        """Request a new baseline; return why it is refused, or an empty text.

        It is refused while something touches the skin. Within a minute after that it can be forced once, by
        a second and explicit confirmation of the operator; :meth:`state` says so as long.
        """
        with self._lock:
            touched = self._alarm or (self._verdict is not None and self._verdict.contact is not None)
            forced = force and self._refusal == "touched" and monotonic() - self._refused_at <= _CONFIRM
            refused = not forced and (touched or force)
            self._refusal = "" if not refused else "touched" if touched else "unforced"
            if refused:
                event, self._refused_at = "tare_refused", monotonic()
            else:
                event, self._request = ("tare_forced", "forced") if forced else ("tare", "tare")
        _log.warning("%s", REFUSALS[self._refusal] or _TARES[event])
        for listener in self.listeners:
            listener(event)
        return REFUSALS[self._refusal]

    def take_tare(self) -> TareRequest:
        """Return the latest request for a new baseline, once."""
        with self._lock:
            request, self._request = self._request, ""
        return request

    def state(self, since: int | None = None, now: float | None = None) -> DisplayState:
        """Return the state at ``now``, s.

        Args:
            since: the values are the largest after so many frames; None: those of the latest frame.
            now: s, the host's monotonic clock; None: that of the call.
        """
        now = monotonic() if now is None else now
        with self._lock:
            verdict, trouble, alarm = self.told(now)
            fresh = 1 if since is None else min(max(1, self._number - since), len(self._frames))
            latest = [self._frames[-1 - back] for back in range(fresh)]
            refusal = REFUSALS[self._refusal] if now - self._refused_at <= _CONFIRM else ""
            line = ", ".join(filter(None, (refusal, self._line)))
            peak, number, valid = self._peak, self._number, self._valid
        values, saturated = (np.max(part, axis=0) for part in zip(*latest, strict=True))
        readings = np.where(valid, values, 0.0), valid, saturated & valid
        return DisplayState(number, *readings, verdict, line, alarm, peak, *self.describe(verdict, trouble))

    def describe(self, verdict: Verdict | None, trouble: str) -> tuple[tuple[Note, ...], dict[str, Any]]:
        """Return what belongs to a verdict, or to its absence: the notes, the gravest first, and contacts."""
        if verdict is None:
            return order_notes((Note("stale", detail=trouble), *self.notes)), unknown_contacts(trouble)
        return order_notes((*verdict.notes, *self.notes)), self.contacts.state()


_PATIENCE = 0.3  # s for which one read waits
_PROVED = 10.0  # s after the self-test in which sensors may prove dead
_AT_ONCE = 1024  # frames
_STATUS = 0.5  # s between two updates of the status
_ENOUGH = 10  # frames for each one of the model: with n, a tap of one frame reads 1/n too low at worst
_DELAYS = 2000  # verdicts for the percentile of the delay


@contextmanager
def watch_age(display: Display) -> Iterator[None]:
    """Tell the observers of a display while the block runs when its verdict becomes too old."""

    def watch() -> None:
        while not display.closed.wait(_OFTEN):
            display.refresh(monotonic())

    thread = Thread(target=watch, name="skin-age", daemon=True)
    thread.start()
    try:
        yield
    finally:
        display.closed.set()
        thread.join()


class LiveLoop:
    """Classifies the frames of a skin until the recording ends, the time is over, a view closes, or Ctrl-C.

    What it decides depends on the frames alone (:class:`skin.live.engine.Engine`); the load of the
    computer can only delay it.

    Args:
        skin: open.
        tare: gives the conversion of values to N.
        engine: gives verdicts.
        display: shows them.
        before: called once with the conversion, before the first decision; returns the largest number of
            sensors that may prove dead soon after, and the baseline above the stored rest of the device,
            (S,), N, or None. It may raise InputError.

    Attributes:
        verdicts: number of verdicts so far.
    """

    def __init__(
        self,
        skin: Skin,
        tare: Tare,
        engine: Engine,
        display: Display,
        before: Callable[[UnitConversion], tuple[int, np.ndarray | None]] | None = None,
    ) -> None:
        self._skin, self._tare, self._engine, self._display = skin, tare, engine, display
        self._before, self._heard_at = before, monotonic()
        self._most_dead, self._tested_at = inf, 0.0
        self._delays: deque[float] = deque(maxlen=_DELAYS)
        self._updated_at = -np.inf
        self.verdicts = 0

    def run(self, seconds: float | None = None) -> None:
        """Run the loop.

        Args:
            seconds: duration, s; None: no limit.

        Raises:
            InputError: nothing can be read, the stream is too slow, its scale is unknown, or the self-test
                failed.
        """
        until = np.inf if seconds is None else monotonic() + seconds
        while monotonic() < until and not self._display.closed.is_set():
            try:
                frames = self._skin.read(1, _PATIENCE)
            except SkinTimeout as silent:
                self._wait(str(silent).split(": ", 1)[-1])
            except SkinDisconnected:
                return
            else:
                self.take(frames + self._waiting(), monotonic())
            self.update_status(monotonic())

    def update_status(self, now: float) -> None:
        """Show the state of the stream, if it was not shown within half a second before ``now``, s."""
        if now - self._updated_at >= _STATUS:
            self._updated_at = now
            self._display.set_status(self.line)
            if not self._skin.stats.clock_trusted:
                self._display.add_note(Note("clock", detail=self._skin.stats.clock))

    def _wait(self, reason: str) -> None:
        """Show why no frames come, once they are overdue: those of a bridge come in bursts."""
        if monotonic() - self._heard_at >= STALE or self._skin.away:
            self._display.set_verdict(None, reason, self._engine.alarm)

    def _waiting(self) -> list[Frame]:
        """Return the other frames that have arrived."""
        try:
            return self._skin.read(_AT_ONCE, 0.0)
        except (SkinTimeout, SkinDisconnected) as few:
            return few.frames

    def take(self, frames: list[Frame], now: float) -> None:
        """Take frames that have arrived at ``now``, s, and show what follows from them."""
        self._heard_at = now
        if request := self._display.take_tare():
            self._tare.restart(force=request == "forced")
        taken = self._tare.count
        for frame in frames:
            self._tare.add(frame, self._engine.contact or self._engine.alarm)
        conversion = self._tare.conversion
        if conversion is None:
            self._engine.push(frames, None)
            self._display.set_verdict(None, self._tare.status, self._engine.alarm, now)
            return
        if self._tare.count > taken:
            self._engine.reset()
        self._test(conversion, now)
        for frame in frames:
            self._display.add_frame(frame, conversion)
        verdicts = self._engine.push(frames, conversion)
        if self._engine.frozen:
            reason = FROZEN_READINGS[self._engine.frozen]
            self._display.set_verdict(None, reason, self._engine.alarm, now)
            return
        for verdict in verdicts:
            self.verdicts += 1
            if now - verdict.t_host < STALE:
                self._display.set_verdict(verdict, now=now)
            else:
                self._display.set_verdict(None, OLD_READINGS, verdict.dangerous, now)
        if verdicts:
            self._delays.append(monotonic() - verdicts[-1].t_host)
        # After the verdict is shown: it waits for nothing.
        self._display.contacts.look(frames, conversion, verdicts, self._engine.baseline)

    def _test(self, conversion: UnitConversion, now: float) -> None:
        """Test the alarm before the first decision; refuse a skin of which much proves dead soon after."""
        if self._before is not None:
            (self._most_dead, raised), self._before = self._before(conversion), None
            self._engine.reset(raised)
            self._tested_at = now
        dead = [number for number, state in enumerate(self._skin.channels) if state == "dead"]
        if len(dead) > self._most_dead and now - self._tested_at < _PROVED:
            raise InputError(
                f"self-test: {sensor_list(dead)} have never changed and are dead, more than "
                f"{self._most_dead} of {len(self._skin.channels)}: check their wires; live.selftest=false "
                "skips this test"
            )

    @property
    def line(self) -> str:
        """Text with rate, lost frames, broken sensors and delay."""
        stats, enough = self._skin.stats, _ENOUGH * self._engine.window.rate
        slow = f" (short taps read low below {enough:g} Hz)" * (0 < stats.rate_hz < 0.95 * enough)
        counts = stats.list_counts(
            bad_frames="bad", lost="lost", dropped="dropped", resets="restarts", reconnects="reconnected"
        )
        faulty = [
            f"sensor {number} {state}" for number, state in enumerate(self._skin.channels) if state != "ok"
        ]
        parts = [
            self._tare.status if self._tare.conversion is not None else "",
            self._tare.warning,
            f"{stats.rate_hz:.1f} Hz{slow}",
            *counts,
            *faulty[:3],
            f"and {len(faulty) - 3} more" if len(faulty) > 3 else "",
            f"frame to verdict {1e3 * np.percentile(self._delays, 99):.1f} ms (p99)" if self._delays else "",
            stats.trouble,
        ]
        return ", ".join(part for part in parts if part)
