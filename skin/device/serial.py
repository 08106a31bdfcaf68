"""Touches from a real or emulated skin, gesture by gesture."""

import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.device._blank import Blank
from skin.device.base import AbstractDevice, AbstractWired, Split
from skin.errors import InputError
from skin.labels import TOUCH, TOUCH_OR_NOT
from skin.layout.base import AbstractLayout
from skin.recording import Recording, Touches
from skin.signal.frame import Frame
from skin.signal.resampling import Resampled, Window
from skin.touch.gesture import GestureSettings, model_window
from skin.wire.announcement import AnnouncementListener
from skin.wire.conversion import UnitConversion
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.segmentation import (
    AbstractSegmenter,
    AnnouncedSegmenter,
    ContinuousSegmenter,
    PromptedSegmenter,
    RecordedGesture,
    label_plan,
    label_text,
)
from skin.wire.serial_source import SerialSettings, SerialSource
from skin.wire.skin import Skin
from skin.wire.source import Source
from skin.wire.tare import Tare, warm_up
from skin.wire.text import Header

_LABELS = ("announced", "prompted", "none")
_OF_THE_PORT = tuple(one.name for one in fields(SerialSettings))


@dataclass(kw_only=True, eq=False)
class Serial(SerialSettings, AbstractWired):
    """Yields gestures on a real or emulated skin; its only split is ``test``.

    Readings are in N above the baseline, which is taken from resampled values, because the maximum of noise
    is not 0.

    Args:
        body: the sheet of the model.
        layout: positions of its sensors; the device must send as many values.
        port, baudrate, tare, ...: as in :class:`skin.wire.serial_source.SerialSettings`.
        labels: ``announced``, ``prompted`` or ``none``.
        gestures: number of gestures.
        seed: of the order of prompts.
        trigger: force above which a window begins with ``labels=none``, N.
        touch: rate and window of the model (``conf/touch.yaml``).
        stream: add the label ``touch``.

    Raises:
        InputError: invalid settings, or a device that does not match the model.
    """

    body: AbstractBody
    layout: AbstractLayout
    labels: str = "announced"
    gestures: int = 16
    seed: int = 0
    trigger: float = 0.3
    touch: Mapping[str, Any] | GestureSettings | None = None
    stream: bool = False

    def __post_init__(self) -> None:
        if self.labels not in _LABELS:
            raise InputError(f"device.labels must be one of {', '.join(_LABELS)}, got {self.labels}")
        if self.gestures < 1:
            raise InputError(f"device.gestures={self.gestures} must be 1 or more")
        if self.labels == "none" and self.stream:
            raise InputError("labels=none finds windows with a touch: give a run trained without data.stream")
        self.window, self.model_rate = model_window(self.touch)
        self.task, self.size = TOUCH_OR_NOT if self.stream else TOUCH, self.body.size
        self.sensors = self.layout.sensors(self.body)
        self._positions = torch.from_numpy(self.sensors.positions).float()
        self._recording: Recording | None = None
        self._wire = SerialSource(
            sensors=len(self.sensors),
            rate=self.model_rate,
            **{name: getattr(self, name) for name in _OF_THE_PORT},
        )

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

    def open(self, reconnect: bool = False) -> tuple[Skin, AnnouncementListener]:
        """Open the port and collect its announcements; ``reconnect`` waits for an unplugged skin."""
        return self._wire.open(reconnect)

    def source(self) -> Source:
        """Open the port as a stream of frames; wait for an unplugged skin."""
        return self._wire.source()

    def warm_up(self, skin: Skin) -> tuple[list[Frame], UnitConversion]:
        """Read the first frames: check the rate and take the baseline."""
        tare = self.taring(skin)
        try:
            frames = warm_up(skin, tare, self.model_rate, self.tare, _say)
        except (SkinTimeout, SkinDisconnected) as error:
            raise InputError(f"{self.port}: {error}") from error
        assert tare.conversion is not None
        return frames, tare.conversion

    def taring(self, skin: Skin) -> Tare:
        """Return the tare of an open skin."""
        return self._wire.taring(skin)

    def conversion(self, baseline: np.ndarray | None, header: Header | None) -> UnitConversion:
        """Return the conversion of values to N, given a baseline (S,) and the header of the device.

        Raises:
            InputError: the scale is unknown.
        """
        return self._wire.conversion(baseline, header)

    def segmenter(
        self,
        listener: AnnouncementListener,
        conversion: UnitConversion,
        first: Sequence[Frame],
        done: Collection[int] = (),
    ) -> AbstractSegmenter:
        """Return the segmenter that ``labels`` selects."""
        window = Window(self.window, self.model_rate, len(self.sensors))
        for frame in first:
            window.add(frame)
        if self.labels == "announced":
            return AnnouncedSegmenter(window, listener, self.task)
        if self.labels == "none":
            known = np.ones(len(self.sensors), dtype=bool)
            return ContinuousSegmenter(
                window,
                max(done, default=-1) + 1,
                lambda values: bool((conversion(values, known)[0] > self.trigger).any()),
            )
        planned = enumerate(label_plan(self.task.names, -(-self.gestures // 2 ** len(self.task)), self.seed))
        left = (one for one in planned if one[0] < self.gestures and one[0] not in done)
        return PromptedSegmenter(window, left, _say)

    def to_recording(self, gestures: Sequence[RecordedGesture], conversion: UnitConversion) -> Recording:
        """Return gestures as a recording."""
        touches = self._touches([one.resampled for one in gestures if one.resampled is not None], conversion)
        if gestures and gestures[0].labels is not None:
            rows = [[float(value) for value in one.labels.values()] for one in gestures if one.labels]
            touches = replace(touches, labels=torch.tensor(rows))
        about = {"source": "serial", "lost": [gesture.lost for gesture in gestures]}
        return Recording(touches, self.task, self.size, self.sensors.footprint, metadata=about)

    def _touches(self, windows: Sequence[Resampled], conversion: UnitConversion) -> Touches:
        """Return windows in the device's unit as touches."""
        values, mask, saturated = map(np.stack, zip(*(window[:3] for window in windows), strict=True))
        readings, valid = conversion(values, mask)
        known = [torch.from_numpy(array) for array in (readings, valid, valid & saturated)]
        return Touches(known[0], known[1], self._positions, None, self.model_rate, saturated=known[2])

    def _record(self) -> Recording:
        """Read gestures until there are enough, the skin stops sending, or the user ends it."""
        gestures: list[RecordedGesture] = []
        skin, listener = self.open()
        with skin:
            first, conversion = self.warm_up(skin)
            segmenter = self.segmenter(listener, conversion, first)
            _say(f"waiting for {self.gestures} gestures, labels {self.labels}")
            for gesture in self._finished_gestures(skin, segmenter):
                gestures.append(gesture)
                words = "" if gesture.labels is None else f": {label_text(gesture.labels)}"
                lost = f" ({gesture.lost} frames lost)" * bool(gesture.lost)
                _say(f"{len(gestures)}/{self.gestures}{words}{lost}")
                if len(gestures) == self.gestures:
                    break
        if not gestures:
            raise InputError("no gesture was read: does the emulator announce, is the skin touched?")
        return self.to_recording(gestures, conversion)

    def _finished_gestures(self, skin: Skin, segmenter: AbstractSegmenter) -> Iterator[RecordedGesture]:
        try:
            for frame in skin:
                gesture = segmenter.add(frame)
                if gesture is not None and gesture.broken:
                    _say(f"gesture {gesture.number} was interrupted: the device restarted")
                elif gesture is not None:
                    yield gesture
                if segmenter.over:
                    return
        except (SkinTimeout, SkinDisconnected) as end:
            _say(str(end))


def _say(text: str) -> None:
    """Print a message for the user; results go to standard output."""
    print(text, file=sys.stderr, flush=True)
