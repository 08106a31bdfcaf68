"""An open skin: ``with open_skin("/dev/ttyACM0", layout=sensors) as skin: ...``"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import replace
from functools import partial
from itertools import count
from math import inf
from time import monotonic
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.hardware.wire.channels import ChannelHealth, ChannelState, Limits, take_baseline
from skin.hardware.wire.decoder import Decoder, Stats
from skin.hardware.wire.protocol import Header, encode_header
from skin.hardware.wire.reader import (
    ByteStream,
    Feed,
    PlaybackFeed,
    PortSettings,
    Reader,
    SkinDisconnected,
    SkinTimeout,
    WireFeed,
    open_stream,
)


class Skin:
    """Frames from an open skin; iterate over it, or :meth:`read` a block.

    Values are in the device's unit; ``frame.values - skin.baseline`` is the change due to touch.

    Attributes:
        baseline: (S,), values of the untouched skin, in the device's unit; None before the first tare.
    """

    def __init__(
        self, reader: Reader, decoder: Decoder | None, timeout: float, baseline: np.ndarray | None = None
    ) -> None:
        self._reader, self._decoder, self._timeout = reader, decoder, timeout
        self.baseline = baseline
        self._taken = 0

    def __enter__(self) -> "Skin":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and close the port."""
        self._reader.close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames as they arrive, to the end of a recording.

        Raises:
            SkinTimeout: no frame arrived within the timeout, though the skin was not disconnected.
            SkinDisconnected: it was unplugged, and ``reconnect`` is not set.
        """
        while True:
            back = self._reader.reconnects
            frame = next(self._reader.take(1, self._timeout), None)
            if frame is not None:
                self._taken += 1
                yield frame
            elif isinstance(self._reader.error, EOFError):
                return
            elif self._reader.error is not None or (
                not self._reader.away and self._reader.reconnects == back
            ):
                self._explain(1, self._timeout, [])

    def read(self, count: int, timeout: float | None = None) -> list[Frame]:
        """Return exactly ``count`` frames.

        Args:
            count: how many.
            timeout: s for all of them; None: the timeout that the skin was opened with.

        Raises:
            SkinTimeout: fewer arrived; they are in its ``frames``.
            SkinDisconnected: it was unplugged, or the recording has ended; likewise.
            InputError: nothing can be read: another format, baud rate or number of sensors.
        """
        timeout = self._timeout if timeout is None else timeout
        frames = list(self._reader.take(count, timeout))
        self._taken += len(frames)
        if len(frames) < count:
            self._explain(count, timeout, frames)
        return frames

    def tare(self, seconds: float = 1.0, force: bool = False, touch: float | None = None) -> np.ndarray:
        """Set the baseline to the readings of the untouched skin, and return it, (S,).

        Args:
            seconds: of frames from now on.
            force: set it even if the skin seems touched.
            touch: smallest shift against the old baseline that is a touch, in the device's units; None: 2 %
                of the range, if the header gives the bits.

        Raises:
            InputError: the skin is touched or was restarted meanwhile, or too few frames arrived; the old
                baseline is kept.
        """
        frames, start = list[Frame](), monotonic()
        while not frames or frames[-1].t_host < start + seconds:
            frame = self.read(1)[0]
            if frame.t_host >= start:
                frames.append(frame)
        if len({frame.segment for frame in frames}) > 1:
            raise InputError("the skin was restarted meanwhile: tare again; the old baseline is kept")
        if touch is None:
            touch = 0.02 * 2**self.header.bits if self.header and self.header.bits else 0.0
        values, valid = (np.stack([getattr(frame, name) for frame in frames]) for name in ("values", "valid"))
        self.baseline = take_baseline(values, valid, self.baseline, touch, force)
        return self.baseline

    @property
    def header(self) -> Header | None:
        """The header that the device sent; None if it sent none."""
        return self._decoder.header if self._decoder else None

    @property
    def away(self) -> bool:
        """Whether the skin is unplugged and being reopened."""
        return self._reader.away

    @property
    def channels(self) -> tuple[ChannelState, ...]:
        """State of each channel at the last frame; empty if channels are not checked."""
        return self._reader.feed.states()

    @property
    def stats(self) -> Stats:
        """Statistics of what was received so far."""
        reader, decoder = self._reader, self._decoder
        if decoder is None:
            stats = Stats(frames=self._taken)
        else:
            stats = replace(decoder.stats, bad=Counter(decoder.stats.bad), trouble=decoder.quality.trouble)
            if (frame_format := decoder.frame_format) is not None:
                stats.format, stats.check = frame_format.name, frame_format.check
        stats.dropped, stats.reconnects, stats.rate_hz = reader.dropped, reader.reconnects, reader.rate
        return stats

    def _explain(self, count: int, timeout: float, frames: list[Frame]) -> None:
        """Raise the error that explains why ``count`` frames are not available."""
        error, stats = self._reader.error, self.stats
        if isinstance(error, SkinDisconnected | EOFError):
            raise SkinDisconnected(str(error), frames) from error
        if error is not None:
            raise error
        message = f"{len(frames)} of {count} frames arrived within {timeout:g} s"
        if self._reader.away:
            raise SkinTimeout(f"{message}: the skin is unplugged; trying again", frames)
        if not stats.bytes and not stats.frames:
            raise SkinTimeout(f"{message}: port open, nothing received; is the device sending?", frames)
        if not stats.frames:
            reason = stats.trouble or "no format shows yet; wrong baud rate?"
            raise SkinTimeout(f"{message}: {stats.bytes} bytes but no frame: {reason}", frames)
        raise SkinTimeout(f"{message}: {stats.trouble or 'the device stopped sending'}", frames)


if TYPE_CHECKING:
    from skin.device.touches import Touches


_KEPT = 10_000  # frames for the statistics of channels
_SPREAD = 1.4826  # median absolute deviation -> standard deviation of normal noise


class Playable(Protocol):
    """A device that can be played, such as :class:`skin.device.simulated.Simulated`."""

    def strips(self) -> "Iterable[Touches]":
        """Yield touches in N in their order, each of which is a piece of a stream."""


def open_skin(
    port: str | PortSettings,
    layout: Sized | None = None,
    *,
    opener: Callable[[], ByteStream] | None = None,
    device: Playable | None = None,
    baseline: np.ndarray | None = None,
    channels: Sequence[int] = (),
    polarity: Sequence[int] = (),
    queue: int = 4096,
    reconnect: bool = False,
    realtime: bool = True,
    **settings: Any,
) -> Skin:
    """Open a skin; use it in a ``with`` statement.

    Args:
        port: ``/dev/ttyACM0``, ``COM3``, ``socket://host:number``, a recording (``x.parquet``, ``x.csv``) or
            ``simulated``; or the settings of a port.
        layout: the sensors (anything with a length); None: their number is detected.
        opener: opens the stream of bytes instead of ``port``, and again after each disconnection.
        device: the device that ``simulated`` plays.
        baseline: (S,), from an earlier tare.
        channels: the device's channel of every sensor, as in a calibration; empty: the same order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        queue: number of frames that are buffered.
        reconnect: wait for an unplugged skin; its next frame has ``after="reconnect"``.
        realtime: False plays a recording or the simulator as fast as frames are read.
        settings: baudrate, format, limits, timeout, backoff and silence, as in :class:`PortSettings`.

    Raises:
        InputError: there is nothing at ``port``, it may not be opened or is in use, or a setting is wrong.
    """
    if unused := sorted({"tare", "scale", "calibration"} & settings.keys()):
        raise InputError(f"open_skin gives values as the device sends them: leave out {unused[0]}")
    about = port if isinstance(port, PortSettings) else PortSettings(port=port, **settings)
    if not (isinstance(queue, int) and queue > 0):
        raise InputError(f"queue={queue} must be a whole number above 0: leave it out for 4096")
    address, sensors = str(about.port), None if layout is None else len(layout)
    if opener is None and address == "simulated":
        if device is None:
            raise InputError("simulated needs a device: open_skin('simulated', device=build_device(config))")
        return play(device.strips(), about.timeout, baseline, queue, realtime)
    if opener is None and address.endswith((".parquet", ".csv")):
        return play([_read_touches(address, sensors)], about.timeout, baseline, queue, realtime)
    decoder = Decoder(sensors, about.format, channels, polarity)
    watched = reconnect and address.startswith("socket://")
    opener = opener or partial(open_stream, address, about.baudrate)
    connect = _listen(opener, decoder, about.limits, (about.silence if watched else None) or inf)
    try:
        reader = Reader(connect, queue, reconnect, about.backoff)
    except OSError as error:
        raise InputError(f"cannot open {address}: {error}") from error
    return Skin(reader, decoder, about.timeout, baseline)


def play(
    strips: "Iterable[Touches]",
    timeout: float = 5.0,
    baseline: np.ndarray | None = None,
    queue: int = 4096,
    realtime: bool = True,
) -> Skin:
    """Return touches in N, all with one rate, as the frames of an open skin.

    Args:
        strips: the touches; each is a segment.
        timeout, baseline, queue, realtime: as in :func:`open_skin`.
    """
    feed = PlaybackFeed(strips, realtime)
    return Skin(Reader(lambda: feed, queue), None, timeout, baseline)


def _listen(
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


def _read_touches(path: str, sensors: int | None) -> "Touches":
    """Return the touches of a recording, which must have as many sensors as the layout."""
    # Imported here because it imports torch, which reading a port does not need.
    from skin.device.files import read_recording

    touches = read_recording(path).touches
    count = touches.readings.shape[2]
    if sensors not in (None, count):
        raise InputError(
            f"{path} has {count} sensors, the layout has {sensors}: give the layout it was recorded with, "
            "as in layout=file layout.path=FILE.csv"
        )
    return touches


class PortMonitor:
    """Collects statistics of an open skin."""

    def __init__(self, skin: Skin) -> None:
        self._skin = skin
        self._frames: deque[Frame] = deque(maxlen=_KEPT)

    def lines(self, seconds: float | None) -> Iterator[str]:
        """Yield a line each second, and the last one after ``seconds`` s; None: without end."""
        start = printed = monotonic()
        for frame in self._skin:
            self._frames.append(frame)
            now = monotonic()
            over = now - start >= (inf if seconds is None else seconds)
            if over or now - printed >= 1:
                printed = now
                yield f"{now - start:6.1f} s  {self._line()}"
            if over:
                return

    def _line(self) -> str:
        stats, sensors = self._skin.stats, len(self._frames[-1].values)
        counts = stats.list_counts(
            bad_frames="bad", lost="lost", skipped="skipped", resets="resets", invalid="invalid values"
        )
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(stats.bad.items()))
        frames = ", ".join([f"{stats.frames} frames", *counts]) + (f" ({reasons})" if reasons else "")
        checksum = f"checksum {stats.check}" if stats.check != "none" else "NO CHECKSUM"
        trouble = f"; {stats.trouble}" if stats.trouble else ""
        return f"{stats.format}, {checksum}, {sensors} sensors, {stats.rate_hz:.4g} Hz, {frames}{trouble}"

    def summary(self) -> str:
        """Return the header, and the minimum, median, maximum, noise and state of each channel."""
        if not self._frames:
            return "nothing received"
        values = np.stack([frame.values for frame in self._frames])
        valid = np.stack([frame.valid for frame in self._frames])
        states = self._skin.channels or ("ok",) * values.shape[1]
        # Of a channel that is never valid, the values that it repeats.
        rows = [row[mask] if mask.any() else row for row, mask in zip(values.T, valid.T, strict=True)]
        lines = [f"header: {self._header()}", "channel     least    median   largest     noise"]
        for channel, (row, state, share) in enumerate(zip(rows, states, valid.mean(axis=0), strict=True)):
            middle = np.median(row)
            noise = _SPREAD * np.median(np.abs(row - middle))
            text = state if share == 1 else f"{state}, invalid in {1 - share:.0%}"
            numbers = f"{channel:7d}{row.min():10.5g}{middle:10.5g}{row.max():10.5g}{noise:10.3g}"
            lines.append(f"{numbers}  {text}")
        return "\n".join(lines)

    def _header(self) -> str:
        header = self._skin.header
        if header is None:
            return "none"
        return encode_header(header, "none").decode().removeprefix("# skin ").strip()
