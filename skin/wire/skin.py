"""An open skin: ``with open_skin("/dev/ttyACM0", layout=sensors) as skin: ...``"""

from collections.abc import Iterator
from dataclasses import dataclass
from time import monotonic

import numpy as np

from skin.errors import InputError
from skin.signal.frame import Counters, Frame
from skin.wire.baseline import median_baseline, quiet_baseline
from skin.wire.decoder import Decoder
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.health import ChannelState
from skin.wire.reader import Reader
from skin.wire.text import Header


@dataclass(frozen=True)
class Stats:
    """Statistics of the bytes received so far.

    Those not listed are described in :class:`skin.signal.frame.Counters`.

    Attributes:
        frames: number of good frames.
        bad_frames: number of frames that could not be decoded; ``bad`` has the reasons.
        dropped: number of good frames dropped from a full queue.
        resyncs: number of good frames after bad ones.
        reconnects: number of reconnections.
        rate_hz: frames per second by the device's clock, Hz; 0 if unknown.
        format: ``text`` or ``binary``; empty if not known yet, or if the source sends no bytes.
        check: ``crc16``, ``xor`` or ``none``; empty likewise.
        trouble: a message about the current problem; empty if there is none.
    """

    frames: int
    bad_frames: int
    dropped: int
    resyncs: int
    reconnects: int
    rate_hz: float
    bytes: int = 0
    bad: tuple[tuple[str, int], ...] = ()
    skipped: int = 0
    gaps: int = 0
    lost: int = 0
    resets: int = 0
    weak: int = 0
    invalid: int = 0
    format: str = ""
    check: str = ""
    trouble: str = ""


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
        self.baseline = (
            median_baseline(values) if force else quiet_baseline(values, valid, self.baseline, touch)
        )
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
        """Statistics of the bytes received so far."""
        reader, decoder = self._reader, self._decoder
        counters = decoder.counters if decoder else Counters(frames=self._taken)
        known = vars(counters) | {"bad": tuple(sorted(counters.bad.items()))}
        frame_format = decoder.frame_format if decoder else None
        return Stats(
            bad_frames=counters.bad.total(),
            dropped=reader.dropped,
            reconnects=reader.reconnects,
            rate_hz=reader.rate,
            format=frame_format.name if frame_format else "",
            check=frame_format.check if frame_format else "",
            trouble=decoder.quality.trouble if decoder else "",
            **known,
        )

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
