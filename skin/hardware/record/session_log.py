"""Write a session: raw frames as they arrive, and events.

A session is a CSV file that skin calibrate reads too: ``time`` (s since the start), ``seq`` and a column of
raw values per sensor. Lines that start with # are JSON: unit conversion, beginning and end of gestures, gaps,
invalid channels. Unit, layout and start time are in ``x.csv.json``. Whole lines are appended, so the file is
valid up to its last complete frame if the program is interrupted.

The reader skips damaged lines: see :func:`skin.hardware.record.session_reader.read_session`. Events have
checksums, and that which ends a gesture has those of its frames. The line that begins a gesture repeats the
invalid and saturated channels, and refers to the unit conversion by the checksum of its line, so that a lost
line never gives a gesture the baseline of another.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skin import files
from skin.errors import InputError
from skin.hardware.record.line_writer import LineWriter, encode_event, line_sum
from skin.hardware.record.session_reader import read_session, write_about
from skin.hardware.record.stored_session import StoredSession
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion
from skin.wire.segmentation import RecordedGesture


class SessionLog:
    """Writes a session; an existing one is resumed.

    Args:
        path: x.csv.
        about: metadata; a resumed session keeps its own.
        sensors: S.

    Attributes:
        done: numbers of the complete gestures.

    Raises:
        InputError: the file cannot be written, or is not a session of this device, layout, window and rate.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], sensors: int) -> None:
        self._marked: dict[str, list[int]] = {"invalid": [], "saturated": []}
        self._segment, self._anchor = -1, 0.0
        self._sums: list[str] = []  # of the frames since the last beginning of a gesture
        self._conversion_checksum: str | None = None
        header = ",".join(["time", "seq", *(f"raw_{number:02d}" for number in range(sensors))]) + "\n"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            begun = _is_begun(path, header)
            if not begun:
                self._about = dict(about) | {"started_unix": time.time()}
                write_about(self._about, path)
                files.write(header, path)
        except OSError as error:
            raise files.unwritable(path, error, "out=FILE.csv") from error
        self._lines = LineWriter(path)
        try:
            stored = self._resume(path, about) if begun else None
        except BaseException:
            self._lines.close()
            raise
        if stored is not None:
            self._about = stored.about
        self.done = set(stored.gestures) if stored else set()
        self._last = stored.end if stored else -1.0

    def _resume(self, path: Path, about: Mapping[str, Any]) -> StoredSession:
        """Return the existing session."""
        stored = read_session(path)
        check_session(path, stored.about, about)
        # An incomplete last line, after a power cut, would damage the next one.
        self._lines.cut(path.read_bytes().rfind(b"\n") + 1)
        return stored

    def mark(self, event: str, **what: Any) -> None:
        """Write an event before the next frame."""
        self._lines.add(encode_event(event, **what)[0])

    def conversion(self, conversion: UnitConversion) -> None:
        """Write the conversion of the following values to N; its ``zero`` is the baseline."""
        # What a tare tells of the noise is for those who watch.
        arrays = {name: getattr(conversion, name).tolist() for name in ("scale", "zero", "broken")}
        line, self._conversion_checksum = encode_event("meaning", **arrays)
        self._lines.add(line)

    def begin(self, gesture: RecordedGesture, frame: Frame) -> None:
        """Write that the window of a gesture begins at or just before a frame."""
        begin = round(self._time(frame) - (frame.t - gesture.begin), 9)
        known = {"number": gesture.number, "time": begin, "labels": gesture.labels}
        self.mark("begin", **known, meaning=self._conversion_checksum, **self._marked)
        self._sums = []

    def end(self, gesture: RecordedGesture) -> None:
        """Write that a gesture is over, and flush the file to the disk."""
        event, sums = "broken" if gesture.broken else "end", "".join(self._sums)
        self.mark(event, number=gesture.number, lost=gesture.lost, frames=sums)
        self._lines.sync()
        if not gesture.broken:
            self.done.add(gesture.number)

    def frame(self, frame: Frame) -> None:
        """Write a raw frame."""
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
        line = f"{self._last:.9f},{'' if frame.seq is None else frame.seq},{values}"
        self._sums.append(line_sum(line))
        self._lines.add(line)

    @property
    def time(self) -> float:
        """Time of the last frame, s since the start of the session."""
        return self._last

    def close(self) -> None:
        """Close the file."""
        self._lines.close()

    def _time(self, frame: Frame) -> float:
        """Return s since the start of the session, by the device's clock within a segment."""
        if frame.segment != self._segment:
            ago = time.monotonic() - frame.t_host
            self._segment = frame.segment
            self._anchor = time.time() - ago - self._about["started_unix"] - frame.t
            self._anchor = max(self._anchor, self._last + 1e-3 - frame.t)
        return frame.t + self._anchor


def _is_begun(path: Path, header: str) -> bool:
    """Return whether a file has more than a header."""
    if not path.exists():
        return False
    if not path.is_file():
        raise InputError(f"{path} is no regular file: give another out=")
    with path.open("rb") as file:
        return not header.encode().startswith(file.read(len(header) + 1))


def check_session(path: Path, about: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError if a session does not match the configuration or the device."""
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
            f"{now['rate']:g} Hz: give touch.window={window / rate:g} touch.rate={rate:g}"
        )
