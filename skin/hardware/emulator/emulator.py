"""The emulated skin: sends gestures to a port in real time."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from threading import Event
from time import monotonic
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from skin.device.base import AbstractSimulated
from skin.hardware.emulator.faults import BANNER, KINDS, Faults
from skin.hardware.emulator.gestures import Converter, Gesture, emulated_gestures, upsample
from skin.hardware.emulator.port import AbstractPort
from skin.rng import Stream, generator
from skin.signal.frame import Check
from skin.wire.announcement import Announcement, encode_announcement
from skin.wire.binary import encode_comment, encode_frame
from skin.wire.segmentation import label_text
from skin.wire.text import Header, encode_header, encode_line

_HEADER = 1.0  # s from one header to the next
_LOOK = 0.05  # s between two checks for a reader


@dataclass(frozen=True, kw_only=True)
class EmulatorSettings:
    """Settings of an emulated skin.

    Attributes:
        rate: of the device, Hz.
        speed: of its clock relative to real time; values other than 1 are for tests.
        bits: of its converter; None: it sends N.
        check: checksum of a line: ``crc16``, ``xor`` or ``none``.
        idle: before the first gesture, s.
        gap: between two windows, s.
        announce: send an announcement before each gesture, in the text format.
        seed: of the gestures and of the faults; the device's own noise follows ``device.seed``.
        id: its name.
    """

    rate: PositiveFloat = 100.0
    speed: PositiveFloat = 1.0
    bits: Annotated[int, Ge(2), Le(16)] | None = 10
    check: Check = "crc16"
    idle: NonNegativeFloat = 3.0
    gap: NonNegativeFloat = 0.5
    announce: bool = True
    seed: NonNegativeInt = 0
    id: str = "emulated"


class Emulator:
    """Sends the gestures of a simulated device, with imperfections and faults, like firmware.

    It waits for the first reader and then sends with or without one.

    Args:
        device: the skin; its gestures have the rate of the model.
        port: the port it sends to.
        settings: rate, converter and format.
        faults: injected faults.
        binary: send COBS frames instead of lines, without announcements.
        on_event: called with the device's time, s, and a message about each event.

    Attributes:
        converter: from N to counts.
        frames: number of frames sent.
    """

    def __init__(
        self,
        device: AbstractSimulated,
        port: AbstractPort,
        settings: EmulatorSettings,
        faults: Faults,
        binary: bool = False,
        on_event: Callable[[float, str], None] = lambda t, text: None,
    ) -> None:
        faults.fits(len(device.sensors))
        self.device, self.port, self.settings, self.faults = device, port, settings, faults
        self.converter = Converter(settings.bits, float(device.constants.clip.max()))
        self._on_event, self.binary, self.frames = on_event, binary, 0
        self._number = self._zero = 0
        self._held: np.ndarray | None = None
        self._silent_until = -1
        self._over = Event()
        self._noise = generator(Stream.NOISE, device.seed, Stream.TEST, 2, settings.seed)
        self._chance = generator(Stream.TEST, 3, settings.seed)
        self._listed = {kind: faults.moments(kind, settings.rate) for kind in KINDS}

    def run(self, seconds: float | None = None, count: int | None = None) -> None:
        """Send until ``count`` gestures or ``seconds`` of device time are over, or until :meth:`stop`."""
        self.await_reader()
        end = None if seconds is None else round(seconds * self.settings.rate)
        self._start = monotonic()
        self._begin()
        for values, gesture in self._pieces(count):
            if gesture is not None:
                self._announce(gesture[0], gesture[1])
            if self._play(values, end):
                return

    def stop(self) -> None:
        """Make :meth:`run` return before its next frame; called from another thread."""
        self._over.set()

    def await_reader(self) -> None:
        """Wait until a reader opens the port."""
        while not self.port.connected() and not self._over.wait(_LOOK):
            pass

    def _pieces(self, count: int | None) -> Iterator[tuple[np.ndarray, tuple[int, Gesture] | None]]:
        """Yield counts at rest, then of each gesture with the gap after it."""
        settings, sensors = self.settings, len(self.device.sensors)
        yield self._felt(np.zeros((round(settings.idle * settings.rate), sensors))), None
        gap = np.zeros((round(settings.gap * settings.rate), sensors))
        for number, gesture in enumerate(islice(emulated_gestures(self.device, settings.seed), count)):
            true = upsample(gesture.force, self.device.model_rate, settings.rate)
            yield self._felt(np.concatenate([true, gap])), (number, gesture)

    def _felt(self, true: np.ndarray) -> np.ndarray:
        """Return the counts for true readings (F, S), N."""
        if len(true) < 2:
            return np.zeros((0, true.shape[1]))
        time = torch.from_numpy((self._number + np.arange(len(true))) / self.settings.rate)
        output = self.device.imperfection.raw(
            torch.from_numpy(true)[None].float(), self.device.constants, self._noise, time
        )
        return self.converter(output[0].double().numpy())

    def _play(self, values: np.ndarray, end: int | None) -> bool:
        """Send frames when they are due; return whether the run is over."""
        rate = self.settings.rate
        chances = {kind: self.faults.happen(kind, len(values), rate, self._chance) for kind in KINDS}
        for place, row in enumerate(values):
            if end is not None and self._number >= end:
                return True
            due = self._start + self._number / (rate * self.settings.speed)
            if self._over.wait(max(0.0, due - monotonic())):
                return True
            for kind in KINDS:
                if chances[kind][place] or self._number in self._listed[kind]:
                    getattr(self, f"_{kind}")()
            if self._number % max(1, round(_HEADER * rate)) == 0:
                self._header()
            self._frame(self._broken(row))
            self._number += 1
        return False

    def _frame(self, row: np.ndarray) -> None:
        seq = self._number - self._zero
        t_us = round(seq * 1e6 / self.settings.rate) % 2**32
        if self.binary:
            # Only counts are whole numbers.
            data = encode_frame(row, seq, t_us, "f32" if self.settings.bits is None else "u16")
        else:
            numbers = row.tolist() if self.settings.bits is None else row.astype(int).tolist()
            data = encode_line(numbers, seq, t_us, self.settings.check)
        self._send(data)
        self.frames += 1

    def _send(self, data: bytes) -> None:
        if self._number >= self._silent_until:
            self.port.write(self.faults.damaged(data, self._chance))

    def _broken(self, row: np.ndarray) -> np.ndarray:
        faults = self.faults
        if self._number < faults.since * self.settings.rate or not (faults.stuck or faults.dead):
            return row
        self._held = row if self._held is None else self._held
        row = row.copy()
        row[list(faults.stuck)] = self._held[list(faults.stuck)]
        row[list(faults.dead)] = 0.0
        return row

    def _begin(self) -> None:
        """Start counting, like a board after power-on."""
        self._zero = self._number
        if self.faults.banner:
            self._send(BANNER)
        self._header()

    def _header(self) -> None:
        settings, unit = self.settings, "N" if self.settings.bits is None else "adc"
        header = Header(1, len(self.device.sensors), settings.rate, unit, settings.bits, settings.id)
        if self.binary:
            self._send(encode_comment(encode_header(header, "none").rstrip()))
        else:
            self._send(encode_header(header, settings.check))

    def _announce(self, number: int, gesture: Gesture) -> None:
        t, frames = self._number / self.settings.rate, len(gesture.force) * self.settings.rate
        self._on_event(t, f"gesture {number}: {label_text(gesture.labels)}")
        if self.settings.announce and not self.binary:
            seq = self._number - self._zero
            self._send(
                encode_announcement(
                    Announcement(number, seq, round(frames / self.device.model_rate), gesture.labels)
                )
            )

    def _silence(self) -> None:
        self._on_event(self._number / self.settings.rate, f"silent for {self.faults.silent:g} s")
        self._silent_until = self._number + round(self.faults.silent * self.settings.rate)

    def _reset(self) -> None:
        self._on_event(self._number / self.settings.rate, "reset")
        self._begin()

    def _unplug(self) -> None:
        """Disconnect and power off; the clock starts from 0 afterwards."""
        self._on_event(self._number / self.settings.rate, f"unplugged for {self.faults.away:g} s")
        self.port.unplug()
        if self._over.wait(self.faults.away / self.settings.speed):
            return
        self.port.plug()
        self._on_event(self._number / self.settings.rate, f"plugged in again: {self.port.address}")
        self._start += self.faults.away / self.settings.speed
        self._begin()
