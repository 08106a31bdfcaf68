"""Write the verdicts of a live view as JSON lines for other programs, and log alarms."""

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from math import isfinite
from pathlib import Path
from threading import Condition, Thread
from time import monotonic
from typing import Any, BinaryIO, TextIO

from skin.core.files import json_line, unwritable
from skin.hardware.live.loop import Display
from skin.hardware.live.verdict import Note, Verdict, summarize_notes

SCHEMA = 1
"""Version of the messages. A field may be added without a new version; a reader ignores unknown ones."""


def verdict_message(
    verdict: Verdict | None, alarm: bool, notes: Sequence[Note], contacts: dict[str, Any]
) -> dict[str, Any]:
    """Return a verdict, or the reason why there is none, as JSON data.

    Args:
        verdict: the present one; None if there is none.
        alarm: including one that continues without a verdict.
        notes: on the verdict or its absence, the gravest first.
        contacts: what is known of them.

    Returns:
        The fields of ``docs/export.md`` but ``number`` and ``event``.
    """
    shared = {
        "schema": SCHEMA,
        "stale": verdict is None,
        "reason": summarize_notes(notes),
        "state": "unknown" if verdict is None else verdict.state,
        "alarm": alarm,
        "dangerous": True if alarm else None if verdict is None else verdict.danger,
        "notes": [note.message for note in notes],
        "time": _utc(0.0 if verdict is None else monotonic() - verdict.t_host),
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
            for name, value in verdict.chances.items()
        },
        "contact": verdict.contact,
        "gap": verdict.gap,
        "masked": list(verdict.masked),
        "unknown": list(verdict.unknown),
    }


def _utc(ago: float) -> str:
    """Return the time some seconds ago, ISO 8601 in UTC."""
    moment = datetime.now(UTC) - timedelta(seconds=ago)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


HEARTBEAT = 0.5  # s without a line after which the state is repeated
_WAITING = 256  # lines for a slow reader; then the oldest is dropped
_ENDING = 1.0  # s in which a slow reader may take the last lines


class VerdictLines:
    """Numbers messages, and writes them in a thread of its own, which cannot delay the classification.

    Each verdict is a line. Without verdicts, a line is written when the reason changes and every
    ``HEARTBEAT`` seconds, with ``stale`` true.

    Args:
        display: that gives verdicts; its ``closed`` is set when the file is closed by its reader.
        file: takes a line at a time.
    """

    def __init__(self, display: Display, file: BinaryIO) -> None:
        self._display, self._file = display, file
        self._changed, self._over, self._number = Condition(), False, 0
        self._waiting: deque[bytes] = deque(maxlen=_WAITING)
        state = display.state()
        self._told = state.verdict, state.trouble, state.alarm

    def observe(self, verdict: Verdict | None, reason: str, alarm: bool) -> None:
        """Add a verdict, or a new reason for its absence."""
        told = verdict, reason, alarm
        with self._changed:
            before, self._told = self._told, told
            if verdict is not None or told != before:
                self._add("change" if verdict is None else "verdict")

    def _add(self, event: str) -> None:
        self._number += 1
        verdict, reason, alarm = self._told
        message = verdict_message(verdict, alarm, *self._display.describe(verdict, reason))
        line = json_line({"number": self._number, "event": event, **message})
        self._waiting.append(f"{line}\n".encode())
        self._changed.notify()

    def run(self) -> None:
        """Write the lines until :meth:`close`, or until nobody reads them."""
        with suppress(OSError, ValueError):  # the reader is gone, or the file is closed
            while line := self._next():
                self._file.write(line)
                self._file.flush()
        self._display.closed.set()

    def _next(self) -> bytes:
        """Return the next line, at the latest a heartbeat; empty at the end."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting or self._over, HEARTBEAT):
                self._add("heartbeat")
            return self._waiting.popleft() if self._waiting else b""

    def close(self) -> None:
        """Let the thread end after the lines that wait."""
        with self._changed:
            self._over = True
            self._changed.notify()


@contextmanager
def write_verdicts(display: Display, file: BinaryIO) -> Iterator[None]:
    """Write the verdicts of a display to a file while the block runs, flushed line by line.

    Args:
        display: its ``closed`` is set when the reader closes the file.
        file: of a pipe or standard output.
    """
    lines = VerdictLines(display, file)
    display.observers.append(lines.observe)
    thread = Thread(target=lines.run, name="skin-verdicts", daemon=True)
    thread.start()
    try:
        yield
    finally:
        display.observers.remove(lines.observe)
        lines.close()
        thread.join(_ENDING)


@contextmanager
def print_verdicts(display: Display) -> Iterator[None]:
    """Write the verdicts to standard output while the block runs; the display closes with its reader."""
    # A file of its own, and never closed: lines that a reader did not take would fail once more.
    with write_verdicts(display, open(sys.stdout.fileno(), "wb", closefd=False)):
        yield


class AlarmLog:
    """Appends a JSON line to a file for each change.

    The events are ``alarm``, ``cleared``, ``stale``, ``resumed``, ``unknown`` (of a place: its sensors have
    no valid reading), ``known``, ``tare``, ``tare_refused`` and ``tare_forced``.

    Args:
        file: open for writing. If it becomes unwritable, a message says so once, and the live view continues.
        display: that tells verdicts.
    """

    def __init__(self, file: TextIO, display: Display) -> None:
        self._file: TextIO | None = file
        self._display = display
        self._alarm, self._stale, self._unknown = False, True, False
        self._state: tuple[Verdict | None, str, bool] = None, "", False

    def observe(self, verdict: Verdict | None, reason: str, alarm: bool) -> None:
        """Write what has changed since the last call."""
        self._state = verdict, reason, alarm
        now, stale = alarm, verdict is None
        if stale != self._stale:
            self.write("stale" if stale else "resumed")
        if now != self._alarm:
            self.write("alarm" if now else "cleared")
        unknown = verdict is not None and bool(verdict.unknown)
        if unknown != self._unknown and not stale:
            self.write("unknown" if unknown else "known")
            self._unknown = unknown
        self._alarm, self._stale = now, stale

    def write(self, event: str) -> None:
        """Write one line with the latest state."""
        if self._file is None:
            return
        try:
            verdict, reason, alarm = self._state
            message = verdict_message(verdict, alarm, *self._display.describe(verdict, reason))
            self._file.write(json_line({"event": event, **message}) + "\n")
            self._file.flush()
        except OSError as error:
            self._file = None
            print(f"the alarm log ends here: {error}", file=sys.stderr)


@contextmanager
def log_alarms(display: Display, path: Path) -> Iterator[None]:
    """Append the alarms of a display to a file while the block runs.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise unwritable(path, error, "live.log=FILE.jsonl") from error
    log = AlarmLog(file, display)
    log.write("started")
    display.observers.append(log.observe)
    display.listeners.append(log.write)
    try:
        yield
    finally:
        display.observers.remove(log.observe)
        display.listeners.remove(log.write)
        log.write("ended")
        with suppress(OSError):  # of a full disk: the log has told of it
            file.close()
