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
    """What became of the bytes so far.

    Attributes:
        frames: good ones that came.
        bad_frames: dropped because something was wrong; ``bad`` has the reasons.
        dropped: good ones that nobody took in time.
        resyncs: how often a good frame followed bad ones.
        reconnects: how often the skin was plugged in again.
        rate_hz: frames per second by the device's clock, Hz; 0 if unknown.
        bytes, bad, skipped, gaps, lost, resets, weak: as in :class:`skin.signal.frame.Counters`.
        format: ``text`` or ``binary``; empty if not known yet, or if there are no bytes.
        check: ``crc16``, ``xor`` or ``none``; empty likewise.
        trouble: what a person should look at; empty if all is well.
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
    format: str = ""
    check: str = ""
    trouble: str = ""


class Skin:
    """Frames from an open skin; iterate over it, or :meth:`read` a block.

    Values are what the device sends; ``frame.values - skin.baseline`` is what a touch adds.

    Attributes:
        baseline: (S,), what the untouched skin reads, in the device's units; None before the first tare.
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
        """End the thread and let go of the port."""
        self._reader.close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames as they come, to the end of a recording.

        Raises:
            SkinTimeout: none came within the timeout the skin was opened with, though it was plugged in all
                the time.
            SkinDisconnected: it was unplugged and is not tried again.
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
            timeout: s for all of them; None: as the skin was opened with.

        Raises:
            SkinTimeout: fewer came; they are in its ``frames``.
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
        """Take the untouched skin's readings for the baseline, and return it, (S,).

        Args:
            seconds: of frames from now on.
            force: even if the skin seems touched.
            touch: smallest shift against the old baseline that is a touch, in the device's units; None: 2 %
                of the range, where the device tells its bits.

        Raises:
            InputError: the skin is touched or started anew meanwhile, or too few frames came; the old
                baseline is kept.
        """
        frames, start = list[Frame](), monotonic()
        while not frames or frames[-1].t_host < start + seconds:
            frame = self.read(1)[0]
            if frame.t_host >= start:
                frames.append(frame)
        if len({frame.segment for frame in frames}) > 1:
            raise InputError("the skin started anew meanwhile: tare again; the old baseline is kept")
        if touch is None:
            touch = 0.02 * 2**self.header.bits if self.header and self.header.bits else 0.0
        values, valid = (np.stack([getattr(frame, name) for frame in frames]) for name in ("values", "valid"))
        self.baseline = (
            median_baseline(values) if force else quiet_baseline(values, valid, self.baseline, touch)
        )
        return self.baseline

    @property
    def header(self) -> Header | None:
        """What the device tells of itself."""
        return self._decoder.header if self._decoder else None

    @property
    def channels(self) -> tuple[ChannelState, ...]:
        """What is wrong with each channel, as of the last frame that came; empty if nobody judges."""
        return self._reader.feed.states()

    @property
    def stats(self) -> Stats:
        """What became of the bytes so far."""
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
        """Raise why there are not ``count`` frames."""
        error, stats = self._reader.error, self.stats
        if isinstance(error, SkinDisconnected | EOFError):
            raise SkinDisconnected(str(error), frames) from error
        if error is not None:
            raise error
        came = f"{len(frames)} of {count} frames came within {timeout:g} s"
        if self._reader.away:
            raise SkinTimeout(f"{came}: the skin is unplugged; trying again", frames)
        if not stats.bytes and not stats.frames:
            raise SkinTimeout(f"{came}: port open, nothing received; is the device sending?", frames)
        if not stats.frames:
            reason = stats.trouble or "no format shows yet; wrong baud rate?"
            raise SkinTimeout(f"{came}: {stats.bytes} bytes but no frame: {reason}", frames)
        raise SkinTimeout(f"{came}: {stats.trouble or 'the device has fallen silent'}", frames)
