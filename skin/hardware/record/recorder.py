"""Record a session gesture by gesture, and convert it to a recording."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skin.device.base import AbstractWired
from skin.errors import InputError
from skin.hardware.record.line_writer import locked
from skin.hardware.record.session_log import SessionLog, check_session
from skin.hardware.record.session_reader import read_session
from skin.hardware.record.stored_session import StoredSession
from skin.recording import concatenate
from skin.recording_file import write_recording
from skin.signal.calibration import read_calibration
from skin.wire.conversion import UnitConversion
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.segmentation import ContinuousSegmenter, RecordedGesture
from skin.wire.text import Header

_log = logging.getLogger("skin.hardware.record")


def record_session(
    device: AbstractWired, path: Path, seconds: float | None, free: bool, notify: Callable[[str], None]
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
        _record(device, path, seconds, free, notify)


def _record(
    device: AbstractWired, path: Path, seconds: float | None, free: bool, notify: Callable[[str], None]
) -> None:
    skin, listener = device.open(reconnect=True)
    with skin:
        first, conversion = device.warm_up(skin)
        log = SessionLog(path, _about(device, skin.header), len(device.sensors))
        try:
            log.conversion(conversion)
            for frame in first:
                log.frame(frame)
            # In time of the session, because the device's clock restarts with each session.
            begin = log.time - (first[-1].t - first[0].t)
            if log.done:
                notify(f"{path} has {len(log.done)} gestures: going on")
            segmenter = device.segmenter(listener, conversion, first, log.done)
            if free:
                segmenter = ContinuousSegmenter(segmenter.window, max(log.done, default=-1) + 1)
            wanted = None if free else device.gestures
            for frame in skin:
                gesture, before = segmenter.gesture, len(log.done)
                if (done := segmenter.add(frame)) is not None:
                    log.end(done)
                if len(log.done) > before:
                    notify(f"{len(log.done)} of {wanted or 'any'} gestures")
                if segmenter.gesture is not None and segmenter.gesture is not gesture:
                    log.begin(segmenter.gesture, frame)
                log.frame(frame)
                late = seconds is not None and log.time - begin >= seconds
                if late or segmenter.over or (wanted is not None and len(log.done) >= wanted):
                    return
        except (SkinTimeout, SkinDisconnected) as end:
            notify(str(end))
        finally:
            log.close()


def _about(device: AbstractWired, header: Header | None) -> dict[str, Any]:
    """Return the metadata of a session."""
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
        "calibration": device.calibration,
    } | _channels(device.calibration)


def _channels(calibration: str | None) -> dict[str, Any]:
    """Return the device's channel of every column, where a calibration puts them into another order."""
    channels = () if calibration is None else read_calibration(calibration).channels
    return {"channels": list(channels)} if channels else {}


def convert_session(device: AbstractWired, path: Path) -> tuple[Path, int]:
    """Write the complete gestures of a session as a recording beside it; return its path and their number.

    Raises:
        InputError: no session, no complete gesture, or another layout, window, rate or labels.
    """
    stored = read_session(path)
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(path, stored.about, now)
    gestures = _same_labels(device.task.names, path, stored)
    whole = concatenate([device.to_recording([gesture], conversion) for gesture, conversion in gestures])
    about = stored.about | {
        "source": "session",
        "session": path.name,
        "lost": [one.lost for one, _ in gestures],
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
    kept = labelled or free
    if not kept:
        found = gestures[0][0].labels or {}
        raise InputError(
            f"{path} has the labels {', '.join(found)}, the configuration has {', '.join(names)}: give "
            f"data.stream={str('touch' in found).lower()}"
        )
    if others := len(gestures) - len(kept):
        _log.warning("%s: %d gestures without these labels left out", path, others)
    return kept
