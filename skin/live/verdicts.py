"""Write the verdicts of a live view as JSON lines for other programs, and log alarms."""

import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from math import isfinite
from pathlib import Path
from threading import Condition, Thread
from time import monotonic
from typing import IO, Any

from skin.core.files import json_line, unwritable
from skin.live.loop import Assessment, Display
from skin.live.verdict import Note, summarize_notes

SCHEMA = 1
"""Version of the messages. A field may be added without a new version; a reader ignores unknown ones."""


def verdict_message(
    assessment: Assessment, notes: Sequence[Note], contacts: dict[str, Any], now: float
) -> dict[str, Any]:
    """Return what is known of the skin as JSON data.

    Args:
        assessment: the present one.
        notes: on the verdict or its absence, the gravest first.
        contacts: what is known of them.
        now: s, the host's monotonic clock.

    Returns:
        The fields of ``docs/export.md`` but ``number`` and ``event``.
    """
    verdict, _, alarm = assessment
    moment = datetime.now(UTC) - timedelta(seconds=0.0 if verdict is None else now - verdict.t_host)
    shared = {
        "schema": SCHEMA,
        "stale": verdict is None,
        "reason": summarize_notes(notes),
        "state": "unknown" if verdict is None else verdict.state,
        "alarm": alarm,
        "dangerous": True if alarm else None if verdict is None else verdict.danger,
        "notes": [note.message for note in notes],
        "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "contacts": contacts,
    }
    if verdict is None:
        return shared
    return shared | {
        "device_time": verdict.t,
        "touched": verdict.touched,
        "labels": verdict.known,
        # JSON has no NaN, and the probabilities of an untouched skin mean nothing.
        "probabilities": {
            name: round(value, 6) if isfinite(value) and verdict.state == "touch" else None
            for name, value in verdict.probabilities.items()
        },
        "contact": verdict.contact,
        "gap": verdict.gap,
        "masked": list(verdict.masked),
        "unknown": list(verdict.unknown),
    }


HEARTBEAT = 0.5
"""s without a line after which the state is repeated."""


class LineQueue:
    """Writes numbered JSON lines in a thread of its own, flushed one by one: a slow reader delays no verdict.

    Args:
        file: open for writing.
        failed: called with the error when the file cannot be written any more, as its reader is gone.
        idle: called when there was no line for ``HEARTBEAT`` s, to add one; None: there is none.
        waiting: lines for a slow reader; then the oldest is dropped.
        ending: s in which a slow reader may take the last lines.
    """

    def __init__(
        self,
        file: IO[str],
        failed: Callable[[Exception], object],
        idle: Callable[[], None] | None = None,
        waiting: int = 256,
        ending: float = 1.0,
    ) -> None:
        self._file, self._failed, self._idle, self._ending = file, failed, idle, ending
        self._changed, self._over, self._number = Condition(), False, 0
        self._waiting: deque[str] = deque(maxlen=waiting)
        self._thread = Thread(target=self._run, name="skin-lines", daemon=True)

    def __enter__(self) -> "LineQueue":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Write the lines that wait, and end."""
        with self._changed:
            self._over = True
            self._changed.notify()
        self._thread.join(self._ending)

    def add(self, message: dict[str, Any]) -> None:
        """Add a line with its number, from 1 up; return at once."""
        with self._changed:
            self._number += 1
            self._waiting.append(json_line({"number": self._number, **message}))
            self._changed.notify()

    def _run(self) -> None:
        try:
            while line := self._next():
                self._file.write(f"{line}\n")
                self._file.flush()
        except (OSError, ValueError) as error:
            self._failed(error)

    def _next(self) -> str:
        """Return the next line; empty at the end."""
        wait = None if self._idle is None else HEARTBEAT
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._waiting or self._over, wait) or self._idle is None:
                    return self._waiting.popleft() if self._waiting else ""
            self._idle()  # without the lock: the display may just be adding a line


def _message(display: Display, assessment: Assessment, event: str, now: float) -> dict[str, Any]:
    return {"event": event, **verdict_message(assessment, *display.describe(assessment, now), now)}


@contextmanager
def write_verdicts(display: Display, file: IO[str]) -> Iterator[None]:
    """Write the verdicts of a display to a file while the block runs.

    Each verdict is a line. Without verdicts, a line is written when the reason changes and every
    ``HEARTBEAT`` seconds, with ``stale`` true.

    Args:
        display: its ``closed`` is set when the reader closes the file.
        file: of a pipe or standard output.
    """
    latest = display.assess(monotonic())

    def observe(assessment: Assessment, now: float, event: str = "") -> None:
        nonlocal latest
        before, latest = latest, assessment
        if assessment.verdict is None and assessment != before:
            event = "change"
        elif assessment.verdict is not None:
            event = event or "verdict"
        if event:
            lines.add(_message(display, assessment, event, now))

    def repeat() -> None:
        now = monotonic()
        observe(display.assess(now), now, "heartbeat")  # the age is judged here, too

    with LineQueue(file, lambda _: display.closed.set(), repeat) as lines:
        display.observers.append(observe)
        yield


@contextmanager
def print_verdicts(display: Display) -> Iterator[None]:
    """Write the verdicts to standard output while the block runs; the display closes with its reader."""
    # A file of its own, and never closed: lines that a reader did not take would fail once more.
    with write_verdicts(display, open(sys.stdout.fileno(), "w", closefd=False)):
        yield


_EVENTS = ("stale", "resumed"), ("alarm", "cleared"), ("unknown", "known")


@contextmanager
def write_changes(
    display: Display, file: IO[str], failed: Callable[[Exception], object], reasons: bool = False
) -> Iterator[None]:
    """Write a line to a file for each change of alarm, state and baseline while the block runs.

    The events are ``started``, ``alarm``, ``cleared``, ``stale``, ``resumed``, ``unknown`` (of a position:
    its sensors have no valid reading), ``known``, ``tare``, ``tare_refused``, ``tare_forced`` and ``ended``.

    Args:
        display: gives the verdicts.
        file: open for writing.
        failed: called with the error when the file cannot be written any more; the live view continues.
        reasons: write a line with the event ``change``, too, when there is another reason for no verdict.
    """
    states, latest = (True, False, False), display.assess(monotonic())

    def observe(assessment: Assessment, now: float) -> None:
        nonlocal states, latest
        before, former, latest, verdict = states, latest.reason, assessment, assessment.verdict
        # Places stay as they were while nothing is known of the skin.
        states = verdict is None, assessment.alarm, before[2] if verdict is None else bool(verdict.unknown)
        for events, previous, state in zip(_EVENTS, before, states, strict=True):
            if state != previous:
                write(events[not state], now)
        if reasons and states == before and assessment.reason != former:
            write("change", now)

    def write(event: str, now: float) -> None:
        lines.add(_message(display, latest, event, now))

    with LineQueue(file, failed) as lines:
        write("started", monotonic())
        display.observers.append(observe)
        display.listeners.append(write)
        try:
            yield
        finally:
            write("ended", monotonic())


@contextmanager
def log_alarms(display: Display, path: Path) -> Iterator[None]:
    """Append the lines of :func:`write_changes` to a file while the block runs.

    If it becomes unwritable, a message says so once.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise unwritable(path, error, "live.log=FILE.jsonl") from error
    warn = partial(print, "the alarm log ends here:", file=sys.stderr)
    try:
        with write_changes(display, file, warn):
            yield
    finally:
        with suppress(OSError):  # of a full disk, which the message has reported
            file.close()
