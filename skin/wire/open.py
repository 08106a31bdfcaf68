"""Open a skin at a serial port or socket, a recording, or the simulator."""

from collections.abc import Callable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from itertools import count
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, NonNegativeFloat, PositiveFloat, PositiveInt

from skin.errors import InputError
from skin.settings import RISING, checked
from skin.wire.decoder import Decoder
from skin.wire.feed import Feed, Piece, PlaybackFeed, WireFeed
from skin.wire.format_detection import Format
from skin.wire.health import ChannelHealth, Limits
from skin.wire.reader import Reader
from skin.wire.skin import Skin
from skin.wire.transport import ByteStream, open_stream

if TYPE_CHECKING:
    from skin.recording import Touches

_STRIP = 600.0  # s of simulated touches in one piece


class Streamed(Protocol):
    """A device that simulates streams of touches, such as :class:`skin.device.simulated.Simulated`."""

    model_rate: float

    def simulate_stream(self, frames: int, gap: Sequence[int] | None = None, number: int = 0) -> Any:
        """Return a stream in one piece; ``whole.touches`` are its touches."""


def _ordered(limits: Limits) -> Limits:
    known = [limit for limit in limits if limit is not None]
    if sorted(set(known)) != known:
        raise ValueError("must be [smallest, largest]")
    return limits


@checked("device")
@dataclass(frozen=True, kw_only=True)
class PortSettings:
    """Settings of :func:`open_skin`.

    Args:
        baudrate: bits per second, for serial ports.
        format: ``auto``, ``text`` or ``binary``.
        limits: smallest and largest value of a channel, as in :class:`skin.wire.health.ChannelHealth`; None:
            the largest count, if the header gives the bits.
        timeout: s without a frame after which iterating and reading raise ``SkinTimeout``.
        queue: number of frames that are buffered.
        reconnect: wait for an unplugged skin; its next frame has ``after="reconnect"``.
        backoff: s before the first attempt to reconnect, and the longest between two.
        silence: s without a byte after which a socket is closed and opened again, if ``reconnect``; None or
            0: never. A computer that lost its power closes no connection. Serial ports are left open: the
            system reports when one is unplugged, and opening one restarts many boards.
        realtime: False plays a recording or the simulator as fast as frames are read.

    Raises:
        InputError: a setting is invalid.
    """

    baudrate: PositiveInt = 115200
    format: Format = "auto"
    limits: Annotated[Limits, AfterValidator(_ordered)] | None = None
    timeout: PositiveFloat = 5.0
    queue: PositiveInt = 4096
    reconnect: bool = False
    backoff: Annotated[tuple[PositiveFloat, PositiveFloat], RISING] = (1.0, 10.0)
    silence: NonNegativeFloat | None = 5.0
    realtime: bool = True


def open_skin(
    port: str,
    layout: Sized | None = None,
    *,
    opener: Callable[[], ByteStream] | None = None,
    device: "Streamed | None" = None,
    baseline: np.ndarray | None = None,
    channels: Sequence[int] = (),
    polarity: Sequence[int] = (),
    **settings: Any,
) -> Skin:
    """Open a skin; use it in a ``with`` statement.

    Args:
        port: ``/dev/ttyACM0``, ``COM3``, ``socket://host:number``, a recording (``x.parquet``, ``x.csv``) or
            ``simulated``.
        layout: the sensors (anything with a length); None: their number is detected.
        opener: opens the stream of bytes instead of ``port``, and again after each disconnection.
        device: the device that ``simulated`` plays.
        baseline: (S,), from an earlier tare.
        channels: the device's channel of every sensor, as in a calibration; empty: the same order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        settings: as in :class:`PortSettings`.

    Raises:
        InputError: there is nothing at ``port``, it may not be opened or is in use, or a setting is wrong.
    """
    chosen, sensors = PortSettings(**settings), None if layout is None else len(layout)
    decoder = None
    if opener is None and port == "simulated":
        if device is None:
            raise InputError("simulated needs a device: open_skin('simulated', device=build_device(config))")
        connect = _player(PlaybackFeed(_strips(device), device.model_rate, chosen.realtime))
    elif opener is None and port.endswith((".parquet", ".csv")):
        connect = _player(_recorded(port, sensors, chosen.realtime))
    else:
        decoder = Decoder(sensors, chosen.format, channels, polarity)
        watched = chosen.reconnect and port.startswith("socket://")
        silence = (chosen.silence if watched else None) or inf
        connect = _wire(
            opener or partial(open_stream, port, chosen.baudrate), decoder, chosen.limits, silence
        )
    try:
        reader = Reader(connect, chosen.queue, chosen.reconnect, chosen.backoff)
    except OSError as error:
        raise InputError(f"cannot open {port}: {error}") from error
    return Skin(reader, decoder, chosen.timeout, baseline)


def _wire(
    opener: Callable[[], ByteStream], decoder: Decoder, limits: Limits | None, silence: float
) -> Callable[[], Feed]:
    """Return a function that connects; from the second call on it restarts the decoder.

    The known ranges of channels are kept: a cable may be unplugged under a press that saturates channels.
    """
    connections, health = count(), ChannelHealth()

    def connect() -> Feed:
        stream = opener()
        if next(connections):
            decoder.restart()
            health.restart()
        return WireFeed(stream, decoder, limits, silence, health)

    return connect


def _player(player: PlaybackFeed) -> Callable[[], Feed]:
    return lambda: player


def _recorded(path: str, sensors: int | None, realtime: bool) -> PlaybackFeed:
    # Imported here because it imports torch, which reading a port does not need.
    from skin.recording_file import read_recording

    touches = read_recording(path).touches
    found = touches.readings.shape[2]
    if sensors not in (None, found):
        raise InputError(
            f"{path} has {found} sensors, the layout has {sensors}: give the layout it was recorded with, "
            "as in layout=file layout.path=FILE.csv"
        )
    return PlaybackFeed(_pieces(touches), touches.rate, realtime)


def _strips(device: "Streamed") -> Iterator[Piece]:
    for number in count():
        yield from _pieces(
            device.simulate_stream(max(1, round(_STRIP * device.model_rate)), number=number).whole.touches
        )


def _pieces(touches: "Touches") -> Iterator[Piece]:
    saturated = touches.valid & False if touches.saturated is None else touches.saturated
    yield from zip(touches.readings.double().numpy(), touches.valid.numpy(), saturated.numpy(), strict=True)
