"""Touches from a real or emulated skin, gesture by gesture."""

import sys
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, Literal

import numpy as np
import torch
from pydantic import PositiveFloat, PositiveInt

from skin.body.base import AbstractBody
from skin.body.layout import AbstractLayout
from skin.core.settings import check_settings, configured
from skin.device.base import AbstractDevice, Blank, Split
from skin.device.resampling import Frame, Window
from skin.device.touches import Recording, Touches, join_contacts
from skin.errors import InputError
from skin.touch.labels import TOUCH, TOUCH_OR_NOT
from skin.touch.paths import TouchSettings, model_window
from skin.wire.channels import UnitConversion
from skin.wire.protocol import Announcement
from skin.wire.reader import Port, SkinDisconnected, SkinTimeout
from skin.wire.segmentation import (
    AbstractSegmenter,
    AnnouncedSegmenter,
    ContinuousSegmenter,
    PromptedSegmenter,
    RecordedGesture,
    label_plan,
    label_text,
)
from skin.wire.skin import SerialSource, Source, play


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
        **port: Any,
    ) -> None:
        chosen = {"labels": labels, "gestures": gestures, "timeout": timeout}
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
        self.wire = SerialSource(self.port, len(self.sensors), self.model_rate, body.layers)

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
            self._recording = self._record()
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
            valid = np.ones(len(self.sensors), dtype=bool)
            return ContinuousSegmenter(
                window,
                max(done, default=-1) + 1,
                lambda values: bool((conversion(values, valid)[0] > self.trigger).any()),
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

    def to_recording(self, gestures: Sequence[RecordedGesture], conversion: UnitConversion) -> Recording:
        """Return gestures as a recording."""
        windows = [gesture.resampled for gesture in gestures if gesture.resampled is not None]
        values, received, saturated = map(np.stack, zip(*(window[:3] for window in windows), strict=True))
        readings, valid = conversion(values, received)
        force, mask, limited = map(torch.from_numpy, (readings, valid, valid & saturated))
        touches = Touches(force, mask, self._positions, None, self.model_rate, saturated=limited)
        if gestures and gestures[0].labels is not None:
            rows = [list(map(float, gesture.labels.values())) for gesture in gestures if gesture.labels]
            touches = replace(touches, labels=torch.tensor(rows))
        contacts = [
            None if gesture.contacts is None else torch.from_numpy(gesture.contacts)[None].float()
            for gesture in gestures
        ]
        touches = replace(touches, contacts=join_contacts(contacts) if contacts else None)
        about = {"source": "serial", "lost": [gesture.lost for gesture in gestures]}
        return Recording(touches, self.task, self.size, self.sensors.footprint, metadata=about)

    def _record(self) -> Recording:
        """Read gestures until there are enough, the skin stops sending, or the user ends it."""
        gestures: list[RecordedGesture] = []
        with self.wire.open() as skin:
            first, conversion = self.wire.warm_up(skin, _print)
            segmenter = self.segmenter(skin.announcements, conversion, first)
            _print(f"waiting for {self.gestures} gestures, labels {self.labels}")
            try:
                for frame in skin:
                    gesture = segmenter.add(frame)
                    if gesture is not None and not gesture.broken:
                        gestures.append(gesture)
                        words = "" if gesture.labels is None else f": {label_text(gesture.labels)}"
                        lost = f" ({gesture.lost} frames lost)" * bool(gesture.lost)
                        _print(f"{len(gestures)}/{self.gestures}{words}{lost}")
                    elif gesture is not None and self.labels != "prompted":  # which says so itself
                        _print(f"gesture {gesture.number} was interrupted: the device restarted")
                    if segmenter.over or len(gestures) == self.gestures:
                        break
            except (SkinTimeout, SkinDisconnected) as end:
                _print(str(end))
        warn_of_contacts(gestures)
        if not gestures:
            raise InputError("no gesture was read: does the emulator announce, is the skin touched?")
        return self.to_recording(gestures, conversion)


def warn_of_contacts(gestures: Sequence[RecordedGesture]) -> None:
    """Warn where the contacts of some gestures are unknown, so that a recording of all has none."""
    unknown = sum(gesture.contacts is None for gesture in gestures)
    if 0 < unknown < len(gestures):
        _print(f"contacts are left out: of {unknown} of {len(gestures)} gestures a line was lost or damaged")


def _print(text: str) -> None:
    """Print a message for the user; results go to standard output."""
    print(text, file=sys.stderr, flush=True)
