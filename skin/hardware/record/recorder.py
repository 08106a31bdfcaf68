"""Record a session gesture by gesture, and convert it to a recording."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skin.device.base import AbstractWired
from skin.errors import InputError
from skin.hardware.record.lines import locked
from skin.hardware.record.log import Log, Stored, check, read
from skin.recording import join
from skin.storage import write
from skin.wire.conversion import Newtons
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.segmentation import Continuous, Take
from skin.wire.text import Header

_log = logging.getLogger("skin.hardware.record")


def record(
    device: AbstractWired, path: Path, seconds: float | None, free: bool, tell: Callable[[str], None]
) -> None:
    """Write frames until all gestures are done, ``seconds`` are over, or a person ends it.

    Args:
        device: where they come from, and which gestures.
        path: x.csv; one that exists is resumed.
        seconds: of the session, an unplugged skin's too; None: no limit.
        free: whatever is done counts, in windows one after the other.
        tell: says a sentence to the person.

    Raises:
        InputError: another process records to the file, or it cannot be written; what it holds is kept.
    """
    with locked(path):
        _record(device, path, seconds, free, tell)


def _record(
    device: AbstractWired, path: Path, seconds: float | None, free: bool, tell: Callable[[str], None]
) -> None:
    skin, tap = device.open(reconnect=True)
    with skin:
        first, meaning = device.settle(skin)
        log = Log(path, _about(device, skin.header), len(device.sensors))
        try:
            log.meaning(meaning)
            for frame in first:
                log.frame(frame)
            # By the session's time, because the device's begins anew with each start.
            begin = log.time - (first[-1].t - first[0].t)
            if log.done:
                tell(f"{path} has {len(log.done)} gestures: going on")
            director = device.director(tap, meaning, first, log.done)
            if free:
                director = Continuous(director.window, max(log.done, default=-1) + 1)
            wanted = None if free else device.gestures
            for frame in skin:
                take, before = director.take, len(log.done)
                if (done := director.show(frame)) is not None:
                    log.end(done)
                if len(log.done) > before:
                    tell(f"{len(log.done)} of {wanted or 'any'} gestures")
                if director.take is not None and director.take is not take:
                    log.begin(director.take, frame)
                log.frame(frame)
                late = seconds is not None and log.time - begin >= seconds
                if late or director.over or (wanted is not None and len(log.done) >= wanted):
                    return
        except (SkinTimeout, SkinDisconnected) as end:
            tell(str(end))
        finally:
            log.close()


def _about(device: AbstractWired, header: Header | None) -> dict[str, Any]:
    """Return what stands beside a session."""
    return {
        "format": 2,
        "unit": header.unit if header and header.unit else "adc",
        "bits": header.bits if header else None,
        "id": header.id if header else None,
        "started": datetime.now(UTC).isoformat(),
        "positions": device.sensors.positions.tolist(),
        "footprint": list(device.sensors.footprint),
        "size": list(device.size),
        "rate": device.rate,
        "window": device.window,
        "labels": device.labels,
        "calibration": device.calibration,
    }


def finish(device: AbstractWired, path: Path) -> tuple[Path, int]:
    """Write the whole gestures of a session as a recording beside it; return it and how many there are.

    Raises:
        InputError: no session, none whole, or a session of another layout, window, rate or labels.
    """
    stored = read(path)
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.rate}
    check(path, stored.about, now)
    takes = _alike(device.task.names, path, stored)
    whole = join([device.stored([take], meaning) for take, meaning in takes])
    about = stored.about | {"source": "session", "session": path.name, "lost": [one.lost for one, _ in takes]}
    return write(replace(whole, metadata=about), path.with_suffix(".parquet")), len(takes)


def _alike(names: Sequence[str], path: Path, stored: Stored) -> list[tuple[Take, Newtons]]:
    """Return the whole gestures that have the labels, or all that have none where none has some."""
    takes = [stored.takes[number] for number in sorted(stored.takes)]
    if not takes:
        raise InputError(
            "; ".join(
                [
                    f"{path} has {stored.frames} frames and no whole gesture: record some more",
                    *stored.warnings,
                ]
            )
        )
    free = [(take, meaning) for take, meaning in takes if take.labels is None]
    labelled = [
        (replace(take, labels={name: take.labels[name] for name in names}), meaning)
        for take, meaning in takes
        if take.labels is not None and set(take.labels) == set(names)
    ]
    kept = labelled or free
    if not kept:
        found = takes[0][0].labels or {}
        raise InputError(
            f"{path} has the labels {', '.join(found)}, the configuration has {', '.join(names)}: give "
            f"data.stream={str('touch' in found).lower()}"
        )
    if others := len(takes) - len(kept):
        _log.warning("%s: %d gestures without these labels left out", path, others)
    return kept
