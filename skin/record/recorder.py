"""Record a session gesture by gesture, and convert it to a recording."""

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic, time
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from skin.core import files
from skin.core.files import unwritable
from skin.device.files import write_recording
from skin.device.resampling import Frame
from skin.device.touches import concatenate
from skin.errors import InputError
from skin.record.serial import Serial, warn_of_contacts
from skin.record.session import (
    StoredSession,
    describe_contacts,
    encode_event,
    line_sum,
    read_session,
    write_about,
)
from skin.wire.channels import UnitConversion
from skin.wire.protocol import Header
from skin.wire.reader import SkinDisconnected, SkinTimeout
from skin.wire.segmentation import ContinuousSegmenter, RecordedGesture

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]


class LineWriter:
    """Appends lines to a file. A line that does not fit on the disk is removed completely.

    The file itself is locked (not on Windows), because it may have another name, a hard link.

    Args:
        path: of an existing file.

    Raises:
        InputError: the file cannot be written, or another writer has it, whatever it calls it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _input_error(path):
            # Windows would write two bytes for the end of a line.
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            self._size = os.fstat(self._file).st_size
        if fcntl is not None:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(self._file)
                raise _busy(path) from error

    def cut(self, size: int) -> None:
        """Remove what is after the first ``size`` bytes; InputError as below."""
        with _input_error(self._path):
            os.ftruncate(self._file, size)
        self._size = size

    def add(self, text: str) -> None:
        """Add a line.

        Raises:
            InputError: the disk is full or fails; the file then ends with the previous line.
        """
        unwritten = data = text.encode() + b"\n"
        with _input_error(self._path):
            try:
                # Usually one call, so that a killed program has written all of a line or nothing. A nearly
                # full disk accepts a part.
                while unwritten:
                    unwritten = unwritten[os.write(self._file, unwritten) :]
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._file, self._size)
                raise
        self._size += len(data)

    def sync(self) -> None:
        """Flush all lines to the disk; InputError as above."""
        with _input_error(self._path):
            os.fsync(self._file)

    def close(self) -> None:
        """Close the file; InputError as above."""
        with _input_error(self._path):
            os.close(self._file)


@contextmanager
def _input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; its content is kept; make room and run the same "
            "command again"
        ) from error


def _busy(path: Path) -> InputError:
    return InputError(f"{path} is being recorded by another process: end that, or give another out=")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other programs from recording to a file. The lock ends with the process.

    The empty file ``.NAME.lock`` that carries the lock stays beside it.

    Raises:
        InputError: another program records to it, or its folder cannot be written.
    """
    target = path.resolve()
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        if path.is_file():
            LineWriter(path).close()  # refuses at once a file that is being recorded under another name
    except Timeout as error:
        raise _busy(path) from error
    except OSError as error:
        raise unwritable(path, error, "out=FILE.csv") from error
    try:
        yield
    finally:
        lock.release()


class SessionLog:
    """Writes a session; an existing one is resumed.

    Args:
        path: x.csv.
        about: metadata; a resumed session keeps its own.
        sensors: S.

    Attributes:
        done: numbers of the complete gestures.
        time: of the last frame, s since the start of the session.

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
                self._about = dict(about) | {"started_unix": time()}
                write_about(self._about, path)
                files.write(header, path)
        except OSError as error:
            raise files.unwritable(path, error, "out=FILE.csv") from error
        self._lines = LineWriter(path)
        self.done, self.time = set[int](), -1.0
        if not begun:
            return
        try:
            stored = read_session(path)
            check_session(path, stored.about, about)
            # An incomplete last line, after a power cut, would damage the next one.
            self._lines.cut(path.read_bytes().rfind(b"\n") + 1)
        except BaseException:
            self._lines.close()
            raise
        self._about, self.done, self.time = stored.about, set(stored.gestures), stored.end

    def mark(self, event: str, **what: Any) -> None:
        """Write an event before the next frame."""
        self._lines.add(encode_event(event, **what)[0])

    def conversion(self, conversion: UnitConversion) -> None:
        """Write the conversion of the following values to N; its ``zero`` is the baseline."""
        # The noise of a tare is only shown.
        arrays = {name: getattr(conversion, name).tolist() for name in ("scale", "zero", "broken")}
        if conversion.curves is not None:
            arrays["curves"] = conversion.curves.to_json()
        line, self._conversion_checksum = encode_event("meaning", **arrays)
        self._lines.add(line)

    def begin(self, gesture: RecordedGesture, frame: Frame) -> None:
        """Write that the window of a gesture begins at or just before a frame."""
        begin = round(self._time(frame) - (frame.t - gesture.begin), 9)
        about = {"number": gesture.number, "time": begin, "labels": gesture.labels}
        contacts = {} if gesture.contacts is None else {"contacts": describe_contacts(gesture.contacts)}
        self.mark("begin", **about, **contacts, meaning=self._conversion_checksum, **self._marked)
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
        for event, mask in marks.items():
            channels = np.flatnonzero(mask).tolist()
            if channels != self._marked[event]:
                self.mark(event, channels=channels)
                self._marked[event] = channels
        self.time = self._time(frame)
        values = ",".join(f"{value:.9g}" for value in frame.values.tolist())
        line = f"{self.time:.9f},{'' if frame.seq is None else frame.seq},{values}"
        self._sums.append(line_sum(line))
        self._lines.add(line)

    def close(self) -> None:
        """Close the file."""
        self._lines.close()

    def _time(self, frame: Frame) -> float:
        """Return s since the start of the session, by the device's clock within a segment."""
        if frame.segment != self._segment:
            ago = monotonic() - frame.t_host
            self._segment = frame.segment
            self._anchor = time() - ago - self._about["started_unix"] - frame.t
            self._anchor = max(self._anchor, self.time + 1e-3 - frame.t)
        return frame.t + self._anchor


def _is_begun(path: Path, header: str) -> bool:
    """Return whether a file has more than a header."""
    if not path.exists():
        return False
    if not path.is_file():
        raise InputError(f"{path} is not a regular file: give another out=")
    with path.open("rb") as file:
        return not header.encode().startswith(file.read(len(header) + 1))


_SAME = {
    "id": "from the device {}, this is {}",
    "unit": "in {}, the device sends {}",
    "bits": "with {} bits, the device sends {}",
}


def check_session(path: Path, about: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError if a session does not match the configuration or the device."""
    differ = {
        name: (about[name], value) for name, value in now.items() if name in about and about[name] != value
    }
    if "positions" in differ:
        raise InputError(f"{path} was recorded with another layout: give it, as in layout.path=FILE.csv")
    for name, words in _SAME.items():
        stored, found = differ.get(name, (None, None))
        if stored is not None:
            differs = words.format(stored, found or "unknown (header missing or incomplete)")
            raise InputError(f"{path} was recorded {differs}: give another out=")
    if {"window", "rate"} & set(differ):
        window, rate = about["window"], about["rate"]
        raise InputError(
            f"{path} has windows of {window} frames at {rate:g} Hz, the configuration has {now['window']} at "
            f"{now['rate']:g} Hz: give touch.window={window / rate:g} touch.rate={rate:g}"
        )


_log = logging.getLogger(__name__)


def record_session(
    device: Serial, path: Path, seconds: float | None, free: bool, notify: Callable[[str], None]
) -> None:
    """Record frames until all gestures are done, ``seconds`` are over, or the user ends it.

    Args:
        device: source of the frames, with the planned gestures.
        path: x.csv; an existing session is resumed.
        seconds: duration of the session, with disconnections; None: no limit.
        free: record consecutive windows without labels.
        notify: called with each message for the user.

    Raises:
        InputError: another process records to the file, or it cannot be written; its content is kept.
    """
    with locked(path):
        skin = device.wire.open(reconnect=True)
        with skin:
            first, conversion = device.wire.warm_up(skin, notify)
            log = SessionLog(path, _about(device, skin.header), len(device.sensors))
            try:
                log.conversion(conversion)
                for frame in first:
                    log.frame(frame)
                # In time of the session, because the device's clock restarts with each session.
                begin = log.time - (first[-1].t - first[0].t)
                if log.done:
                    notify(f"{path} has {len(log.done)} gestures: going on")
                segmenter = device.segmenter(skin.announcements, conversion, first, log.done)
                if free:
                    segmenter = ContinuousSegmenter(segmenter.window, max(log.done, default=-1) + 1)
                number = None if free else device.gestures
                for frame in skin:
                    gesture, before = segmenter.gesture, len(log.done)
                    if (done := segmenter.add(frame)) is not None:
                        log.end(done)
                    if len(log.done) > before:
                        notify(f"{len(log.done)} of {number or 'any'} gestures")
                    if segmenter.gesture is not None and segmenter.gesture is not gesture:
                        log.begin(segmenter.gesture, frame)
                    log.frame(frame)
                    late = seconds is not None and log.time - begin >= seconds
                    if late or segmenter.over or (number is not None and len(log.done) >= number):
                        return
            except (SkinTimeout, SkinDisconnected) as end:
                notify(str(end))
            finally:
                log.close()


def _about(device: Serial, header: Header | None) -> dict[str, Any]:
    """Return the metadata of a session."""
    channels = list(device.wire.channels)
    return {
        "format": 2,
        "unit": header.unit if header and header.unit else "adc",
        "bits": header.bits if header else None,
        "id": header.id if header else None,
        "started": datetime.now(UTC).isoformat(),
        "positions": device.sensors.positions.tolist(),
        "footprint": list(device.sensors.footprint),
        "size": list(device.size),
        "rate": device.model_rate,
        "window": device.window,
        "labels": device.labels,
        "calibration": device.port.calibration,
    } | ({"channels": channels} if channels else {})


def convert_session(device: Serial, path: Path) -> tuple[Path, int]:
    """Write the complete gestures of a session as a recording beside it; return its path and their number.

    Raises:
        InputError: no session, no complete gesture, or another layout, window, rate or labels.
    """
    stored = read_session(path)
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(path, stored.about, now)
    gestures = _same_labels(device.task.names, path, stored)
    warn_of_contacts([gesture for gesture, _ in gestures])
    whole = concatenate([device.to_recording([gesture], conversion) for gesture, conversion in gestures])
    about = stored.about | {
        "source": "session",
        "session": path.name,
        "lost": [gesture.lost for gesture, _ in gestures],
    }
    return write_recording(replace(whole, metadata=about), path.with_suffix(".parquet")), len(gestures)


def _same_labels(
    names: Sequence[str], path: Path, stored: StoredSession
) -> list[tuple[RecordedGesture, UnitConversion]]:
    """Return the complete gestures with the labels; if no gesture has them, those without labels."""
    gestures = [stored.gestures[number] for number in sorted(stored.gestures)]
    if not gestures:
        raise InputError(
            "; ".join(
                [
                    f"{path} has {stored.frames} frames and no complete gesture: record some more",
                    *stored.warnings,
                ]
            )
        )
    free = [(gesture, conversion) for gesture, conversion in gestures if gesture.labels is None]
    labelled = [
        (replace(gesture, labels={name: gesture.labels[name] for name in names}), conversion)
        for gesture, conversion in gestures
        if gesture.labels is not None and set(gesture.labels) == set(names)
    ]
    usable = labelled or free
    if not usable:
        labels = gestures[0][0].labels or {}
        raise InputError(
            f"{path} has the labels {', '.join(labels)}, the configuration has {', '.join(names)}: give "
            f"data.stream={str('touch' in labels).lower()}"
        )
    if others := len(gestures) - len(usable):
        _log.warning("%s: %d gestures without these labels left out", path, others)
    return usable
