"""The live loop: read frames, classify, and share the state with views."""

import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import inf
from threading import Event, RLock, Thread
from time import monotonic
from typing import Any, Literal

import numpy as np

from skin.device.resampling import Frame
from skin.live.contacts import LiveContacts, unknown_contacts
from skin.live.engine import Engine
from skin.live.verdict import Assessment, Note, Verdict, order_notes, summarize_notes
from skin.wire.channels import NewtonFrame, UnitConversion
from skin.wire.reader import SkinDisconnected, SkinTimeout
from skin.wire.skin import Skin
from skin.wire.tare import Frozen, Tare

_log = logging.getLogger(__name__)


Observer = Callable[[Assessment, float, str], None]
"""Takes an assessment, its time, s, and the operator's event, such as ``tare``, or an empty text; it must
return at once."""

_ONSET = 10  # frames of a touch before its contact is decided
Refusal = Literal["", "touched", "unforced"]
REFUSALS: dict[Refusal, str] = {
    "": "",
    "touched": "tare refused: something touches the skin, or did at the latest tare; if nothing does now, "
    "confirm it (terminal: force and Enter)",
    "unforced": "there is nothing to force",
}
"""Why the latest request for a new baseline was refused, in words."""
TareRequest = Literal["", "tare", "tare_forced"]
"""A request for a new baseline: none, from the next quiet stretch, or from the next frames."""
_TARES: dict[TareRequest, str] = {"tare": "new tare", "tare_forced": "tare forced by the operator"}

STALE = 1.5
"""s without frames after which nothing is known of the skin."""
OLD_READINGS = f"readings are over {STALE:g} s old: the computer, the link or the device's clock is too slow"
LATE = "no decision for longer than usual"
FROZEN_READINGS: dict[Frozen, str] = {
    "still": "readings are frozen: no channel has changed for 5 s",
    "repeated": "readings are frozen: the same frames come again and again",
}


@dataclass(frozen=True)
class DisplayState:
    """State of the live view at one moment.

    Attributes:
        number: of frames so far, to be passed to the next :meth:`Display.state`.
        values: (S,), N, the largest of each sensor since the last call, so that no peak is missed; the limit
            of a saturated sensor, 0 of an invalid one.
        valid: (S,), bool, of the latest frame.
        saturated: (S,), bool, since the last call: the force is at least the value.
        assessment: the latest verdict, None if there is none now; and the alarm.
        line: text with rate, lost frames and latency.
        peak: (S,), N, the largest of each sensor in the touch that the verdict is about; 0 without touch.
        notes: on what may be wrong, the gravest first.
        contacts: what is known of them, as :meth:`skin.inference.posterior.FrameEstimate.to_json` gives it.
        tangential: (S, 2), N along x and y at the latest frame, of sites with three axes; None: unknown.
    """

    number: int
    values: np.ndarray
    valid: np.ndarray
    saturated: np.ndarray
    assessment: Assessment
    line: str
    peak: np.ndarray
    notes: tuple[Note, ...]
    contacts: dict[str, Any]
    tangential: np.ndarray | None = None

    @property
    def reason(self) -> str:
        """The gravest note in words, and the number of the others."""
        return summarize_notes(self.notes)

    @property
    def held(self) -> bool:
        """Whether the verdict is about a touch that has ended, or an alarm is on: the map shows the peak."""
        verdict, _, alarm = self.assessment
        return alarm or (verdict is not None and verdict.touched and verdict.contact is None)


@dataclass(eq=False)
class Display:
    """The latest readings, verdict and status, shared by one writing thread and any number of views.

    A verdict that is older than ``age`` and the usual interval between decisions, or than :data:`STALE`,
    counts as none, whatever the reason. An alarm is shown for ``calm`` s at least, even if it was raised for
    frames that came late.

    Args:
        title: of the run.
        port: source of the frames.
        positions: (S, 3), m; none until the skin is known.
        size: extent (x, y) of the sheet, m.
        top: upper end of the colour scale, N.
        window: length of the classified window, s.
        contacts: tells what is known of them.
        calm: s.
        age: s after which a decision is old where the next is not overdue.
        together: s, decisions of one delivery.
        usual: s over which the usual interval between decisions is taken.
        confirm: s after a refusal in which a tare may be forced.
        kept: frames that are kept for slow views.

    Attributes:
        notes: on the whole session.
        line: text with rate, lost frames and latency.
        closed: event, set at the end.
        observers: called whenever the skin is assessed, and with each event of the operator.
        recent: the latest frames in newtons, for who takes them; by default none is kept.
    """

    title: str
    port: str
    positions: np.ndarray
    size: tuple[float, float]
    top: float
    window: float = 3.0
    contacts: LiveContacts = field(default_factory=LiveContacts)
    calm: float = 2.0
    age: float = 0.5
    together: float = 0.02
    usual: float = 5.0
    confirm: float = 60.0
    kept: int = 8192

    def __post_init__(self) -> None:
        self.closed = Event()
        self.notes: tuple[Note, ...] = ()
        self.observers: list[Observer] = []
        self.recent: deque[NewtonFrame] = deque(maxlen=0)
        self.line = ""
        self._lock, self._number, self._contact, self._void = RLock(), 0, False, False
        self.place(self.positions)
        self._latest = Assessment(None, "waiting for the first frame", False)
        self._alarm_at, self._decided = -inf, deque([-inf])
        self._request: TareRequest = ""
        self._refusal: Refusal = ""
        self._asked_at = -inf

    def place(self, positions: np.ndarray) -> None:
        """Take the positions of the sensors (S, 3), m, before the first frame."""
        sensors = len(positions)
        first = np.zeros(sensors), np.zeros(sensors, dtype=bool)
        with self._lock:
            self._frames: deque[tuple[np.ndarray, np.ndarray]] = deque([first], maxlen=self.kept)
            self._valid, self._peak, self.positions = ~first[1], first[0], positions

    def close(self, *_: object) -> None:
        """Let the loop and the views end."""
        self.closed.set()

    def add(self, readings: NewtonFrame) -> None:
        """Add a frame in newtons."""
        with self._lock:
            self._number += 1
            self.recent.append(readings)
            self._frames.append((readings.newtons, readings.saturated))
            self._valid = readings.usable
            self._peak = np.maximum(self._peak, readings.newtons)

    def set_verdict(self, verdict: Verdict | None, now: float, reason: str = "", alarm: bool = False) -> None:
        """Set the verdict; or None with the reason and whether an alarm continues.

        Args:
            verdict: made at ``now``.
            now: s, the host's monotonic clock.
            reason: why there is none.
            alarm: whether one continues without a verdict.
        """
        with self._lock:
            if verdict is not None:
                alarm = verdict.dangerous
                if now - self._decided[-1] < self.together:
                    self._decided.pop()
                self._decided.append(now)
                while now - self._decided[0] > self.usual:
                    self._decided.popleft()
            self._alarm_at = now if alarm and not self._latest.alarm else self._alarm_at
            self._latest = Assessment(verdict, reason, alarm)
            contact = verdict is not None and verdict.contact is not None
            touched = contact or (verdict is not None and verdict.touched)
            if not alarm and (not touched or (contact and not self._contact)):
                # A new touch; its first frames came before the decision.
                recent = [values for values, _ in list(self._frames)[-_ONSET:]]
                self._peak = np.max(recent, axis=0) if contact else np.zeros_like(self._peak)
            self._contact = contact
            self._void = any(note.code == "void" for note in verdict.notes) if verdict else self._void
            self.refresh(now)

    def refresh(self, now: float, event: str = "") -> None:
        """Inform the observers: the latest verdict may have become too old, a late alarm may end.

        Args:
            now: s, the host's monotonic clock.
            event: of the operator.
        """
        with self._lock:
            assessment = self.assess(now)
            for observer in self.observers:
                observer(assessment, now, event)

    def assess(self, now: float) -> Assessment:
        """Return what is known of the skin at ``now``, s, on the host's monotonic clock."""
        with self._lock:
            verdict, reason, alarm = self._latest
            alarm = alarm or now - self._alarm_at < self.calm
            # A single pause is not usual.
            gaps = sorted(np.diff(self._decided))
            usual = gaps[-2] if len(gaps) > 2 else 0.0
            if verdict is None or now - self._decided[-1] > min(self.age + usual, STALE):
                return Assessment(None, reason or LATE, alarm)
            return Assessment(verdict.in_alarm if alarm and not verdict.dangerous else verdict, "", alarm)

    def add_note(self, note: Note) -> None:
        """Add a note on the whole session."""
        self.notes = (*(other for other in self.notes if other.code != note.code), note)

    def request_tare(self, now: float, force: bool = False) -> str:
        """Request a new baseline at ``now``, s; return why it is refused, or an empty text.

        It is refused while something touches the skin, or did at the latest tare. Within a minute after that
        it can be forced once, by a second and explicit confirmation of the operator; :meth:`state` says so
        as long. Where nothing touches the skin now, the confirmed tare still waits for a quiet stretch.
        """
        with self._lock:
            confirmed = force and self._refusal == "touched" and now - self._asked_at <= self.confirm
            touched = self._latest.alarm or self._contact
            refused: Refusal = "touched" if touched or self._void else "unforced" if force else ""
            self._refusal = "" if confirmed else refused
            request: TareRequest = "tare_forced" if confirmed and touched else "tare"
            self._request, self._asked_at = "" if self._refusal else request, now
            _log.warning("%s", REFUSALS[self._refusal] or _TARES[request])
            self.refresh(now, "tare_refused" if self._refusal else request)
            return REFUSALS[self._refusal]

    def take_tare(self, now: float) -> TareRequest:
        """Return the latest request for a new baseline, once; an old forced one must be confirmed again."""
        with self._lock:
            request, self._request = self._request, ""
            if request == "tare_forced" and now - self._asked_at > STALE:
                self._refusal, self._asked_at, request = "touched", now, ""
                self.refresh(now, "tare_refused")
        return request

    def state(self, now: float, since: int | None = None) -> DisplayState:
        """Return the state.

        Args:
            now: s, the host's monotonic clock.
            since: the values are the largest after so many frames; None: those of the latest frame.
        """
        with self._lock:
            assessment = self.assess(now)
            fresh = 1 if since is None else min(max(1, self._number - since), len(self._frames))
            latest = [self._frames[-1 - back] for back in range(fresh)]
            refusal = REFUSALS[self._refusal] if now - self._asked_at <= self.confirm else ""
            peak, number, valid = self._peak, self._number, self._valid
        values, saturated = (np.max(part, axis=0) for part in zip(*latest, strict=True))
        readings = np.where(valid, values, 0.0), valid, saturated & valid, assessment
        notes = *self.describe(assessment, now), self.contacts.tangential
        return DisplayState(number, *readings, ", ".join(filter(None, (refusal, self.line))), peak, *notes)

    def describe(self, assessment: Assessment, now: float) -> tuple[tuple[Note, ...], dict[str, Any]]:
        """Return what belongs to an assessment: the notes, the gravest first, and contacts."""
        if assessment.verdict is None:
            notes = (Note("stale", detail=assessment.reason), *self.notes)
            return order_notes(notes), unknown_contacts(assessment.reason)
        return order_notes((*assessment.verdict.notes, *self.notes)), self.contacts.state(now)


@contextmanager
def watch_age(display: Display, interval: float = 0.1) -> Iterator[None]:
    """Refresh a display while the block runs: also where the engine hangs, which would tell nothing itself.

    Args:
        display: to be watched.
        interval: s between two refreshes.
    """

    def watch() -> None:
        while not display.closed.wait(interval):
            display.refresh(monotonic())

    thread = Thread(target=watch, name="skin-age", daemon=True)
    thread.start()
    try:
        yield
    finally:
        display.closed.set()
        thread.join()


Verify = Callable[[UnitConversion], np.ndarray | None]
"""Tests a conversion before the first decision. Returns the baseline above the stored rest of the device, N,
(S,), or None; or raises InputError."""


class LiveLoop:
    """Classifies the frames of a skin until the recording ends, the time is over, a view closes, or Ctrl-C.

    What it decides depends on the frames alone (:class:`skin.live.engine.Engine`); the load of the
    computer can only delay it.

    Args:
        skin: open.
        tare: converts frames to N.
        engine: gives verdicts.
        display: shows them.
        verify: called once, before the first decision; None: nothing is tested.
        refine: called between decisions, twice a second: it may change the engine's threshold.
        clock: gives the host's monotonic time, s.
        wait: s that one read waits for a frame.
        at_once: frames that are taken together.
        status: s between two updates of the status.
        enough: frames for each one of the model: with n, a tap of one frame reads 1/n too low at worst.

    Attributes:
        verdicts: number of verdicts so far.
    """

    def __init__(
        self,
        skin: Skin,
        tare: Tare,
        engine: Engine,
        display: Display,
        verify: Verify | None = None,
        refine: Callable[[], object] = bool,
        clock: Callable[[], float] = monotonic,
        wait: float = 0.3,
        at_once: int = 1024,
        status: float = 0.5,
        enough: float = 10.0,
    ) -> None:
        self._skin, self._tare, self._engine, self._display = skin, tare, engine, display
        self._verify, self._clock, self._read_wait, self._at_once = verify, clock, wait, at_once
        self._status, self._enough, self._refine, self._received_at = status, enough, refine, clock()
        self._delays: deque[float] = deque(maxlen=2000)  # verdicts for the percentile of the delay
        self._updated_at = -inf
        self.verdicts = 0

    def run(self, seconds: float | None = None) -> None:
        """Run the loop.

        Args:
            seconds: duration, s; None: no limit.

        Raises:
            InputError: nothing can be read, the stream is too slow, its scale is unknown, or the self-test
                failed.
        """
        until = inf if seconds is None else self._clock() + seconds
        while self._clock() < until and not self._display.closed.is_set():
            try:
                frames = self._skin.read(1, self._read_wait)
            except SkinTimeout as silent:
                self._wait(str(silent).split(": ", 1)[-1])
            except SkinDisconnected:
                return
            else:
                self.take(frames + self._waiting(), self._clock())
            self.update_status(self._clock())

    def update_status(self, now: float) -> None:
        """Show the state of the stream, if it was not shown within half a second before ``now``, s."""
        if now - self._updated_at >= self._status:
            self._updated_at = now
            self._display.line = self.line
            self._refine()
            self._engine.device_rate = self._skin.stats.rate_hz
            if not self._skin.stats.timing.trusted:
                self._display.add_note(Note("clock", detail=self._skin.stats.clock))

    def _wait(self, reason: str) -> None:
        """Show why no frames come, once they are overdue: those of a bridge come in bursts."""
        now = self._clock()
        if now - self._received_at >= STALE or self._skin.away:
            self._display.set_verdict(None, now, reason, self._engine.alarm)

    def _waiting(self) -> list[Frame]:
        """Return the other frames that have arrived."""
        try:
            return self._skin.read(self._at_once, 0.0)
        except (SkinTimeout, SkinDisconnected) as few:
            return few.frames

    def take(self, frames: list[Frame], now: float) -> None:
        """Take frames that have arrived at ``now``, s, and show what follows from them."""
        self._received_at, began = now, self._clock()
        if request := self._display.take_tare(now):
            self._tare.restart(force=request == "tare_forced")
        stream = self._convert(frames)
        if self._tare.conversion is None:
            self._display.set_verdict(None, now, self._tare.status, self._engine.alarm)
            return
        for readings in stream:
            self._display.add(readings)
        self._engine.changed = self._display.contacts.changed
        verdicts = self._engine.push(stream)
        if frozen := self._tare.freshness.frozen:
            self._display.set_verdict(None, now, FROZEN_READINGS[frozen], self._engine.alarm)
            return
        now += self._clock() - began  # a slow machine shows them later than the frames arrived
        for verdict in verdicts:
            self.verdicts += 1
            old = now - verdict.t_host >= STALE
            self._display.set_verdict(None if old else verdict, now, OLD_READINGS * old, verdict.dangerous)
        if verdicts:
            self._delays.append(self._clock() - verdicts[-1].t_host)
        # After the verdict is shown: it waits for nothing.
        self._display.contacts.look(stream, self._tare.conversion, verdicts, self._engine.detector.baseline)

    def _convert(self, frames: list[Frame]) -> list[NewtonFrame]:
        """Return frames in newtons; those before a new baseline are left out."""
        stream = list[NewtonFrame]()
        for frame in frames:
            before = self._tare.conversion
            readings = self._tare.add(frame, self._engine.detector.since is not None or self._engine.alarm)
            if (conversion := self._tare.conversion) is not None and conversion is not before:
                self._begin(conversion)
                stream.clear()
            stream += [] if readings is None else [readings]
        return stream

    def _begin(self, conversion: UnitConversion) -> None:
        """Begin anew with another conversion; test it if it is the first."""
        raised, self._display.contacts.three = None, self._tare.three
        if self._verify is not None:
            raised, self._verify = self._verify(conversion), None
        self._engine.reset(raised, conversion.noise)
        self._engine.remember(self._tare.take_earlier())

    @property
    def line(self) -> str:
        """Text with rate, lost frames, broken sensors and delay."""
        stats, enough = self._skin.stats, self._enough * self._engine.rate
        slow = f" (short taps read low below {enough:g} Hz)" * (0 < stats.rate_hz < 0.95 * enough)
        counts = stats.list_counts(
            bad_frames="bad",
            lost="lost",
            dropped="not read in time",
            resets="restarts",
            reconnects="reconnected",
        )
        faulty = [
            f"sensor {number} {state}" for number, state in enumerate(self._skin.channels) if state != "ok"
        ]
        parts = (
            self._tare.status if self._tare.conversion is not None else "",
            self._tare.warning,
            f"{stats.rate_hz:.1f} Hz{slow}",
            *counts,
            *faulty[:3],
            f"and {len(faulty) - 3} more" if len(faulty) > 3 else "",
            f"frame to verdict {1e3 * np.percentile(self._delays, 99):.1f} ms (p99)" if self._delays else "",
            stats.trouble,
        )
        return ", ".join(filter(None, parts))
