"""Send the verdicts of a live view to other programs as JSON lines, and log alarms."""

import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from math import isfinite
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any, Literal, TextIO

from skin.core.files import json_line, unwritable
from skin.errors import InputError
from skin.hardware.live.contacts import unknown_contacts
from skin.hardware.live.loop import Display
from skin.hardware.live.verdict import Verdict, summarize_notes

SCHEMA = 1
"""Version of the messages. A field may be added without a new version; a reader ignores unknown ones."""


def verdict_message(display: Display, verdict: Verdict | None, reason: str, alarm: bool) -> dict[str, Any]:
    """Return a verdict, or the reason why there is none, as JSON data.

    Args:
        display: that tells it.
        verdict: the present one; None if there is none.
        reason: why there is none.
        alarm: an alarm that continues without a verdict.

    Returns:
        The fields of ``docs/export.md`` but ``number`` and ``event``.
    """
    notes = display.list_notes(verdict, reason)
    shared = {
        "schema": SCHEMA,
        "stale": verdict is None,
        "reason": summarize_notes(notes),
        "state": "unknown" if verdict is None else verdict.state,
        "alarm": alarm,
        "dangerous": True if alarm else None if verdict is None else verdict.danger,
        "notes": [note.message for note in notes],
    }
    if verdict is None:
        return shared | {"time": _utc(0.0), "contacts": unknown_contacts(reason)}
    return shared | {
        "time": _utc(monotonic() - verdict.t_host),
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
        "contacts": display.contacts.state(),
    }


def _utc(ago: float) -> str:
    """Return the time some seconds ago, ISO 8601 in UTC."""
    moment = datetime.now(UTC) - timedelta(seconds=ago)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


HEARTBEAT = 0.5  # s without a line after which the state is repeated
_WAITING = 256  # lines for a slow reader; then the oldest is dropped
_LEAVE = 5.0  # s after which a client that reads nothing is left
_TURN = 0.2  # s
_HOST = "127.0.0.1"

Lines = Queue[bytes | None]


class VerdictStream:
    """Numbers messages and hands them to readers, none of which can delay the classification.

    Each verdict is a line. Without verdicts, a line is sent when the reason changes and every ``HEARTBEAT``
    seconds, with ``stale`` true.

    Args:
        display: that tells verdicts.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._lock, self._number, self._readers = Lock(), 0, list[Lines]()
        state = display.state()
        self._state = state.verdict, state.trouble, state.alarm
        self._sent = monotonic()

    def observe(self, verdict: Verdict | None, reason: str, alarm: bool) -> None:
        """Send a verdict, or a new reason for its absence."""
        with self._lock:
            before, self._state = self._state, (verdict, reason, alarm)
            if verdict is not None or before != self._state:
                self._send("verdict" if verdict is not None else "change")

    def beat(self) -> None:
        """Repeat the state if nothing was sent for a while."""
        with self._lock:
            if monotonic() - self._sent >= HEARTBEAT:
                self._send("heartbeat")

    def _send(self, event: str) -> None:
        self._number, self._sent = self._number + 1, monotonic()
        message = {
            "number": self._number,
            "event": event,
            **verdict_message(self._display, *self._state),
        }
        line = (json_line(message) + "\n").encode()
        for lines in self._readers:
            _put(lines, line)

    def join(self, write: Callable[[bytes], object], left: Callable[[], object]) -> Thread:
        """Write the lines from now on in a thread; call ``left`` when they cannot be written any more."""
        lines: Lines = Queue(_WAITING)

        def run() -> None:
            with suppress(OSError, ValueError):  # the reader is gone, or its file is closed
                while (line := lines.get()) is not None:
                    write(line)
            with self._lock:
                self._readers.remove(lines)
            left()

        thread = Thread(target=run, name="skin-verdicts", daemon=True)
        with self._lock:
            self._readers.append(lines)
        thread.start()
        return thread

    def close(self) -> None:
        """End every thread."""
        with self._lock:
            for lines in self._readers:
                _put(lines, None)


def _put(lines: Lines, line: bytes | None) -> None:
    """Put a line into a queue to which no other thread adds; a full one drops its oldest line."""
    if lines.full():
        with suppress(Empty):
            lines.get_nowait()
    lines.put_nowait(line)


@contextmanager
def stream_verdicts(display: Display, where: Literal["stdout"] | int) -> Iterator[str]:
    """Send the verdicts of a display while the block runs; yield where to.

    Args:
        display: its ``closed`` is set when standard output is closed.
        where: ``stdout``, or a TCP port of this machine, 0: any free one.

    Raises:
        InputError: the port is in use or not allowed.
    """
    stream, over = VerdictStream(display), Event()
    display.observers.append(stream.observe)
    beats = Thread(target=_beat, args=(stream, over), name="skin-heartbeat", daemon=True)
    beats.start()
    try:
        if where == "stdout":
            thread = stream.join(_print, display.closed.set)
            yield "standard output"
            stream.close()
            thread.join(1)
        else:
            try:
                listening = socket.create_server((_HOST, where))
            except (OSError, OverflowError) as error:
                raise InputError(
                    f"no verdicts on port {where}: {error}; give live.verdicts=0, or another"
                ) from error
            with listening:
                clients = Thread(
                    target=_accept, args=(listening, stream, over), name="skin-clients", daemon=True
                )
                clients.start()
                yield "tcp://{}:{}".format(*listening.getsockname())
    finally:
        over.set()
        stream.close()


def _print(line: bytes) -> None:
    sys.stdout.buffer.write(line)
    sys.stdout.buffer.flush()


def _beat(stream: VerdictStream, over: Event) -> None:
    while not over.wait(HEARTBEAT / 5):
        stream.beat()


def _accept(listening: socket.socket, stream: VerdictStream, over: Event) -> None:
    listening.settimeout(_TURN)
    with suppress(OSError):  # closed at the end
        while not over.is_set():
            with suppress(TimeoutError):
                client, _ = listening.accept()
                client.settimeout(_LEAVE)
                stream.join(client.sendall, client.close)


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
            message = verdict_message(self._display, *self._state)
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
