"""A log file of alarms."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from skin.files import json_line, unwritable
from skin.hardware.live.display import Display
from skin.hardware.live.verdict import Verdict
from skin.hardware.live.verdict_message import verdict_message


class AlarmLog:
    """Appends a JSON line to a file for each change.

    The events are ``alarm``, ``cleared``, ``stale``, ``resumed``, ``unknown`` (of a place: its sensors have
    no valid reading), ``known``, ``tare``, ``tare_refused`` and ``tare_forced``.

    Args:
        file: open for writing. If it becomes unwritable, a message says so once, and the live view continues.
    """

    def __init__(self, file: TextIO) -> None:
        self._file: TextIO | None = file
        self._alarm, self._stale, self._unknown = False, True, False

    def observe(self, verdict: Verdict | None, reason: str, alarm: bool) -> None:
        """Write what has changed since the last call."""
        now, stale = (alarm, True) if verdict is None else (verdict.dangerous, False)
        if stale != self._stale:
            self.write("stale" if stale else "resumed", verdict, reason, alarm)
        if now != self._alarm:
            self.write("alarm" if now else "cleared", verdict, reason, alarm)
        unknown = verdict is not None and bool(verdict.unknown)
        if unknown != self._unknown and not stale:
            self.write("unknown" if unknown else "known", verdict, reason, alarm)
            self._unknown = unknown
        self._alarm, self._stale = now, stale

    def write(
        self, event: str, verdict: Verdict | None = None, reason: str = "", alarm: bool = False
    ) -> None:
        """Write one line."""
        if self._file is None:
            return
        try:
            self._file.write(json_line({"event": event, **verdict_message(verdict, reason, alarm)}) + "\n")
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
    with file:
        log = AlarmLog(file)
        log.write("started")
        display.observers.append(log.observe)
        display.listeners.append(log.write)
        try:
            yield
        finally:
            display.observers.remove(log.observe)
            display.listeners.remove(log.write)
            log.write("ended")
