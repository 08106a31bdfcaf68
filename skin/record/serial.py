"""Touches from a real or emulated skin, gesture by gesture, recorded to a session."""

import logging
import sys
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, time
from typing import Any, Literal

import numpy as np
import torch
from pydantic import PositiveFloat, PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout import AbstractLayout
from skin.core.settings import check_settings, configured
from skin.device.base import AbstractDevice, Blank, Split
from skin.device.files import write_recording
from skin.device.resampling import Frame, Window
from skin.device.touches import Recording, Touches, join_contacts
from skin.errors import InputError
from skin.record.session import FORMAT, SessionLog, StoredSession, Taken, check_session, locked, read_session
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.touch.paths import TouchSettings, model_window
from skin.wire.channels import UnitConversion
from skin.wire.protocol import Announcement, Header
from skin.wire.reader import Port, SkinDisconnected, SkinTimeout
from skin.wire.segmentation import (
    AbstractSegmenter,
    AnnouncedSegmenter,
    ContinuousSegmenter,
    PromptedSegmenter,
    label_plan,
    label_text,
)
from skin.wire.skin import SerialSource, Source, play

_MOST = 6000  # frames without a gesture in memory, a minute at 100 Hz: a killed program loses no more
_log = logging.getLogger(__name__)


def open_source(device: AbstractDevice) -> Source:
    """Open the stream of frames that ``skin live`` watches: of a port, or touches in real time.

    Raises:
        InputError: the stream cannot be opened, or the device has none.
    """
    if isinstance(device, Serial):
        return device.wire.open_source()
    strips = iter(device.strips())
    first = next(strips)
    return Source.in_newtons(device.name, play(chain([first], strips)), first.readings.shape[2])


def require_port(device: AbstractDevice) -> "Serial":
    """Return a device that is a skin at a port.

    Raises:
        InputError: it is another device.
    """
    if not isinstance(device, Serial):
        raise InputError("only a skin at a port can be recorded or checked: leave out device=")
    return device


class Serial(AbstractDevice):
    """Yields gestures on a real or emulated skin; its only split is ``test``.

    Readings are in N above the baseline, which is taken from resampled values, because the maximum of noise
    is not 0.

    Args:
        body: the sheet of the model.
        layout: positions of its sensors; the device must send as many values.
        labels: ``announced``, ``prompted`` or ``none``.
        gestures: number of gestures.
        seed: of the order of prompts.
        trigger: force above which a window begins with ``labels=none``, N; without a tare, which measures the
            noise, also the force above which a prompted gesture is detected.
        touch: rate and window of the model (``conf/touch``).
        stream: add the label ``touch``.
        inwards: the device sends three values for each sensor, along x, y and inwards; the last is used.
        timeout, port, baudrate, tare, ...: as in :class:`skin.wire.reader.Port`.

    Attributes:
        port: its settings.
        wire: the skin at this port.

    Raises:
        InputError: invalid settings, or a device that does not match the model.
    """

    real = True

    def __init__(
        self,
        body: AbstractBody,
        layout: AbstractLayout,
        labels: Literal["announced", "prompted", "none"] = "announced",
        gestures: PositiveInt = 16,
        seed: int = 0,
        trigger: float = 0.3,
        touch: Mapping[str, Any] | TouchSettings | None = None,
        stream: bool = False,
        timeout: PositiveFloat = 10.0,
        inwards: bool = False,
        **port: Any,
    ) -> None:
        chosen = {"labels": labels, "gestures": gestures, "timeout": timeout, "inwards": inwards}
        check_settings(Serial, chosen, "device")
        self.port = configured(Port, port | {"timeout": timeout}, "device")
        self.body, self.labels, self.gestures, self.seed, self.trigger = body, labels, gestures, seed, trigger
        if labels == "none" and stream:
            raise InputError("labels=none finds windows with a touch: give a run trained without data.stream")
        self.window, self.model_rate = model_window(touch)
        self.task, self.size = TOUCH_OR_NOT if stream else TOUCH, body.size
        self.sensors = layout.sensors(body)
        self._positions = torch.from_numpy(self.sensors.positions).float()
        self._recording: Recording | None = None
        self.wire = SerialSource(self.port, len(self.sensors), self.model_rate, body.layers, inwards)

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the gestures, read at the first call; labels are None if unknown."""
        return self.recording(split).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the gestures of ``test``, read at the first call."""
        if split != "test":
            raise InputError(
                f"device=serial has the split test alone, not {split or 'a budget'}: record a session with "
                "skin record, then take device=recording"
            )
        if self._recording is None:
            with TemporaryDirectory() as folder:
                session = Path(folder, "session")
                _print(f"waiting for {self.gestures} gestures, labels {self.labels}")
                if not record_session(self, session, None, False, _print, reconnect=False):
                    raise InputError("no gesture was read: does the emulator announce, is the skin touched?")
                self._recording = read_gestures(self, session)
        return self._recording

    def blank(self) -> AbstractDevice:
        """Return a device with touches of the same shapes that are 0, so that no touch is read."""
        empty = torch.zeros(1, self.window, len(self.sensors))
        touches = Touches(empty, empty == 0, self._positions, torch.zeros(1, len(self.task)), self.model_rate)
        return Blank(self.task, self.size, touches)

    def segmenter(
        self,
        announcements: deque[Announcement],
        conversion: UnitConversion,
        first: Sequence[Frame],
        done: Collection[int] = (),
    ) -> AbstractSegmenter:
        """Return the segmenter of a stream that ``labels`` selects.

        Args:
            announcements: of the skin, that have not been used yet.
            conversion: of the values to N.
            first: frames read before.
            done: numbers of gestures that are already recorded.
        """
        window = Window(self.window, self.model_rate, len(self.sensors))
        for frame in first:
            window.add(frame)
        if self.labels == "announced":
            return AnnouncedSegmenter(window, announcements, self.task)
        if self.labels == "none":
            return ContinuousSegmenter(
                window,
                max(done, default=-1) + 1,
                lambda frame: bool((conversion(frame.values, frame.valid)[0] > self.trigger).any()),
            )
        planned = enumerate(label_plan(self.task.names, -(-self.gestures // 2 ** len(self.task)), self.seed))
        left = (
            (number, labels) for number, labels in planned if number < self.gestures and number not in done
        )
        minimum = self._minimum_response(conversion, first)
        return PromptedSegmenter(
            window, left, _print, lambda seen: bool((conversion(seen.values, seen.valid)[0] > minimum).any())
        )

    def _minimum_response(self, conversion: UnitConversion, first: Sequence[Frame]) -> np.ndarray | float:
        """Return the reading of each sensor (S,), N, that neither its noise nor a count explains."""
        if conversion.noise is None or conversion.rest is None:
            return self.trigger
        whole = all((frame.values % 1 == 0).all() for frame in first)
        # Five standard deviations of a frame: one in three million is more.
        return np.maximum(
            5 * conversion.noise + conversion.rest,
            whole * np.minimum(np.abs(conversion.scale), self.trigger),
        )


def record_session(
    device: Serial,
    path: Path,
    seconds: float | None,
    free: bool,
    notify: Callable[[str], None],
    reconnect: bool = True,
) -> int:
    """Record frames until all gestures are done, ``seconds`` are over, or the user ends it.

    Args:
        device: source of the frames, with the planned gestures.
        path: folder; an existing session is resumed.
        seconds: duration of the session, with disconnections; None: no limit.
        free: record consecutive windows without labels.
        notify: called with each message for the user.
        reconnect: wait for an unplugged skin; else it ends the session.

    Returns:
        The number of complete gestures.

    Raises:
        InputError: another process records to the folder, or it cannot be written; its content is kept.
    """
    with locked(path):
        skin = device.wire.open(reconnect)
        with skin:
            first, conversion = device.wire.warm_up(skin, notify)
            log = SessionLog(path, _describe(device, skin.header))
            for frame in first:
                _add(log, frame)
            # In time of the session, because the device's clock restarts with each session.
            begin = log.frames[0][0]
            if log.done:
                notify(f"{path} has {len(log.done)} gestures: going on")
            segmenter = device.segmenter(skin.announcements, conversion, first, log.done)
            if free:
                segmenter = ContinuousSegmenter(segmenter.window, max(log.done, default=-1) + 1)
            number = None if free else device.gestures
            try:
                for frame in skin:
                    done = segmenter.add(frame)
                    if done is not None and done.number not in log.done:
                        log.write((done, conversion))
                        words = (
                            f"{len(log.done)} of {number} gestures" if number else f"gesture {len(log.done)}"
                        )
                        words += f": {label_text(done.labels)}" if done.labels else ""
                        notify(words + f" ({done.lost} frames lost)" * bool(done.lost))
                    elif segmenter.gesture is None and len(log.frames) >= _MOST:
                        log.write()
                    _add(log, frame)
                    late = seconds is not None and log.time - begin >= seconds
                    if late or segmenter.over or (number is not None and len(log.done) >= number):
                        break
            except (SkinTimeout, SkinDisconnected) as end:
                notify(str(end))
            finally:
                log.write()
    return len(log.done)


def _add(log: SessionLog, frame: Frame) -> None:
    """Add a frame that arrived by the host's clock."""
    log.add(frame, time() - (monotonic() - frame.t_host) - log.metadata["started_unix"])


def _describe(device: Serial, header: Header | None) -> dict[str, Any]:
    """Return the metadata of a session that begins now."""
    channels = list(device.wire.channels)
    return {
        "format": FORMAT,
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


def read_gestures(device: Serial, path: Path) -> Recording:
    """Return the complete gestures of a session, in N.

    Raises:
        InputError: no session, no complete gesture, or another layout, window, rate or labels.
    """
    stored = read_session(path)
    now = {"positions": device.sensors.positions.tolist(), "window": device.window, "rate": device.model_rate}
    check_session(path, stored.metadata, now)
    gestures = _same_labels(device.task.names, path, stored)
    rows = [
        (*conversion(window.values, window.valid), window.saturated)
        for gesture, conversion in gestures
        if (window := gesture.resampled) is not None
    ]
    readings, valid, saturated = (torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))
    labels = [
        [float(gesture.labels[name]) for name in device.task.names]
        for gesture, _ in gestures
        if gesture.labels
    ]
    contacts = [torch.from_numpy(g.contacts)[None].float() for g, _ in gestures if g.contacts is not None]
    if contacts and (unknown := len(gestures) - len(contacts)):
        _log.warning("contacts are left out, unknown of %d of %d gestures", unknown, len(gestures))
    touches = Touches(
        readings,
        valid,
        torch.from_numpy(device.sensors.positions).float(),
        torch.tensor(labels) if labels else None,
        device.model_rate,
        saturated=valid & saturated,
        contacts=join_contacts(contacts) if len(contacts) == len(gestures) else None,
    )
    lost = [gesture.lost for gesture, _ in gestures]
    metadata = stored.metadata | {"source": "session", "session": path.name, "lost": lost}
    return Recording(touches, device.task, device.size, device.sensors.footprint, metadata=metadata)


def convert_session(device: Serial, path: Path) -> tuple[Path, int]:
    """Write the gestures of :func:`read_gestures` as a recording beside a session; return path and number."""
    recording = read_gestures(device, path)
    return write_recording(recording, path.with_name(path.name + ".parquet")), len(recording)


def _same_labels(names: Sequence[str], path: Path, stored: StoredSession) -> list[Taken]:
    """Return the complete gestures with the labels; if no gesture has them, those without labels."""
    gestures = [stored.gestures[number] for number in sorted(stored.gestures)]
    if not gestures:
        frames = sum(map(len, stored.tables))
        raise InputError(f"{path} has {frames} frames and no complete gesture: record some more")
    wanted = set(names)
    usable = [take for take in gestures if take[0].labels is not None and set(take[0].labels) == wanted]
    usable = usable or [take for take in gestures if take[0].labels is None]
    if not usable:
        labels = gestures[0][0].labels or {}
        raise InputError(
            f"{path} has the labels {', '.join(labels)}, the configuration has {', '.join(names)}: give "
            f"data.stream={str('touch' in labels).lower()}"
        )
    if others := len(gestures) - len(usable):
        _log.warning("%s: %d gestures without these labels left out", path, others)
    return usable


def _print(text: str) -> None:
    """Print a message for the user; results go to standard output."""
    print(text, file=sys.stderr, flush=True)
