"""Record a session gesture by gesture, and convert it to a recording."""

import logging
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, time
from typing import Any

import numpy as np

from skin.core.safe_loading import json_sum, parse_json, read_file
from skin.device.files import write_recording
from skin.device.resampling import After, Frame, Window
from skin.device.touches import concatenate
from skin.errors import InputError
from skin.record.serial import Serial, warn_of_contacts
from skin.record.session import (
    BAD,
    SessionLog,
    StoredSession,
    Taken,
    check_session,
    decode_conversion,
    locked,
    read_session,
)
from skin.wire.channels import UnitConversion
from skin.wire.protocol import Header
from skin.wire.reader import SkinDisconnected, SkinTimeout
from skin.wire.segmentation import ContinuousSegmenter, RecordedGesture

_FORMAT = 3
_SUM = ', "sum": "'  # before the checksum of a line of format 2
_MOST = 6000  # frames without a gesture in memory, a minute at 100 Hz: a killed program loses no more
_log = logging.getLogger(__name__)


def record_session(
    device: Serial, path: Path, seconds: float | None, free: bool, notify: Callable[[str], None]
) -> None:
    """Record frames until all gestures are done, ``seconds`` are over, or the user ends it.

    Args:
        device: source of the frames, with the planned gestures.
        path: folder; an existing session is resumed.
        seconds: duration of the session, with disconnections; None: no limit.
        free: record consecutive windows without labels.
        notify: called with each message for the user.

    Raises:
        InputError: another process records to the folder, or it cannot be written; its content is kept.
    """
    with locked(path):
        skin, listener = device.wire.open(reconnect=True)
        with skin:
            first, conversion = device.wire.warm_up(skin, notify)
            log = SessionLog(path, _describe(device, skin.header))
            for frame in first:
                _add(log, frame)
            # In time of the session, because the device's clock restarts with each session.
            begin = log.frames[0][0]
            if log.done:
                notify(f"{path} has {len(log.done)} gestures: going on")
            segmenter = device.segmenter(listener, conversion, first, log.done)
            if free:
                segmenter = ContinuousSegmenter(segmenter.window, max(log.done, default=-1) + 1)
            number = None if free else device.gestures
            try:
                for frame in skin:
                    done = segmenter.add(frame)
                    if done is not None and not done.broken and done.number not in log.done:
                        log.write((done, conversion))
                        notify(f"{len(log.done)} of {number or 'any'} gestures")
                    elif segmenter.gesture is None and len(log.frames) >= _MOST:
                        log.write()
                    _add(log, frame)
                    late = seconds is not None and log.time - begin >= seconds
                    if late or segmenter.over or (number is not None and len(log.done) >= number):
                        return
            except (SkinTimeout, SkinDisconnected) as end:
                notify(str(end))
            finally:
                log.write()


def _add(log: SessionLog, frame: Frame) -> None:
    """Add a frame that arrived by the host's clock."""
    log.add(frame, time() - (monotonic() - frame.t_host) - log.metadata["started_unix"])


def _describe(device: Serial, header: Header | None) -> dict[str, Any]:
    """Return the metadata of a session that begins now."""
    channels = list(device.wire.channels)
    return {
        "format": _FORMAT,
        "unit": header.unit if header and header.unit else "adc",
        "bits": header.bits if header else None,
        "id": header.id if header else None,
        "started": datetime.now(UTC).isoformat(),
        "started_unix": time(),
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
    check_session(path, stored.metadata, now)
    gestures = _same_labels(device.task.names, path, stored)
    warn_of_contacts([gesture for gesture, _ in gestures])
    whole = concatenate([device.to_recording([gesture], conversion) for gesture, conversion in gestures])
    metadata = stored.metadata | {
        "source": "session",
        "session": path.name,
        "lost": [gesture.lost for gesture, _ in gestures],
    }
    target = path.with_name(path.name + ".parquet")
    return write_recording(replace(whole, metadata=metadata), target), len(gestures)


def _same_labels(names: Sequence[str], path: Path, stored: StoredSession) -> list[Taken]:
    """Return the complete gestures with the labels; if no gesture has them, those without labels."""
    gestures = [stored.gestures[number] for number in sorted(stored.gestures)]
    if not gestures:
        frames = sum(map(len, stored.tables))
        raise InputError(f"{path} has {frames} frames and no complete gesture: record some more")
    usable = [
        (replace(gesture, labels={name: gesture.labels[name] for name in names}), conversion)
        for gesture, conversion in gestures
        if gesture.labels is not None and set(gesture.labels) == set(names)
    ] or [(gesture, conversion) for gesture, conversion in gestures if gesture.labels is None]
    if not usable:
        labels = gestures[0][0].labels or {}
        raise InputError(
            f"{path} has the labels {', '.join(labels)}, the configuration has {', '.join(names)}: give "
            f"data.stream={str('touch' in labels).lower()}"
        )
    if others := len(gestures) - len(usable):
        _log.warning("%s: %d gestures without these labels left out", path, others)
    return usable


# Sessions of earlier versions: x.csv, whose lines with # are JSON with a checksum, and x.csv.json.


def convert_old_session(path: Path, folder: Path) -> str:
    """Convert a session of an earlier version to a folder; return what became of it.

    Args:
        path: x.csv, with x.csv.json beside it.
        folder: to be made.

    Raises:
        InputError: not such a session, or the folder exists or cannot be written.
    """
    if folder.exists():
        raise InputError(f"{folder} exists: give another out=")
    try:
        metadata = parse_json(read_file(path.with_name(path.name + ".json")))
        lines = read_file(path).decode("ascii", "replace").split("\n")[1:-1]
        if metadata.pop("sum") != json_sum(metadata) or metadata["format"] != 2:
            raise ValueError("checksum or format beside it are others")
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as parent:
            old = _OldSession(SessionLog(Path(parent) / folder.name, metadata | {"format": _FORMAT}))
            for line in lines:
                old.take(line)
            old.log.write()
            (Path(parent) / folder.name).rename(folder)
    except (OSError, *BAD) as error:
        raise InputError(f"cannot convert {path}, as of an earlier version: {error}") from error
    left = ", ".join(map(str, sorted(old.begun - old.log.done)))
    without = f", without {left}, which are incomplete or damaged" if left else ""
    return f"{folder}: {len(old.log.done)} gestures{without}"


class _OldSession:
    """Goes through the lines of a session; leaves out gestures of which a line is damaged.

    Attributes:
        log: of the new session.
        begun: numbers of all gestures, complete or not.
    """

    def __init__(self, log: SessionLog) -> None:
        self.log, self.begun = log, set[int]()
        about = log.metadata
        self._window = Window(about["window"], about["rate"], len(about["positions"]))
        self._conversions = dict[str, UnitConversion]()  # by the checksums of their lines
        self._marks: dict[str, list[int]] = {"invalid": [], "saturated": []}
        self._taken: Taken | None = None  # the gesture that is going on
        self._after: After = ""
        self._sums, self._segment, self._lost, self._time = "", 0, 0, 0.0

    def take(self, line: str) -> None:
        """Process a line."""
        try:
            if not line.startswith("#"):
                self._frame(line)
            elif line[-10:-2] == _line_sum(line[: -len(_SUM) - 10] + "}"):
                self._event(parse_json(line[1:]))
            else:
                raise ValueError("wrong checksum")
        except InputError:  # of the disk
            raise
        except BAD:
            self._lost, self._taken = self._lost + 1, None

    def _frame(self, line: str) -> None:
        moment, number, *texts = line.split(",")
        t, values = float(moment), np.array(texts, dtype=float)
        if len(values) != self._window.sensors or not np.isfinite([t, *values]).all():
            raise ValueError("no frame")
        invalid, saturated = np.zeros((2, len(values)), dtype=bool)
        invalid[self._marks["invalid"]] = saturated[self._marks["saturated"]] = True
        self._segment, self._time = self._segment + int(t < self._time), t  # of which one is damaged
        polarity = None if self._taken is None else np.where(self._taken[1].scale < 0, -1.0, 1.0)
        frame = Frame(int(number) if number else None, t, t, values, ~invalid, self._segment, self._lost)
        frame = frame._replace(after=self._after, saturated=saturated, polarity=polarity)
        self._lost, self._after = 0, ""
        self._window.add(frame)
        self.log.add(frame, frame.t)
        if self._taken is not None:
            self._taken[0].frames.append(frame)
            self._sums += _line_sum(line)

    def _event(self, content: dict[str, Any]) -> None:
        match content["event"]:
            case "meaning":
                self._conversions[content["sum"]] = decode_conversion(content, self._window.sensors)
                self._segment += 1
            case "begin":
                self._marks |= {name: content[name] for name in self._marks}
                self._sums, number = "", content["number"]
                self.begun.add(number)
                gesture = RecordedGesture(number, content["labels"], content["time"], 0)
                self._taken = gesture, self._conversions[content["meaning"]]
                if contacts := content.get("contacts"):
                    gesture.contacts = np.full((self._window.frames, contacts["most"], 5), nan)
                    for frame, position, *values in contacts["rows"]:
                        gesture.contacts[frame, position] = values
            case "end":
                taken, self._taken = self._taken, None
                stored = content["number"], content["frames"]
                if taken and (taken[0].number, self._sums) == stored and stored[0] not in self.log.done:
                    taken[0].lost, taken[0].resampled = content["lost"], self._window.since(taken[0].begin)
                    self.log.write(taken)
            case "broken":
                self._taken = None
            case "gap":
                self._after, self._lost = content["after"], self._lost + content["lost"]
                self._segment += int(self._after != "gap")
            case mark:
                self._marks[mark] = content["channels"]


def _line_sum(text: str) -> str:
    return f"{zlib.crc32(text.encode()):08x}"
