"""A session: a folder with the raw frames as they arrived, one Parquet file per gesture.

``about.json`` has unit, layout, rate, window and start. ``gesture_00012.parquet`` has the frames since the
file before it, up to the end of gesture 12; ``frames_000003500.parquet`` has frames, from 3500 ms on, that no
gesture followed. Every frame is in exactly one file.

Columns: ``time`` (s since the start of the session), ``seq``, ``lost``, ``after`` and ``segment`` as in
:class:`skin.device.resampling.Frame`, ``gesture`` (the number, in the frames of its window), ``raw_00`` ...
in the device's unit, and ``state_00`` ..., the sum of ``INVALID`` and ``SATURATED``. JSON in the schema has
number, labels, begin, contacts and unit conversion of the gesture, and its window at the model's rate.

Each file is written whole, with checksums. A damaged one is left out, with the gesture in it.
"""

import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from filelock import FileLock, Timeout

from skin.core import files
from skin.core.safe_loading import json_sum, parse_json, read_parts, write_parquet
from skin.device.calibration import Curves
from skin.device.files import numbered
from skin.device.resampling import Frame, Resampled
from skin.errors import InputError
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import RecordedGesture

INVALID, SATURATED = 1, 2
"""States of a channel in a frame, which are added; 0: neither."""
BAD = (ValueError, LookupError, TypeError, AttributeError)
"""Errors of content that is damaged."""

FORMAT = 3
_KEY = b"skin_gesture"
_STEP = 1e-3  # s at least between the clocks of two segments
_log = logging.getLogger(__name__)
Taken = tuple[RecordedGesture, UnitConversion]
"""A complete gesture, and the conversion of its values to N, whose ``zero`` is the baseline."""


@dataclass(frozen=True)
class StoredSession:
    """Content of a session.

    Attributes:
        metadata: of ``about.json``.
        gestures: by number.
        tables: frames of each file.
        damaged: names of the files that cannot be used.
    """

    metadata: dict[str, Any]
    gestures: dict[int, Taken] = field(default_factory=dict)
    tables: list[pa.Table] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)


def read_session(folder: Path) -> StoredSession:
    """Read a session; warn of damaged files, which are left out.

    Raises:
        InputError: no such folder, or not a session of skin record.
    """
    try:
        metadata, parts = read_parts(folder)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read the session {folder}: {error}: skin record out=FOLDER makes one"
        ) from error
    stored = StoredSession(metadata)
    for path, table in parts.items():
        try:
            stored.gestures.update(_decode(table, path.name, len(metadata["positions"])))
            stored.tables.append(table)
        except BAD:
            stored.damaged.append(path.name)
    if stored.damaged:
        _log.warning("%s: damaged files are left out: %s", folder, ", ".join(stored.damaged))
    return stored


def _decode(table: Any, name: str, sensors: int) -> dict[int, Taken]:
    """Return the gesture in a file by its number, if there is one; an error of BAD if it is damaged."""
    content = parse_json(table.schema.metadata[_KEY])
    if content["file"] != name or not set(numbered("raw", sensors)) <= set(table.column_names):
        raise ValueError("it was renamed, or is of another session")
    if content["number"] is None:
        return {}
    state, contacts = np.array(content["states"]), content["contacts"]
    window = Resampled(np.array(content["values"]), state & INVALID == 0, state & SATURATED > 0)
    gesture = RecordedGesture(
        content["number"],
        content["labels"],
        content["begin"],
        segment=0,
        lost=content["lost"],
        resampled=window,
        contacts=None if contacts is None else np.array(contacts, dtype=float),
    )
    return {gesture.number: (gesture, decode_conversion(content["conversion"]))}


def decode_conversion(content: Mapping[str, Any]) -> UnitConversion:
    """Return the unit conversion in JSON data; an error of BAD if there is none."""
    curves = None if content.get("curves") is None else Curves.of_json(content["curves"])
    scale, zero = (np.array(content[name], dtype=float) for name in ("scale", "zero"))
    return UnitConversion(scale, zero, np.array(content["broken"]), curves=curves)


_SAME = {
    "positions": "with another layout: give it, as in layout.path=FILE.csv",
    "id": "from the device {}, this is {}: give another out=",
    "unit": "in {}, the device sends {}: give another out=",
    "bits": "with {} bits, the device sends {}: give another out=",
}
_UNKNOWN = "unknown (header missing or incomplete)"


def check_session(path: Path, stored: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise InputError if the metadata of a session do not match the configuration or the device."""
    for name, words in _SAME.items():
        if name in now and stored[name] not in (None, now[name]):
            raise InputError(f"{path} was recorded {words.format(stored[name], now[name] or _UNKNOWN)}")
    if stored.get("channels") != now.get("channels"):
        raise InputError(f"{path} was recorded with channels in another order: give another out=")
    window, rate = stored["window"], stored["rate"]
    if (window, rate) != (now["window"], now["rate"]):
        raise InputError(
            f"{path} has windows of {window} frames at {rate:g} Hz, the configuration has {now['window']} at "
            f"{now['rate']:g} Hz: give touch.window={window / rate:g} touch.rate={rate:g}"
        )


def locked(folder: Path) -> AbstractContextManager[Any]:
    """Keep other programs from recording to a folder, within a ``with`` statement and until the process ends.

    The empty file ``.NAME.lock`` that carries the lock stays beside the folder.

    Raises:
        InputError: another program records to it, or the folder around it cannot be written.
    """
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        return FileLock(target.with_name(f".{target.name}.lock")).acquire(timeout=0)
    except Timeout as error:
        raise InputError(
            f"{folder} is being recorded by another process: end that, or give another out="
        ) from error
    except OSError as error:
        raise files.unwritable(folder, error, "out=FOLDER") from error


class SessionLog:
    """Writes a session, which the caller has locked; an existing one is resumed.

    Args:
        folder: of the session.
        metadata: for ``about.json``; a resumed session keeps its own.

    Attributes:
        metadata: of the session.
        done: numbers of the complete gestures.
        time: of the last frame, s since the start of the session.
        frames: since the last file, each with its time.

    Raises:
        InputError: the folder cannot be written, or is not a session of this device, layout, window and rate.
    """

    def __init__(self, folder: Path, metadata: Mapping[str, Any]) -> None:
        self._folder = folder
        self.frames: list[tuple[float, Frame]] = []
        if not folder.exists() or not any(folder.glob("*")):
            files.write(
                files.json_line({**metadata, "sum": json_sum(metadata)}) + "\n", folder / "about.json"
            )
        stored = read_session(folder)
        check_session(folder, stored.metadata, metadata)
        self.metadata, self.done = stored.metadata, set(stored.gestures)
        ends: list[tuple[float, int]] = [
            (table["time"][-1].as_py(), table["segment"][-1].as_py()) for table in stored.tables
        ]
        self.time, last = max(ends, default=(-1.0, -1))
        self._first, self._segment, self._anchor = last + 1, -1, 0.0

    def add(self, frame: Frame, now: float) -> None:
        """Add a frame, which is written with the next gesture.

        Args:
            frame: as the device sent it.
            now: when it arrived, s since the start of the session; its clock counts within a segment.
        """
        if frame.segment != self._segment:
            self._segment, self._anchor = frame.segment, max(now, self.time + _STEP) - frame.t
        # Without a clock of the device, frames that were decoded together have one time.
        self.time = max(round(frame.t + self._anchor, 9), self.time + 1e-6)
        self.frames.append((self.time, frame))

    def write(self, taken: Taken | None = None) -> None:
        """Write the frames since the last file; the last ones are those of a gesture, if one is given.

        Raises:
            InputError: the disk is full or fails; what was written before is kept.
        """
        if not self.frames:
            return
        begin = f"frames_{1000 * self.frames[0][0]:09.0f}"
        name = f"{begin if taken is None else f'gesture_{taken[0].number:05d}'}.parquet"
        content = {"file": name, "number": None} | ({} if taken is None else self._describe(*taken))
        table = self._table(content, 0 if taken is None else len(taken[0].frames))
        path = self._folder / name
        with files.whole(path, "out=FOLDER; the gestures before are kept") as partial:
            write_parquet(table, partial, compression="zstd")
            if path.exists():  # damaged: its gesture was asked for again
                path.replace(path.with_suffix(".damaged"))
        self.frames.clear()
        self.done.update([] if taken is None else [taken[0].number])

    def _describe(self, gesture: RecordedGesture, conversion: UnitConversion) -> dict[str, Any]:
        """Return everything about a gesture but its frames."""
        window, curves, contacts = gesture.resampled, conversion.curves, gesture.contacts
        assert window is not None  # of a complete gesture
        arrays = {name: getattr(conversion, name).tolist() for name in ("scale", "zero", "broken")}
        return {
            "number": gesture.number,
            "labels": gesture.labels,
            "begin": round(self.frames[-len(gesture.frames)][0] + gesture.begin - gesture.frames[0].t, 9),
            "lost": gesture.lost,
            "contacts": None if contacts is None else contacts.tolist(),
            "conversion": arrays | {"curves": None if curves is None else curves.to_json()},
            "values": window.values.tolist(),
            "states": _states(window.valid, window.saturated).tolist(),
        }

    def _table(self, content: Mapping[str, Any], inside: int) -> pa.Table:
        """Return the frames, with their description; the last ``inside`` ones are those of its gesture."""
        time, frames = [t for t, _ in self.frames], [frame for _, frame in self.frames]
        values, valid = (np.stack([getattr(frame, name) for frame in frames]) for name in ("values", "valid"))
        none = np.zeros(values.shape[1], dtype=bool)
        limited = np.stack([none if frame.saturated is None else frame.saturated for frame in frames])
        columns = {
            "time": time,
            "seq": pa.array([frame.seq for frame in frames], pa.int64()),
            "lost": [frame.lost for frame in frames],
            "after": [frame.after for frame in frames],
            "segment": [self._first + frame.segment for frame in frames],
            "gesture": pa.array([None] * (len(frames) - inside) + [content["number"]] * inside, pa.int64()),
        }
        for name, rows in (("raw", values), ("state", _states(valid, limited))):
            columns |= zip(numbered(name, len(none)), rows.T, strict=True)
        return pa.table(columns, metadata={_KEY: files.json_line(content)})


def _states(valid: np.ndarray, saturated: np.ndarray) -> np.ndarray:
    """Return the states of values, int8."""
    return (INVALID * ~valid + SATURATED * saturated).astype(np.int8)
