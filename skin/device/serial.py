"""Touches from a real or emulated skin, gesture by gesture."""

import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from skin.signal.calibration import read
from skin.signal.frame import Frame
from skin.signal.resampling import Resampled, Window
from skin.wire.announcement import Tap
from skin.wire.conversion import Newtons, newtons
from skin.wire.detect import Format
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.open import Settings, open_skin
from skin.wire.segmentation import AbstractDirector, Announced, Continuous, Prompted, Take, plan, sentence
from skin.wire.skin import Skin
from skin.wire.source import Source
from skin.wire.tare import Tare, settle
from skin.wire.text import Header
from skin.wire.transport import open_wire

_LABELS = ("announced", "prompted", "none")
_AS_OPENED = ("baudrate", "format", "timeout", "backoff", "silence")


@dataclass(kw_only=True, eq=False)
class Serial(AbstractWired):
    """Yields the gestures that somebody, or the emulator, does on a skin: its only split is ``test``.

    Readings are N without offset: the baseline is taken off, of values that are already reduced, because the
    maximum of noise is not 0.

    Args:
        body: the sheet of the model.
        layout: where its sensors are; the device must send as many values.
        port, baudrate, format, limits, timeout, backoff, silence: as in :func:`skin.wire.open.open_skin`.
        labels: ``announced``, ``prompted`` or ``none``.
        gestures: how many.
        seed: of the order of prompts.
        tare: s.
        trigger: N.
        scale: N per unit.
        calibration: file.
        window: T, frames of the model.
        rate: of the model, Hz; None: 10.
        stream: the labels have ``touch`` too.

    Raises:
        InputError: settings that cannot be used, or a device that does not fit the model.
    """

    body: AbstractBody
    layout: AbstractLayout
    port: str | None = None
    baudrate: int = 115200
    format: Format = "auto"
    labels: str = "announced"
    gestures: int = 16
    seed: int = 0
    tare: float = 2.0
    trigger: float = 0.3
    scale: float | None = None
    calibration: str | None = None
    limits: Sequence[float | None] | None = None
    timeout: float = 10.0
    backoff: Sequence[float] = (1.0, 10.0)
    silence: float | None = 5.0
    window: int = 30
    rate: float | None = None
    stream: bool = False

    def __post_init__(self) -> None:
        if self.labels not in _LABELS:
            raise InputError(f"device.labels must be one of {', '.join(_LABELS)}, got {self.labels}")
        if self.gestures < 1 or not self.tare >= 0:
            raise InputError(f"device.gestures={self.gestures} must be 1 or more, tare={self.tare} 0 or more")
        if self.scale is not None and not self.scale > 0:
            raise InputError(f"device.scale is N per count and must be above 0, got {self.scale}")
        if self.labels == "none" and self.stream:
            raise InputError("labels=none finds windows with a touch: give a run trained without data.stream")
        self._settings: dict[str, Any] = {name: getattr(self, name) for name in _AS_OPENED}
        self._settings["limits"] = None if self.limits is None else tuple(self.limits)
        Settings(**self._settings)  # refuses what cannot be used
        self.rate = 10.0 if self.rate is None else float(self.rate)
        self.task, self.size = TOUCH_OR_NOT if self.stream else TOUCH, self.body.size
        self.sensors = self.layout.sensors(self.body)
        self._positions = torch.from_numpy(self.sensors.positions).float()
        self._recording: Recording | None = None
        self._known = None if self.calibration is None else read(self.calibration)
        if self._known is not None:
            self._known.fits(len(self.sensors))

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the gestures, read when first asked for; labels are None where nobody knows them."""
        return self.recording(split).touches

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the gestures of ``test``, read when first asked for."""
        if split != "test":
            raise InputError(
                f"device=serial has the split test alone, not {split or 'a budget'}: record a session with "
                "skin record, then take device=recording"
            )
        if self._recording is None:
            self._recording = self._record()
        return self._recording

    def blank(self) -> AbstractDevice:
        """Return a device whose touches have the same shape and are 0: a run is restored without a touch."""
        assert self.rate is not None
        empty = torch.zeros(1, self.window, len(self.sensors))
        touches = Touches(empty, empty == 0, self._positions, torch.zeros(1, len(self.task)), self.rate)
        return Blank(self.task, self.size, touches)

    def open(self, reconnect: bool = False) -> tuple[Skin, Tap]:
        """Open the port, and listen to its announcements; ``reconnect`` waits for an unplugged skin."""
        if self.port is None:
            raise InputError("device=serial needs a port, device.port=/dev/ttyACM0; skin emulate makes one")
        tap = Tap(partial(open_wire, self.port, self.baudrate))
        return open_skin(self.port, self.sensors, opener=tap, reconnect=reconnect, **self._settings), tap

    def source(self) -> Source:
        """Open the port, and wait for a skin that is unplugged."""
        skin, _ = self.open(reconnect=True)
        return Source(str(self.port), skin, self.taring(skin))

    def settle(self, skin: Skin) -> tuple[list[Frame], Newtons]:
        """Return the first frames and what values mean: is the device fast enough, what is it untouched?"""
        assert self.rate is not None
        tare = self.taring(skin)
        try:
            frames = settle(skin, tare, self.rate, self.tare, _say)
        except (SkinTimeout, SkinDisconnected) as error:
            raise InputError(f"{self.port}: {error}") from error
        assert tare.newtons is not None
        return frames, tare.newtons

    def taring(self, skin: Skin) -> Tare:
        """Return what finds out what the values of an open skin mean."""
        assert self.rate is not None
        return Tare(self.meaning, self.tare, self.rate, lambda: skin.header)

    def meaning(self, baseline: np.ndarray | None, header: Header | None) -> Newtons:
        """Return what values mean, given a baseline (S,) and what the device tells of itself.

        Raises:
            InputError: nobody knows what a count is worth.
        """
        return newtons(len(self.sensors), baseline, self.scale, self._known, header)

    def director(
        self, tap: Tap, meaning: Newtons, first: Sequence[Frame], done: Collection[int] = ()
    ) -> AbstractDirector:
        """Return what finds the gestures of a stream, as ``labels`` says."""
        assert self.rate is not None
        window = Window(self.window, self.rate, len(self.sensors))
        for frame in first:
            window.add(frame)
        if self.labels == "announced":
            return Announced(window, tap, self.task)
        if self.labels == "none":
            known = np.ones(len(self.sensors), dtype=bool)
            return Continuous(
                window,
                max(done, default=-1) + 1,
                lambda values: bool((meaning(values, known)[0] > self.trigger).any()),
            )
        wanted = enumerate(plan(self.task.names, -(-self.gestures // 2 ** len(self.task)), self.seed))
        return Prompted(
            window, (one for one in wanted if one[0] < self.gestures and one[0] not in done), _say
        )

    def stored(self, takes: Sequence[Take], meaning: Newtons) -> Recording:
        """Return gestures as a recording."""
        touches = self._touches([take.seen for take in takes if take.seen is not None], meaning)
        if takes and takes[0].labels is not None:
            rows = [[float(value) for value in take.labels.values()] for take in takes if take.labels]
            touches = replace(touches, labels=torch.tensor(rows))
        about = {"source": "serial", "lost": [take.lost for take in takes]}
        return Recording(touches, self.task, self.size, self.sensors.footprint, metadata=about)

    def _touches(self, windows: Sequence[Resampled], meaning: Newtons) -> Touches:
        """Return windows in the device's unit as touches."""
        assert self.rate is not None
        readings, valid = meaning(
            np.stack([window.values for window in windows]), np.stack([window.valid for window in windows])
        )
        saturated = valid & np.stack([window.saturated for window in windows])
        known = [torch.from_numpy(values) for values in (readings, valid, saturated)]
        return Touches(known[0], known[1], self._positions, None, self.rate, saturated=known[2])

    def _record(self) -> Recording:
        """Read gestures until there are enough, the skin falls silent, or a person ends it."""
        takes: list[Take] = []
        skin, tap = self.open()
        with skin:
            first, meaning = self.settle(skin)
            director = self.director(tap, meaning, first)
            _say(f"waiting for {self.gestures} gestures, labels {self.labels}")
            for take in self._takes(skin, director):
                takes.append(take)
                words = "" if take.labels is None else f": {sentence(take.labels)}"
                _say(
                    f"{len(takes)}/{self.gestures}{words}" + (f" ({take.lost} frames lost)" * bool(take.lost))
                )
                if len(takes) == self.gestures:
                    break
        if not takes:
            raise InputError("no gesture came: does the emulator announce, does something touch the skin?")
        return self.stored(takes, meaning)

    def _takes(self, skin: Skin, director: AbstractDirector) -> Iterator[Take]:
        try:
            for frame in skin:
                take = director.show(frame)
                if take is not None and take.broken:
                    _say(f"gesture {take.number} broke off: the device started anew")
                elif take is not None:
                    yield take
                if director.over:
                    return
        except (SkinTimeout, SkinDisconnected) as end:
            _say(str(end))


def _say(text: str) -> None:
    """Tell the person at the skin; results go to standard output."""
    print(text, file=sys.stderr, flush=True)
