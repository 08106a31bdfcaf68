"""Feeds of frames for the reader thread: a byte stream or a recording."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from math import inf
from time import monotonic, sleep
from typing import Protocol

import numpy as np

from skin.signal.frame import After, Frame
from skin.wire.decoder import Decoder
from skin.wire.format_detection import stopped_clock_error
from skin.wire.health import ChannelHealth, ChannelState, Limits
from skin.wire.transport import ByteStream

Piece = tuple[np.ndarray, np.ndarray, np.ndarray]

_log = logging.getLogger("skin.wire")

_WAIT = 0.1  # s
_AT_ONCE = 256  # frames, where time does not matter
_STILL = 2.0, 10  # s and frames: a device's clock that is the same for as long stands still
_WEAK = {
    "none": "no checksum: a wrong value passes in 29 % of flipped bits and 76 % of lost bytes",
    "xor": "a weak checksum (*HH): 2 % of double flipped bits and 6 % of double lost bytes pass",
}


class Feed(Protocol):
    """A sequence of frames.

    Attributes:
        patient: the feed can wait, so no frame needs to be dropped.
    """

    patient: bool

    def poll(self) -> list[Frame]:
        """Return the frames of about 0.1 s; OSError once it is unplugged, EOFError at its end."""

    def states(self) -> tuple[ChannelState, ...]:
        """Return the state of each channel."""

    def close(self) -> None:
        """Close the feed."""


class WireFeed:
    """Frames decoded from bytes, with checked channels; logs bad frames once a second.

    Args:
        stream: of bytes.
        decoder: turns them into frames.
        limits: smallest and largest value of a channel.
        silence: s without a byte after which the stream counts as gone.
    """

    patient = False

    def __init__(
        self,
        stream: ByteStream,
        decoder: Decoder,
        limits: Limits | None,
        silence: float = inf,
        health: ChannelHealth | None = None,
    ) -> None:
        self._stream, self._decoder, self._limits = stream, decoder, limits
        self._health = health or ChannelHealth()
        self._told = False
        self._said = Counter(decoder.counters.bad)
        self._said_at = self._heard_at = monotonic()
        self._silence = silence
        self._clock, self._clock_since, self._clock_frames = -inf, 0.0, 0

    def poll(self) -> list[Frame]:
        """Return the frames received since the last call.

        Raises:
            InputError: no format is detected, or the device's clock stands still.
            OSError: the stream is closed, or silent for too long.
        """
        data, now = self._stream.read(), monotonic()
        if data:
            self._heard_at = now
        elif now - self._heard_at >= self._silence:
            raise TimeoutError(f"nothing received for {self._silence:g} s")
        frames = self._decoder.feed(data, now) if data else []
        if frames:
            self._prepare()
            self._check_clock(frames, now)
        elif data and (error := self._decoder.error()):
            raise error
        if now - self._said_at >= 1:
            self._say(now)
        return [self._judged(frame) for frame in frames]

    def states(self) -> tuple[ChannelState, ...]:
        """Return the state of each channel."""
        return self._health.states()

    def close(self) -> None:
        """Close the port."""
        self._stream.close()

    def _prepare(self) -> None:
        """Warn once of a weak checksum; set limits from the header as soon as it arrives."""
        frame_format, header = self._decoder.frame_format, self._decoder.header
        if not self._told and frame_format is not None and frame_format.check in _WEAK:
            _log.warning("frames carry %s; let the firmware send *HHHH", _WEAK[frame_format.check])
        self._told = True
        if header is not None and header.bits:
            self._health.largest = 2**header.bits - 1
        if self._limits is not None:
            self._health.limits = self._limits
        elif header is not None and header.bits:
            self._health.limits = (None, 2**header.bits - 1)

    def _check_clock(self, frames: list[Frame], now: float) -> None:
        """Raise InputError if frames arrive but the device's clock stands still."""
        if frames[-1].t != self._clock:
            self._clock, self._clock_since, self._clock_frames = frames[-1].t, now, 0
        self._clock_frames += len(frames)
        least, few = _STILL
        if now - self._clock_since >= least and self._clock_frames >= few:
            raise stopped_clock_error(self._clock_frames, self._clock * 1e6)

    def _judged(self, frame: Frame) -> Frame:
        if frame.after not in ("", "gap"):
            self._health.restart()
        valid, saturated = self._health.check(frame.values, frame.t)
        if frame.saturated is not None:
            saturated = saturated | frame.saturated
        return frame._replace(valid=valid & frame.valid, saturated=saturated & frame.valid)

    def _say(self, now: float) -> None:
        fresh = self._decoder.counters.bad - self._said
        self._said, self._said_at = Counter(self._decoder.counters.bad), now
        if fresh:
            reasons = ", ".join(f"{count} {reason}" for reason, count in fresh.most_common())
            trouble = self._decoder.quality.trouble
            _log.warning("%d bad frames (%s)%s", fresh.total(), reasons, f"; {trouble}" if trouble else "")


class PlaybackFeed:
    """Frames from memory, in real time or as fast as they are read.

    Args:
        pieces: values, valid and saturated, (F, S) each, of each piece; a window should not span two of them.
        rate: frames per second, Hz.
        realtime: False: as fast as they are read.
    """

    def __init__(self, pieces: Iterable[Piece], rate: float, realtime: bool = True) -> None:
        self.patient = not realtime
        self._rate, self._start = rate, monotonic()
        self._frames = enumerate(self._all(pieces))
        self._next = self._take()

    def _all(self, pieces: Iterable[Piece]) -> Iterator[Frame]:
        for segment, (values, valid, saturated) in enumerate(pieces):
            for place, row in enumerate(values):
                after: After = "cut" if segment and not place else ""
                yield Frame(None, 0.0, 0.0, row, valid[place], segment, 0, after, saturated[place])

    def _take(self) -> Frame | None:
        number, frame = next(self._frames, (0, None))
        t = number / self._rate
        return frame and frame._replace(seq=number, t=t, t_host=self._start + t)

    def poll(self) -> list[Frame]:
        """Return the frames that are due."""
        if self._next is None:
            raise EOFError("the recording has ended")
        if not self.patient:
            sleep(min(_WAIT, max(0.0, self._next.t_host - monotonic())))
        frames, now = list[Frame](), monotonic()
        while self._next and len(frames) < _AT_ONCE and (self.patient or self._next.t_host <= now):
            frames.append(self._next)
            self._next = self._take()
        return frames

    def states(self) -> tuple[ChannelState, ...]:
        """Return nothing: the frames of a file already have masks of valid values."""
        return ()

    def close(self) -> None:
        """Do nothing."""
