"""The emulator: a simulated skin at a pseudo-terminal or a TCP port, in real time."""

import os
import select
import socket
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
    readings = device.model.respond(movie).readings.double().numpy()
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


class TcpPort:
    """A TCP port of this machine, for one reader.

    Args:
        number: of the port; 0: any free one.

    Attributes:
        address: value for ``device.port``.

    Raises:
        InputError: the number is in use.
    """

    def __init__(self, number: int) -> None:
        self._number = number
        self.plug()

    def plug(self) -> None:
        """Listen, after :meth:`unplug` again at the same address."""
        self._client: socket.socket | None = None
        try:
            self._server = socket.create_server(("127.0.0.1", self._number))
        except OSError as error:
            raise InputError(f"cannot listen on port={self._number}: {error}; give port=0") from error
        self._server.setblocking(False)
        self._number = self._server.getsockname()[1]
        self.address = f"socket://127.0.0.1:{self._number}"

    def connected(self) -> bool:
        """Return whether a reader is connected."""
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
        """Close the port."""
        for end in filter(None, (self._client, self._server)):
            end.close()
        self._client = None

    def write(self, data: bytes) -> int:
        """Write a part of ``data`` without waiting; return its length."""
        return self._client.send(data) if self._client else len(data)


class PtyPort:
    """A pseudo-terminal, which programs read like a serial port; the methods are those of :class:`TcpPort`.

    Args:
        link: path of a symbolic link to it, which :meth:`plug` makes again; None: none.

    Attributes:
        address: value for ``device.port``.

    Raises:
        InputError: this system has no pseudo-terminals, or the link cannot be made.
    """

    def __init__(self, link: str | None) -> None:
        self._link = None if link is None else Path(link).expanduser().absolute()
        self.plug()

    def plug(self) -> None:
        """As of :class:`TcpPort`; without a link, the address may be another."""
        if not hasattr(os, "openpty"):
            raise InputError("this system has no pseudo-terminals: give a TCP port, as in port=5555")
        import tty

        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        name = os.ttyname(slave)
        self.address = str(self._link or name)
        if self._link is not None:
            try:
                if not self._link.exists():  # left by an emulator that was killed
                    self._link.unlink(missing_ok=True)
                self._link.symlink_to(name)
            except OSError as error:
                raise InputError(
                    f"cannot make link={self._link}, which may be in use: {error.strerror}; end the other "
                    "skin emulate, or give another name"
                ) from error
        os.close(slave)  # opened and closed once, it tells when a reader opens it
        self._master = os.fdopen(master, "wb", 0)

    def connected(self) -> bool:
        """As of :class:`TcpPort`."""
        watch = select.poll()
        watch.register(self._master, 0)
        return not watch.poll(0)  # that nobody has it open is reported always

    def unplug(self) -> None:
        """As of :class:`TcpPort`."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self._master.close()

    def write(self, data: bytes) -> int:
        """As of :class:`TcpPort`."""
        return os.write(self._master.fileno(), data)


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
        seed: of the gestures; the device's own noise follows ``device.seed``.
        unplug: times, s since the start of the device, at which the port disappears for ``away`` s; frame
            numbers and clock then start from 0 again.
        silence: times, s, from which it sends nothing for ``away`` s; frame numbers and clock go on.
        away: s.
        stuck: channels, from 0, that keep their value from ``since`` on.
        dead: channels that send 0 from then on.
        since: s.
    """

    rate: PositiveFloat = 100.0
    speed: PositiveFloat = 1.0
    bits: Annotated[int, Ge(2), Le(16)] | None = 10
    check: Check = "crc16"
    idle: NonNegativeFloat = 3.0
    gap: NonNegativeFloat = 0.5
    seed: NonNegativeInt = 0
    unplug: Sequence[NonNegativeFloat] = ()
    silence: Sequence[NonNegativeFloat] = ()
    away: NonNegativeFloat = 2.0
    stuck: Sequence[NonNegativeInt] = ()
    dead: Sequence[NonNegativeInt] = ()
    since: NonNegativeFloat = 0.0


class Emulator:
    """Sends the gestures of a simulated device, with imperfections, like firmware.

    It waits for the first reader and then sends with or without one.

    Args:
        device: the skin; its gestures have the rate of the model.
        port: the port it sends to.
        settings: rate, converter and format.
        on_event: called with the device's time, s, and a message about each event.

    Attributes:
        converter: from N to counts.
        frames: number of frames sent.

    Raises:
        InputError: a channel that fails does not exist.
    """

    def __init__(
        self,
        device: Simulated,
        port: TcpPort | PtyPort,
        settings: EmulatorSettings,
        on_event: Callable[[float, str], None] = lambda t, text: None,
    ) -> None:
        self.device, self.port, self.settings = device, port, settings
        self.converter = Converter(settings.bits, float(device.constants.clip.max()))
        self._on_event, self.frames, self._zero = on_event, 0, 0
        self._sent = np.zeros(len(device.sensors))
        if max([*settings.stuck, *settings.dead], default=0) >= len(device.sensors):
            raise InputError(
                f"emulate.stuck={list(settings.stuck)} and emulate.dead={list(settings.dead)} must be below "
                f"{len(device.sensors)}, the number of sensors of the layout"
            )
        self._over = Event()
        self._noise = generator(Stream.NOISE, device.seed, Stream.TEST, 2, settings.seed)

    def run(self, seconds: float | None = None, count: int | None = None) -> None:
        """Send until ``count`` gestures or ``seconds`` of device time are over, or until :meth:`stop`."""
        while not self.port.connected() and not self._over.wait(0.05):
            pass
        end = None if seconds is None else round(seconds * self.settings.rate)
        self._start = monotonic()
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
        time = torch.from_numpy((self.frames + np.arange(len(true))) / self.settings.rate)
        output = self.device.imperfection.raw(
            torch.from_numpy(true)[None].float(), self.device.constants, self._noise, time
        )
        return self.converter(output[0].double().numpy() * self.device.imperfection.signs(true.shape[1]))

    def _play(self, values: np.ndarray, end: int | None) -> bool:
        """Send frames when they are due; return whether the run is over."""
        rate, stuck, dead = self.settings.rate, list(self.settings.stuck), list(self.settings.dead)
        unplugged = {round(t * rate) for t in self.settings.unplug}
        for row in values:
            if end is not None and self.frames >= end:
                return True
            due = self._start + self.frames / (rate * self.settings.speed)
            if self._over.wait(max(0.0, due - monotonic())):
                return True
            if self.frames in unplugged:
                self._unplug()
            if self.frames % max(1, round(rate)) == 0:  # each second
                self._header()
            if self.frames > self.settings.since * rate:
                row[stuck], row[dead] = self._sent[stuck], 0.0
            self._sent, seq = row, self.frames - self._zero
            numbers = row.tolist() if self.settings.bits is None else row.astype(int).tolist()
            self._send(encode_line(numbers, seq, round(seq * 1e6 / rate) % 2**32, self.settings.check))
            self.frames += 1
        return False

    def _send(self, data: bytes, patience: float = 1.0) -> None:
        """Write; bytes that are not read within ``patience`` s are lost, as without flow control."""
        t, deadline = self.frames / self.settings.rate, monotonic() + patience
        silent = any(0 <= t - begin < self.settings.away for begin in self.settings.silence)
        while data and not silent and monotonic() < deadline and self.port.connected():
            try:
                data = data[self.port.write(data) :]
            except BlockingIOError:
                sleep(0.002)  # until a full buffer is tried again
            except OSError:
                return

    def _header(self) -> None:
        settings, unit = self.settings, "N" if self.settings.bits is None else "adc"
        speed = None if settings.speed == 1 else settings.speed
        header = Header(1, len(self.device.sensors), settings.rate, unit, settings.bits, EMULATED, speed)
        self._send(encode_header(header, settings.check))

    def _announce(self, number: int, gesture: Gesture) -> None:
        rate = self.settings.rate
        self._on_event(self.frames / rate, f"gesture {number}: {label_text(gesture.labels)}")
        seq, frames = self.frames - self._zero, round(len(gesture.force) * rate / self.device.model_rate)
        self._send(
            encode_announcement(
                Announcement(number, seq, frames, gesture.labels, self.device.model_rate, gesture.contacts)
            )
        )

    def _unplug(self) -> None:
        """Disconnect and power off; the clock starts from 0 afterwards."""
        self._on_event(self.frames / self.settings.rate, f"unplugged for {self.settings.away:g} s")
        self.port.unplug()
        self._over.wait(self.settings.away / self.settings.speed)
        self.port.plug()
        self._on_event(self.frames / self.settings.rate, f"plugged in again: {self.port.address}")
        self._start += self.settings.away / self.settings.speed
        self._zero = self.frames
        self._header()
