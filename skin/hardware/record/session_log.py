"""A session on disk: raw frames as they arrive, and the events between them.

A CSV that skin calibrate reads too: ``time`` (s since the start), ``seq`` and a column of raw
values per sensor. Lines that start with # are JSON: what values mean, where a gesture begins and ends, gaps,
invalid channels. Unit, layout and start time stand in ``x.csv.json``. Lines are only ever added, each in one
piece, so the file is valid up to its last whole frame whatever ends the program.

The reader skips damaged lines: see :func:`skin.hardware.record.session_reader.read_session`. Events have
checksums. The line that begins a gesture repeats the invalid and saturated channels, and refers to the unit
conversion by the checksum of its line, so that a lost line never gives a gesture the baseline of another.
"""

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skin import files
from skin.errors import InputError
from skin.hardware.record.line_writer import LineWriter, encode_event
from skin.hardware.record.session_reader import read_session
from skin.hardware.record.stored_session import StoredSession
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion
from skin.wire.segmentation import RecordedGesture


class SessionLog:
    """A session that is being written; one that exists is resumed.

    Args:
        path: x.csv.
        about: what is written beside it; a resumed session keeps its own.
        sensors: S.

    Attributes:
        done: numbers of the gestures that are whole.

    Raises:
        InputError: the file cannot be written, is no session, or one of another device, layout, window or
            rate.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], sensors: int) -> None:
        self._marked: dict[str, list[int]] = {"invalid": [], "saturated": []}
        self._segment, self._anchor = -1, 0.0
        self._conversion_checksum: str | None = None
        header = ",".join(["time", "seq", *(f"raw_{number:02d}" for number in range(sensors))]) + "\n"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            stored = self._resume(path, about, header)
            self._about = stored.about if stored else dict(about) | {"started_unix": time.time()}
            if stored is None:
                files.write(json.dumps(self._about) + "\n", path.with_name(path.name + ".json"))
                files.write(header, path)
        except OSError as error:
            raise files.unwritable(path, error, "out=FILE.csv") from error
        self._lines = LineWriter(path)
        self.done = set(stored.gestures) if stored else set()
        self._last = stored.end if stored else -1.0

    @staticmethod
    def _resume(path: Path, about: Mapping[str, Any], header: str) -> StoredSession | None:
        """Return what is there; None if that is a header at most."""
        whole = path.read_bytes() if path.exists() else b""
        if header.encode().startswith(whole):
            return None
        stored = read_session(path)
        check_session(path, stored.about, about)
        # What a power cut left of a last line would make the next one wrong.
        os.truncate(path, whole.rfind(b"\n") + 1)
        return stored

    def mark(self, event: str, **what: Any) -> None:
        """Say what happens before the next frame."""
        self._lines.add(encode_event(event, **what)[0])

    def conversion(self, conversion: UnitConversion) -> None:
        """Say what values from now on mean; its ``zero`` is the baseline."""
        said = {name: value.tolist() for name, value in vars(conversion).items()}
        line, self._conversion_checksum = encode_event("meaning", **said)
        self._lines.add(line)

    def begin(self, gesture: RecordedGesture, frame: Frame) -> None:
        """Say that a gesture's window begins at or just before a frame."""
        begin = round(self._time(frame) - (frame.t - gesture.begin), 9)
        known = {"number": gesture.number, "time": begin, "labels": gesture.labels}
        self.mark("begin", **known, meaning=self._conversion_checksum, **self._marked)

    def end(self, gesture: RecordedGesture) -> None:
        """Say that it is over, and let it reach the disk."""
        self.mark("broken" if gesture.broken else "end", number=gesture.number, lost=gesture.lost)
        self._lines.sync()
        if not gesture.broken:
            self.done.add(gesture.number)

    def frame(self, frame: Frame) -> None:
        """Add a frame, raw."""
        if frame.after:
            self.mark("gap", after=frame.after, lost=frame.lost)
        none = np.zeros(len(frame.values), dtype=bool)
        marks = {"invalid": ~frame.valid, "saturated": none if frame.saturated is None else frame.saturated}
        for event, found in marks.items():
            channels = np.flatnonzero(found).tolist()
            if channels != self._marked[event]:
                self.mark(event, channels=channels)
                self._marked[event] = channels
        self._last = self._time(frame)
        values = ",".join(f"{value:.9g}" for value in frame.values.tolist())
        self._lines.add(f"{self._last:.9f},{'' if frame.seq is None else frame.seq},{values}")

    @property
    def time(self) -> float:
        """When the last frame came, s since the session began."""
        return self._last

    def close(self) -> None:
        """Let go of the file."""
        self._lines.close()

    def _time(self, frame: Frame) -> float:
        """Return s since the start of the session, by the device's clock within a segment."""
        if frame.segment != self._segment:
            ago = time.monotonic() - frame.t_host
            self._segment = frame.segment
            self._anchor = time.time() - ago - self._about["started_unix"] - frame.t
            self._anchor = max(self._anchor, self._last + 1e-3 - frame.t)
        return frame.t + self._anchor


def check_session(path: Path, about: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError where a session was recorded otherwise than the configuration or the device is now."""
    differ = {
        name: (about[name], value) for name, value in now.items() if name in about and about[name] != value
    }
    if "positions" in differ:
        raise InputError(f"{path} was recorded with another layout: give it, as in layout.path=FILE.csv")
    for name, words in (("unit", "in {}, the device sends {}"), ("id", "from the device {}, this is {}")):
        if None not in (pair := differ.get(name, (None,))):
            raise InputError(f"{path} was recorded {words.format(*pair)}: give another out=")
    if {"window", "rate"} & set(differ):
        window, rate = about["window"], about["rate"]
        raise InputError(
            f"{path} has windows of {window} frames at {rate:g} Hz, the configuration has {now['window']} at "
            f"{now['rate']:g} Hz: give touch.window={window} device.rate={rate:g}"
        )
