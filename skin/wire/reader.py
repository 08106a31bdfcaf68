"""Read a port: its settings, streams of bytes, and feeds of frames."""

import errno
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from itertools import count
from math import inf
from time import sleep
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from pydantic import AfterValidator, NonNegativeFloat, PositiveFloat, PositiveInt

from skin.core.settings import RISING, checked
from skin.device.resampling import INWARDS, After, Frame
from skin.errors import InputError
from skin.wire.adapter import Adapter, read_adapter
from skin.wire.channels import ChannelHealth, Limits, Reason
from skin.wire.decoder import Decoder

if TYPE_CHECKING:
    from skin.device.touches import Touches


def _check_order(limits: Limits) -> Limits:
    numbers = [limit for limit in limits if limit is not None]
    if sorted(set(numbers)) != numbers:
        raise ValueError("must be [smallest, largest]")
    return limits


@checked("device")
@dataclass(frozen=True, kw_only=True)
class Port:
    """Where a skin is and how to read it.

    Args:
        port: ``/dev/ttyACM0``, ``COM3`` or ``socket://host:number``.
        baudrate: bits per second, for serial ports.
        adapter: describes what the board sends: an option of ``conf/adapters/``, a YAML file, or the settings
            of :class:`skin.wire.adapter.Adapter`.
        limits: smallest and largest value of a channel, as in
            :class:`skin.wire.channels.ChannelHealth`; None: the largest count, if the header gives
            the bits.
        timeout: s without a frame after which iterating and reading raise ``SkinTimeout``: longer than
            between two headers, because after a reconnection frames count only after one.
        backoff: s before the first attempt to reconnect, and the longest between two.
        silence: s without a byte after which a socket is closed and opened again, if it is to be reconnected;
            None or 0: never. A computer that lost its power closes no connection. Serial ports are left open:
            the system reports when one is unplugged, and opening one restarts many boards.
        tare: duration of the tare, s; without one nothing would tell a frozen device from one at rest.
        scale: N per unit of the device; negative if values fall with force.
        calibration: calibration file.
        sensitivity: N per unit of a sensor by its data sheet; the conversion to N must agree with it.

    Attributes:
        frames: the adapter, read.

    Raises:
        InputError: a setting is invalid.
    """

    port: str | None = None
    baudrate: PositiveInt = 115200
    adapter: str | Mapping[str, Any] = "protocol"
    limits: Annotated[Limits, AfterValidator(_check_order)] | None = None
    timeout: PositiveFloat = 6.0
    backoff: Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = (1.0, 10.0)
    silence: NonNegativeFloat | None = 5.0
    tare: PositiveFloat = 2.0
    scale: float | None = None
    calibration: str | None = None
    sensitivity: PositiveFloat | None = None
    frames: Adapter = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", read_adapter(self.adapter))

    @classmethod
    def select(cls, device: Mapping[str, Any]) -> "Port":
        """Return those of the settings of ``device=serial`` that describe the port."""
        return cls(**{entry.name: device[entry.name] for entry in fields(cls) if entry.name in device})


class _TooFewFramesError(Exception):
    """Fewer frames arrived than requested.

    Attributes:
        frames: those that arrived.
    """

    def __init__(self, message: str, frames: Sequence[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = list(frames)


class SkinTimeout(_TooFewFramesError, TimeoutError):  # noqa: N818 - named as TimeoutError is
    """The frames did not arrive in time."""


class SkinDisconnected(_TooFewFramesError, ConnectionError):  # noqa: N818
    """The skin was unplugged, or a recording has ended."""


_WAIT = 0.002  # s that a read without bytes waits
_CONNECT = 5.0  # s
_MOST = 65536  # bytes at once


class ByteStream(Protocol):
    """A source of bytes; a custom ``opener`` returns such an object."""

    def read(self) -> bytes:
        """Return the received bytes, possibly none, within 0.1 s; OSError once the stream is closed."""

    def write(self, data: bytes) -> None:
        """Send bytes; needed only for an adapter with a start, poll or stop string."""

    def close(self) -> None:
        """Close the port."""


def check_port(port: str) -> None:
    """Check that there is a device at a serial port, without opening it: that would restart many boards.

    Raises:
        InputError: there is none. Names of Windows and sockets cannot be checked.
    """
    if os.name == "posix" and "/" in port and "://" not in port and not os.path.exists(port):
        raise InputError(f"no port {port}: {_existing()}")


class PortStream:
    """A serial port, or ``socket://host:number``.

    Raises:
        InputError: there is no such port, it cannot be opened, or it is in use.
    """

    def __init__(self, port: str, baudrate: int) -> None:
        import serial

        try:
            # Exclusive, or two readers would get half the bytes each.
            settings = {"timeout": 0, "write_timeout": _CONNECT, "exclusive": True, "do_not_open": True}
            self._port = serial.serial_for_url(port, baudrate, **settings)
            self._port.reset_input_buffer = lambda: None  # what a socket sends at once is no rest
            self._port.open()
        except Exception as error:
            raise _refused(port, baudrate, error) from error
        self.write, self.close = self._port.write, self._port.close

    def read(self) -> bytes:
        """As of :class:`ByteStream`."""
        data = bytes(self._port.read(_MOST))
        if not data:
            sleep(_WAIT)
        return data


def _refused(port: str, baudrate: int, error: Exception) -> InputError:
    """Return why a serial port cannot be opened; Windows reports "access is denied" for a port in use."""
    number, text, existing = getattr(error, "errno", None), str(error), _existing()
    if port.startswith("socket://"):
        return InputError(f"cannot reach {port}: {text}; does anything listen there?")
    reasons = (
        ((errno.ENOENT, errno.ENODEV, errno.ENXIO), "FileNotFoundError", f"no port {port}: {existing}"),
        (
            (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK),
            "PermissionError",
            f"{port} is in use: close the serial monitor or any other program that reads it",
        ),
        (
            (errno.EACCES, errno.EPERM),
            "may not be opened",
            f"{port} may not be opened: add your user to dialout with "
            "sudo usermod -a -G dialout $USER, and log in again",
        ),
        (
            (errno.ENOTTY, errno.EINVAL, errno.EISDIR),
            "configure port",
            f"{port} is not a serial port: {existing}",
        ),
        ((number,), "", f"cannot open {port} with device.baudrate={baudrate}: {text}"),
    )
    return InputError(next(why for numbers, words, why in reasons if number in numbers or words in text))


def _existing() -> str:
    from serial.tools import list_ports

    ports = ", ".join(sorted(entry.device for entry in list_ports.comports()))
    return (
        f"there are {ports}; give device.port=PORT" if ports else "there is no serial port; is it plugged in?"
    )


class WireFeed:
    """Frames decoded from bytes, with checked channels.

    It sends the strings of the adapter: to start the board, for each frame, and to stop it.

    Args:
        opener: opens the stream of bytes.
        decoder: turns them into frames.
        limits: smallest and largest value of a channel.
        silence: s without a byte after which the stream counts as gone.
        again: s between two attempts to start a board, which may take seconds to boot.
        unanswered: s without an answer after which a board is polled again.
        inwards: the device has sites with three axes, frames have the channels inwards, and their masks
            depend on no other channel.
    """

    def __init__(
        self,
        opener: Callable[[], ByteStream],
        decoder: Decoder,
        limits: Limits | None = None,
        silence: float = inf,
        again: float = 1.0,
        unanswered: float = 0.25,
        inwards: bool = False,
    ) -> None:
        self._opener, self._decoder, self._limits, self._silence = opener, decoder, limits, silence
        self._again, self._unanswered, self._taken = again, unanswered, INWARDS if inwards else slice(None)
        self._health = ChannelHealth(limits or (None, None), judges=self._taken)
        self._begin()

    def open(self) -> None:
        """Open the stream again after a disconnection.

        The known ranges of channels are kept: a cable may be unplugged under a press that saturates channels.
        """
        self._begin()
        self._decoder.restart()
        self._health.restart()

    def _begin(self) -> None:
        self._stream = self._opener()
        adapter = self._decoder.adapter
        self._start, self._poll, self._stop = (
            (text or "").encode() for text in (adapter.start, adapter.poll, adapter.stop)
        )
        self._asked_at = self._polled_at = -inf
        self._started, self._answered, self._received_at = False, True, inf

    def poll(self, clock: Callable[[], float]) -> list[Frame]:
        """Return the frames received since the last call.

        Args:
            clock: gives the host's monotonic time, s.

        Raises:
            InputError: no format is detected, or another device is connected.
            OSError: the stream is closed, or silent for too long.
        """
        self._ask(clock())
        data, now = self._stream.read(), clock()
        if data or now < self._received_at:
            self._received_at = now
        elif now - self._received_at >= self._silence:
            raise TimeoutError(f"nothing received for {self._silence:g} s")
        frames = self.decode(data, now) if data else []
        # Before the first frame any bytes answer a poll.
        self._answered |= bool(frames) or (bool(data) and not self._started)
        self._started |= bool(frames)
        return frames

    def decode(self, data: bytes, now: float) -> list[Frame]:
        """Return the frames that end in bytes received at ``now``, s, with checked channels.

        Raises:
            InputError: no format is detected, or another device is connected.
        """
        frames = self._decoder.feed(data, now)
        if error := self._decoder.error():
            raise error
        if frames:
            self._prepare()
        return [self._judge(frame) for frame in frames]

    @property
    def states(self) -> tuple[str, ...]:
        """State of each channel: ``ok``, or a :class:`skin.wire.channels.Reason`."""
        return self._health.states()[self._taken]

    @property
    def unanswered(self) -> str:
        """What was sent to the board without any frame in return, in words; empty if nothing."""
        if self._started or not (self._start or self._poll):
            return ""
        return (
            f"the string {(self._start or self._poll).decode()!r} of the adapter was sent without an answer"
        )

    def close(self) -> None:
        """Tell the board to stop, and close the port."""
        with suppress(OSError):
            if self._stop:
                self._stream.write(self._stop)
        self._stream.close()

    def _ask(self, now: float) -> None:
        """Send what is due at ``now``, s."""
        if self._start and not self._started and now - self._asked_at >= self._again:
            self._stream.write(self._start)
            self._asked_at = now
        if self._poll and (self._answered or now - self._polled_at >= self._unanswered):
            self._stream.write(self._poll)
            self._polled_at, self._answered = now, False

    def _prepare(self) -> None:
        """Set limits from the header as soon as it arrives."""
        header = self._decoder.header
        if header is not None and header.bits:
            self._health.largest = 2**header.bits - 1
            self._health.limits = self._limits or (None, self._health.largest)

    def _judge(self, frame: Frame) -> Frame:
        if frame.after not in ("", "gap"):
            self._health.restart()
        health = self._health.check(frame.values, frame.t, frame.saturated, frame.polarity)
        mask = health | ~frame.valid * Reason.MISSING
        frame = frame._replace(valid=mask <= Reason.SATURATED, saturated=mask == Reason.SATURATED, mask=mask)
        return frame.inwards() if self._taken == INWARDS else frame


class PlaybackFeed:
    """Frames from memory, in real time.

    Args:
        strips: touches in N, all with one rate; a window should not span two of them.
    """

    states: tuple[str, ...] = ()  # the frames of a file already have masks of valid values
    unanswered = ""

    def __init__(self, strips: "Iterable[Touches]") -> None:
        self._start, self._frames = inf, self._play(strips)

    def _play(self, strips: "Iterable[Touches]") -> Iterator[Frame]:
        number, segments = count(), count()
        for strip in strips:
            saturated = strip.valid & False if strip.saturated is None else strip.saturated
            masks = strip.valid.numpy(), saturated.numpy()
            for touch in zip(strip.readings.double().numpy(), *masks, strict=True):
                segment = next(segments)
                after: After = "cut" if segment else ""
                for values, valid, limited in zip(*touch, strict=True):
                    seq = next(number)
                    yield Frame(seq, seq / strip.rate, 0.0, values, valid, segment, 0, after, limited)
                    after = ""

    def poll(self, clock: Callable[[], float]) -> list[Frame]:
        """Return the next frame when it is due.

        Args:
            clock: gives the host's monotonic time, s.

        Raises:
            EOFError: the recording has ended.
        """
        frame = next(self._frames, None)
        if frame is None:
            raise EOFError("the recording has ended")
        self._start = min(self._start, clock())
        sleep(max(0.0, self._start + frame.t - clock()))
        return [frame._replace(t_host=self._start + frame.t)]

    def open(self) -> None:
        """Do nothing: memory is never disconnected."""

    close = open
