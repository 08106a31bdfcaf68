"""The emulator: a simulated skin at a pseudo-terminal or a TCP port, in real time, with faults."""

import os
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from threading import Event
from time import monotonic, sleep
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Le
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from skin.core.rng import Stream, generator
from skin.device.resampling import Check
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.wire.protocol import (
    EMULATED,
    Announcement,
    Header,
    encode_announcement,
    encode_comment,
    encode_frame,
    encode_header,
    encode_line,
)
from skin.wire.segmentation import label_text


@dataclass(frozen=True)
class Gesture:
    """A simulated gesture.

    Attributes:
        labels: name -> 0 or 1.
        force: true readings, (T, S), N, at the model's rate.
        applied: total force on the skin, (T,), N.
        contacts: (T, K, 5), as of :class:`skin.device.touches.Touches`; None if unknown.
    """

    labels: Mapping[str, int]
    force: np.ndarray
    applied: np.ndarray
    contacts: np.ndarray | None = None


@dataclass(frozen=True)
class Converter:
    """Converts N to counts.

    The middle of the converter is at 0 N and its ends are at twice the clip.

    Attributes:
        bits: of the converter; None: N are sent.
        clip: of the device, N.
    """

    bits: int | None
    clip: float

    @property
    def scale(self) -> float:
        """N per count; 1 if N are sent."""
        return 1.0 if self.bits is None else 2 * self.clip / 2 ** (self.bits - 1)

    def __call__(self, newtons: np.ndarray) -> np.ndarray:
        """Return counts, or N if ``bits`` is None, float64."""
        if self.bits is None:
            return np.asarray(newtons, dtype=np.float64)
        middle = 2 ** (self.bits - 1)
        return np.clip(np.round(middle + newtons / self.scale), 0, 2**self.bits - 1).astype(np.float64)


def emulated_gestures(device: Simulated, seed: int = 0) -> Iterator[Gesture]:
    """Yield touches that are not used for training, balanced in batches of 16."""
    with ThreadPoolExecutor(1, "skin-gestures") as ahead:
        # Drawn while the previous ones are sent, so that there is no pause.
        coming = ahead.submit(_batch, device, seed, 0)
        for number in count(1):
            ready = coming.result()
            coming = ahead.submit(_batch, device, seed, number)
            yield from ready


def gestures_with_labels(device: Simulated, labels: np.ndarray, seed: int = 0) -> list[Gesture]:
    """Return one gesture for each row of labels (B, 4), 0 or 1, in the order of ``TOUCH``."""
    return _draw_gestures(device, labels, generator(Stream.TEST, 5, seed))


def _batch(device: Simulated, seed: int, number: int) -> list[Gesture]:
    draw = generator(Stream.TEST, 2, seed, number)
    return _draw_gestures(device, device.sampler.balanced(16, draw), draw)  # every combination of labels


@torch.no_grad()
def _draw_gestures(device: Simulated, labels: np.ndarray, draw: np.random.Generator) -> list[Gesture]:
    movie = device.sampler.sample(len(labels), draw, labels)
    readings = device.model.respond(movie, displacement=False).readings.double().numpy()
    names, rows, force = device.task.names, movie.labels.int().tolist(), movie.force.double().numpy()
    contacts = [None] * len(movie) if movie.contacts is None else movie.contacts.numpy()
    return [
        Gesture(dict(zip(names, row, strict=True)), *values)
        for row, *values in zip(rows, readings, force, contacts, strict=True)
    ]


def upsample(force: np.ndarray, model_rate: float, rate: float, ramp: float = 0.25) -> np.ndarray:
    """Upsample true readings to the rate of a device; return (F, S), N.

    A frame of the model is held for its interval, with ramps towards smaller neighbours. The maximum over the
    interval is the frame itself, so resampling restores the original frames and no touch becomes longer.

    Args:
        force: (T, S), N.
        model_rate: of ``force``, Hz.
        rate: of the device, Hz.
        ramp: fraction of the interval in which force rises, and falls.
    """
    frames = round(len(force) * rate / model_rate)
    position = (np.arange(frames) + 0.5) * model_rate / rate
    now = np.minimum(position.astype(int), len(force) - 1)
    fraction = (position - now)[:, None]
    padded = np.concatenate([np.zeros_like(force[:1]), force, np.zeros_like(force[:1])])
    level = padded[now + 1]
    before, after = np.minimum(padded[now], level), np.minimum(padded[now + 2], level)
    rising = before + (level - before) * np.clip(fraction / ramp, 0, 1)
    falling = after + (level - after) * np.clip((1 - fraction) / ramp, 0, 1)
    return np.where(fraction < 0.5, rising, falling)


class AbstractPort(ABC):
    """Base class of ports, for one thread.

    Attributes:
        address: value for ``device.port``.
    """

    address: str

    @abstractmethod
    def connected(self) -> bool:
        """Return whether a reader is connected."""

    @abstractmethod
    def unplug(self) -> None:
        """Close the port."""

    @abstractmethod
    def plug(self) -> None:
        """Open the port again at the same address."""

    @abstractmethod
    def _send(self, data: bytes) -> int:
        """Write part of ``data`` without waiting and return its length."""

    def write(self, data: bytes, patience: float = 1.0) -> None:
        """Write; bytes that are not read within ``patience`` s are lost, as without flow control."""
        deadline = monotonic() + patience
        while data and monotonic() < deadline and self.connected():
            try:
                data = data[self._send(data) :]
            except BlockingIOError:
                sleep(0.002)  # until a full buffer is tried again
            except OSError:
                return


def open_port(port: str, link: str | None) -> AbstractPort:
    """Open a port: ``pty``, or ``tcp:NUMBER`` (0: any free number).

    Args:
        port: as above.
        link: symbolic link to the pseudo-terminal, which stays the same after unplugging.

    Raises:
        InputError: an unknown port, a number in use, or a link that cannot be created.
    """
    kind, _, number = port.partition(":")
    if kind == "pty" and not number:
        return _Pty(link)
    if kind == "tcp" and number.isascii() and number.isdigit() and int(number) < 65536:
        if link is not None:
            raise InputError("a TCP port needs no link: leave out link=, or give port=pty")
        return _Tcp(int(number))
    raise InputError(f"port is pty or tcp:NUMBER, got {port}: as in port=tcp:5555")


class _Pty(AbstractPort):
    def __init__(self, link: str | None) -> None:
        self._link, self._master = None if link is None else Path(link).expanduser().absolute(), -1
        self.plug()

    def plug(self) -> None:
        try:
            import tty
        except ImportError as error:  # Windows
            raise InputError(
                "this system has no pseudo-terminals: add port=tcp:5555, and read it with "
                "device.port=socket://127.0.0.1:5555"
            ) from error
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        name = os.ttyname(slave)
        # Opened and closed once, it signals when a reader opens it.
        os.close(slave)
        self.address = str(self._link or name)
        if self._link is None:
            return
        try:
            if self._link.is_symlink() and not self._link.exists():  # left by an emulator that was killed
                self._link.unlink()
            self._link.symlink_to(name)
        except OSError as error:
            raise InputError(
                f"cannot make link={self._link}, which may be in use: {error.strerror}; end the other skin "
                "emulate, or give another name"
            ) from error

    def connected(self) -> bool:
        if self._master < 0:
            return False
        watch = select.poll()
        watch.register(self._master, 0)
        return not any(event & select.POLLHUP for _, event in watch.poll(0))

    def unplug(self) -> None:
        if self._master >= 0:
            if self._link:
                self._link.unlink(missing_ok=True)
            os.close(self._master)
            self._master = -1

    def _send(self, data: bytes) -> int:
        return os.write(self._master, data)


class _Tcp(AbstractPort):
    def __init__(self, number: int) -> None:
        self._number = number
        self.plug()

    def plug(self) -> None:
        try:
            self._server = socket.create_server(("127.0.0.1", self._number))
        except OSError as error:
            raise InputError(f"cannot listen on tcp:{self._number}: {error}; as in port=tcp:0") from error
        self._server.setblocking(False)
        self._number = self._server.getsockname()[1]
        self.address = f"socket://127.0.0.1:{self._number}"
        self._client: socket.socket | None = None

    def connected(self) -> bool:
        try:
            if self._client is None:
                self._client, _ = self._server.accept()
                self._client.setblocking(False)
            elif not self._client.recv(4096):
                raise ConnectionResetError
        except BlockingIOError:  # nobody connects, or nothing was sent to the skin
            pass
        except OSError:  # the reader has left, or the port is unplugged
            if self._client is not None:
                self._client.close()
            self._client = None
        return self._client is not None

    def unplug(self) -> None:
        for end in filter(None, (self._client, self._server)):
            end.close()
        self._client = None

    def _send(self, data: bytes) -> int:
        return self._client.send(data) if self._client else len(data)


BANNER = b"\x00\xff\x00ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET),boot:0x13\r\nentry 0x400805f0\r\n"
"""Boot message of an ESP32 at 115200 baud, after two bytes of noise."""

KINDS = ("silence", "reset", "unplug")
"""Faults that occur at a moment."""

Fraction = Annotated[float, Ge(0), Le(1)]
Often = NonNegativeFloat | Sequence[NonNegativeFloat]


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Rates of faults; all are off by default.

    ``silence``, ``reset`` and ``unplug`` are mean numbers per minute, or lists of times, s since the start
    of the device.

    Attributes:
        flipped_bits: fraction of bits that arrive flipped.
        lost_bytes: fraction of bytes that are lost.
        banner: send the boot message of a board at the start and after each reset and unplugging.
        silence: nothing is sent for ``silent`` s; frame numbers continue.
        reset: frame numbers start from 0 again.
        unplug: the port disappears for ``away`` s.
        silent, away: s.
        stuck: channels, from 0, that repeat their value at ``since``.
        dead: channels that send 0 from ``since`` on.
        since: s.
    """

    flipped_bits: Fraction = 0.0
    lost_bytes: Fraction = 0.0
    banner: bool = False
    silence: Often = 0.0
    reset: Often = 0.0
    unplug: Often = 0.0
    silent: NonNegativeFloat = 2.0
    away: NonNegativeFloat = 2.0
    stuck: Sequence[NonNegativeInt] = ()
    dead: Sequence[NonNegativeInt] = ()
    since: NonNegativeFloat = 0.0

    def fits(self, sensors: int) -> None:
        """Raise InputError if a channel does not exist."""
        for number in (*self.stuck, *self.dead):
            if number >= sensors:
                raise InputError(f"there is no channel {number}: the layout has {sensors} sensors, from 0")

    def happen(
        self, kind: str, first: int, frames: int, rate: float, generator: np.random.Generator
    ) -> np.ndarray:
        """Return in which frames from ``first`` on a fault occurs, (frames,), bool; a rate is drawn."""
        often: float | Sequence[float] = getattr(self, kind)
        if not isinstance(often, int | float):
            return np.isin(first + np.arange(frames), [round(t * rate) for t in often])
        return generator.random(frames) < often / 60 / rate if often else np.zeros(frames, dtype=bool)

    def damaged(self, data: bytes, generator: np.random.Generator) -> bytes:
        """Return bytes with flipped bits and lost bytes."""
        if not self.flipped_bits and not self.lost_bytes:
            return data
        bits = np.unpackbits(np.frombuffer(data, np.uint8))
        bits ^= generator.random(len(bits)) < self.flipped_bits
        arrived = np.packbits(bits)
        return arrived[generator.random(len(arrived)) >= self.lost_bytes].tobytes()


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
        announce: send an announcement before each gesture, with its contacts, in the text format.
        seed: of the gestures and of the faults; the device's own noise follows ``device.seed``.
        id: its name; begins with ``emulated``, else that is put before it.
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
        device: Simulated,
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
        self._probability = generator(Stream.TEST, 3, settings.seed)

    def run(self, seconds: float | None = None, count: int | None = None) -> None:
        """Send until ``count`` gestures or ``seconds`` of device time are over, or until :meth:`stop`."""
        while not self.port.connected() and not self._over.wait(0.05):
            pass
        end = None if seconds is None else round(seconds * self.settings.rate)
        self._start = monotonic()
        self._begin()
        for values in self._pieces(count):
            if self._play(values, end):
                return

    def stop(self) -> None:
        """Make :meth:`run` return before its next frame; called from another thread."""
        self._over.set()

    def _pieces(self, count: int | None) -> Iterator[np.ndarray]:
        """Yield counts at rest, then of each gesture with the gap after it, once it is announced."""
        settings, sensors = self.settings, len(self.device.sensors)
        yield self._convert_to_counts(np.zeros((round(settings.idle * settings.rate), sensors)))
        gap = np.zeros((round(settings.gap * settings.rate), sensors))
        for number, gesture in enumerate(islice(emulated_gestures(self.device, settings.seed), count)):
            true = upsample(gesture.force, self.device.model_rate, settings.rate)
            values = self._convert_to_counts(np.concatenate([true, gap]))
            self._announce(number, gesture)
            yield values

    def _convert_to_counts(self, true: np.ndarray) -> np.ndarray:
        """Return the counts for true readings (F, S), N."""
        if len(true) < 2:
            return np.zeros((0, true.shape[1]))
        time = torch.from_numpy((self._number + np.arange(len(true))) / self.settings.rate)
        output = self.device.imperfection.raw(
            torch.from_numpy(true)[None].float(), self.device.constants, self._noise, time
        )
        return self.converter(output[0].double().numpy() * self.device.imperfection.signs(true.shape[1]))

    def _play(self, values: np.ndarray, end: int | None) -> bool:
        """Send frames when they are due; return whether the run is over."""
        rate = self.settings.rate
        happen = self.faults.happen
        faults = {kind: happen(kind, self._number, len(values), rate, self._probability) for kind in KINDS}
        for position, row in enumerate(values):
            if end is not None and self._number >= end:
                return True
            due = self._start + self._number / (rate * self.settings.speed)
            if self._over.wait(max(0.0, due - monotonic())):
                return True
            for kind in KINDS:
                if faults[kind][position]:
                    getattr(self, f"_{kind}")()
            if self._number % max(1, round(rate)) == 0:  # each second
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
            self.port.write(self.faults.damaged(data, self._probability))

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
        speed = None if settings.speed == 1 else settings.speed
        name = settings.id if settings.id.startswith(EMULATED) else f"{EMULATED}-{settings.id}"
        header = Header(1, len(self.device.sensors), settings.rate, unit, settings.bits, name, speed)
        if self.binary:
            self._send(encode_comment(encode_header(header, "none").rstrip()))
        else:
            self._send(encode_header(header, settings.check))

    def _announce(self, number: int, gesture: Gesture) -> None:
        rate = self.settings.rate
        self._on_event(self._number / rate, f"gesture {number}: {label_text(gesture.labels)}")
        if self.settings.announce and not self.binary:
            seq, frames = self._number - self._zero, round(len(gesture.force) * rate / self.device.model_rate)
            announcement = Announcement(
                number, seq, frames, gesture.labels, self.device.model_rate, gesture.contacts
            )
            self._send(encode_announcement(announcement))

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
