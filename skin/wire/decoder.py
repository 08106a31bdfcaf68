"""Decode bytes into frames, without input or output, and count what goes wrong."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Literal

import numpy as np

from skin.device.resampling import After, Frame, FrameError
from skin.errors import InputError
from skin.wire.adapter import Adapter
from skin.wire.clocks import ClockUnit, ClockWatch, FrameClock, HostClock, SequenceTracker
from skin.wire.formats import FrameFormat
from skin.wire.protocol import Format, Header, RawFrame, parse_header


@dataclass
class Stats:
    """Numbers of frames and errors of a connection, and its state.

    Attributes:
        bytes: received.
        frames: good frames.
        bad: reason -> number of frames that could not be decoded.
        skipped: pieces before the first good frame of a connection: half a line, a banner, noise.
        resyncs: good frames after bad ones.
        gaps: interruptions by missing frames.
        lost: missing frames, according to frame numbers.
        resets: restarts of the device.
        invalid: values in good frames for which the device sent no number, such as ``nan`` or ``ovf``.
        weak: frames accepted without a CRC, which may have wrong values.
        dropped: good frames dropped from a full queue.
        reconnects: reconnections.
        rate_hz: frames per second by the device's clock, Hz; 0 if unknown.
        format: ``text`` or ``binary``; empty if not known yet, or if the source sends no bytes.
        check: ``crc16``, ``xor`` or ``none``; empty likewise.
        clock: what the device's clock and its counter were found to count; empty: as they should, or unknown.
        clock_trusted: False: the host's clock is used instead.
        trouble: a message about the current problem; empty if there is none.
    """

    bytes: int = 0
    frames: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    resyncs: int = 0
    gaps: int = 0
    lost: int = 0
    resets: int = 0
    invalid: int = 0
    weak: int = 0
    dropped: int = 0
    reconnects: int = 0
    rate_hz: float = 0.0
    format: str = ""
    check: str = ""
    clock: str = ""
    clock_trusted: bool = True
    trouble: str = ""

    @property
    def bad_frames(self) -> int:
        """Number of frames that could not be decoded."""
        return self.bad.total()

    def list_counts(self, **words: str) -> list[str]:
        """Return counts above 0 in words, as ``3 lost``; ``words`` has the word of each."""
        return [f"{count} {word}" for name, word in words.items() if (count := getattr(self, name))]


Identity = Literal["known", "missing", "other", "changed"]
"""Of the device by its headers: known; none since it was connected again; another; another without that."""

_CORRECTED = (
    6.0  # s in which the next header must correct one that has changed: many devices repeat it every five
)
_LONGEST = 65536  # bytes of a line
_ENOUGH = 4096  # bytes in which the format must show
_PATIENCE = 2.0  # s of receiving in which it must
_MANY, _LONG = 65536, 4.0  # the same of an adapter, which may need a dozen frames of many lines
_NEWS = 1 / 16  # fraction of the first bytes that must be new before the format is looked for again
_PAUSE = 0.2  # s that a silence counts for at most, because a board may take seconds to start
_PER_FIELD = 12  # bytes
_SPAN = 2.0  # s over which good frames are compared with bad ones
_FEW = 3  # bad frames, too few for a conclusion


class Decoder:
    """Decodes bytes into frames; resynchronises at the next delimiter and never raises for its input.

    The format is detected, as the adapter describes it (of our protocol: two binary frames with a correct
    CRC, or three lines with equal numbers of fields), and then kept. Without a CRC, the bytes before the
    first delimiter are skipped: they may be half a frame.

    After a reconnection another device may be at the port. If the one before sent a header, frames count only
    once the same header has arrived, apart from its rate.

    Args:
        sensors: S; None: taken from the header or from eight lines.
        format: ``auto``, ``text`` or ``binary``.
        channels: the device's channel, from 0, of every sensor; empty: frames keep the device's order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        adapter: describes the frames; None: our protocol.

    Attributes:
        stats: numbers of frames and errors; kept by :meth:`restart`.
        frame_format: the format, once it is known.
        header: of the device; None until it sends one.
    """

    def __init__(
        self,
        sensors: int | None = None,
        format: Format = "auto",
        channels: Sequence[int] = (),
        polarity: Sequence[int] = (),
        adapter: Adapter | None = None,
    ) -> None:
        self.sensors, self.adapter = sensors, adapter or Adapter(format=format)
        self.stats = Stats()
        self._compared_at: float | None = None
        self._good = self._bad = 0
        self._latest_bad = FrameError("")
        self.header: Header | None = None
        self._identity: Identity = "known"
        self._changed_at = inf  # s, when another header came on an open connection
        self._order, self._clock, self._counted = (
            SequenceTracker(modulus=self.adapter.modulus),
            HostClock(),
            FrameClock(),
        )
        self._unit = ClockUnit(self._order.unit, False)
        self._watch, self._clocked = ClockWatch(), False
        self._latest = np.zeros(sensors or 0)
        self._channels = np.array(channels) if len(channels) else None
        self._polarity = np.array(polarity, dtype=float) if min(polarity, default=1) < 0 else None
        self._begin()

    def _begin(self) -> None:
        self.frame_format: FrameFormat | None = None
        self.stats.format = self.stats.check = ""
        self._buffer = b""
        self._count_seen: int | None = None
        self._receiving, self._fed_at, self._unseen = 0.0, float("nan"), 0
        self._whole = self._overlong = self._synchronous = False
        self._missing = 0

    def restart(self, after: After = "reconnect") -> None:
        """Start another connection: detect the format again, with the same number of sensors."""
        self._begin()
        self._order.cut(after)
        self._identity, self._changed_at = "missing" if self.header else "known", inf
        self.stats.trouble = self._doubt
        self._counted.restart()
        self._unit.restart()
        self._watch.restart()
        self.stats.clock_trusted = True

    def feed(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """Return the frames that end in ``data``.

        Args:
            data: any bytes, cut anywhere.
            now: s, the host's monotonic clock at their arrival.
        """
        self.stats.bytes += len(data)
        passed, self._fed_at = now - self._fed_at, now
        if self.frame_format is None:
            self._receiving += min(passed, _PAUSE) if passed > 0 else 0.0
            # Bounds the search while no format is recognised.
            self._buffer = self._buffer[-2 * self._enough :]
        self._buffer += data
        if self.frame_format is None and not self._recognise(data):
            return []
        assert self.frame_format is not None
        pieces, self._buffer = self.frame_format.split(self._buffer)
        good, bad = self.stats.frames, self.stats.bad_frames
        frames = [frame for piece in pieces if (frame := self._frame(piece, now))]
        if frames and self.stats.clock_trusted:
            self._judge_clock(frames, now)
        if len(self._buffer) > _LONGEST:
            self._buffer, self._overlong = b"", True
        self._compare(now, self.stats.frames - good, self.stats.bad_frames - bad)
        return frames

    def error(self) -> InputError | None:
        """Return an error once 2 s of receiving or 4 kB (or four frames) show no format; else None.

        Also if its header has changed.
        """
        if self._fed_at - self._changed_at > _CORRECTED:
            return InputError(f"{self._doubt}: start the command again to read this device")
        patience = _PATIENCE if self.adapter.kind == "protocol" else _LONG
        if self.frame_format or (self._receiving < patience and len(self._buffer) < self._enough):
            return None
        return self.explain()

    def explain(self) -> InputError:
        """Return why no format was detected so far."""
        return self.adapter.explain(self._buffer, self._count_seen, self.sensors)

    @property
    def _enough(self) -> int:
        """Bytes in which the format must show: 4 kB, or four frames."""
        if self.adapter.kind != "protocol":
            return _MANY
        return max(_ENOUGH, 4 * _PER_FIELD * (2 + (self.sensors or 0)))

    def _recognise(self, data: bytes) -> bool:
        """Buffer the first bytes until they show the format; they are then decoded from the first one on."""
        self._unseen += len(data)
        # What is left unread grows with what was read, or the time to read it all would grow as its square.
        if not self.adapter.may_end(data) or self._unseen < _NEWS * len(self._buffer):
            return False
        self._unseen = 0
        detected = self.adapter.detect(self._buffer, self.sensors)
        self.frame_format, self._count_seen = detected.frame_format, detected.count_seen
        if self.frame_format is None:
            return False
        self._update_header(detected.header)
        self.sensors = self.frame_format.sensors
        self.stats.format, self.stats.check = self.frame_format.name, self.frame_format.check
        if detected.unit is not None and self._unit.unit == self._order.unit and not self._unit.summary:
            self._order.unit = detected.unit
            self._unit = ClockUnit(detected.unit, detected.settled)
        self._all_valid = np.ones(self.sensors, dtype=bool)
        self._all_valid.flags.writeable = False
        if len(self._latest) != self.sensors:
            self._latest = np.zeros(self.sensors)
        return True

    def _frame(self, piece: bytes, now: float) -> Frame | None:
        assert self.frame_format is not None
        first, self._whole = not self._whole, True
        try:
            if self._overlong or len(piece) > _LONGEST:
                self._overlong = False
                raise FrameError("long")
            raw = self.frame_format.read(piece)
            if isinstance(raw, bytes):
                self._update_header(parse_header(raw))
                return None
            if first and self.frame_format.check != "crc16":
                raise FrameError("structure")
            return self._place_frame(raw, now) if self._identity == "known" else None
        except FrameError as bad:
            if self._synchronous or self._missing:
                self._synchronous, self._latest_bad = False, bad
                self._missing += 1
                self.stats.bad[bad.reason] += 1
            else:
                self.stats.skipped += 1
            return None

    def _update_header(self, header: Header | None) -> None:
        """Take a header. One that differs is of another device: frames count once the one before is back."""
        if header is None:
            return
        if self.header is None or not header.changes(self.header):
            self.header = self.header or header
            self._identity, self._changed_at = "known", inf
        elif self._identity in ("known", "changed"):
            self._identity, self._changed_at = "changed", min(self._changed_at, self._fed_at)
        else:
            self._identity = "other"
        self._other = header
        self.stats.trouble = self._doubt

    @property
    def _doubt(self) -> str:
        """Why frames do not count, in words; empty if they do."""
        if self._identity == "known" or self.header is None:
            return ""
        if self._identity == "missing":
            return "the device has not sent its header since it was connected again"
        if self._identity == "other":
            return f"another device is connected: {self._other}"
        return f"the header of the device has changed, {self._other.changes(self.header)}"

    def _place_frame(self, raw: RawFrame, now: float) -> Frame:
        ticks, rate = raw.ticks, None if self.header is None else self.header.rate
        self._clocked = ticks is not None and self.stats.clock_trusted
        frames = self._order.ahead(raw.seq, self._missing)
        if ticks is None or not self._clocked:
            ticks = self._counted(now, frames, rate) / self._order.unit
        elif self._unit.add(ticks, now, frames, rate):
            self._order.unit = self._unit.unit
            self._order.cut("reset")
        t, segment, lost, after = self._order.place(raw.seq, ticks, self._missing, self._clocked)
        if self._unit.summary and self.stats.clock_trusted:
            modulus = f", its counter wraps at {self._order.modulus}" if self._order.modulus else ""
            self.stats.clock = self._unit.summary + modulus
        stats = self.stats
        stats.frames += 1
        stats.resyncs += self._missing > 0
        stats.lost += lost
        stats.gaps += after == "gap"
        stats.resets += after == "reset"
        stats.weak += stats.check != "crc16"
        self._synchronous, self._missing = True, 0
        if after and after != "gap":
            self._clock.restart()
        if self._channels is not None:
            raw = raw._replace(values=raw.values[self._channels])
        values, valid = raw.values, self._all_valid
        if not raw.finite:
            valid = np.isfinite(values)
            stats.invalid += len(valid) - int(np.count_nonzero(valid))
            values = np.where(valid, values, self._latest)
        self._latest = values
        frame = Frame(raw.seq, t, self._clock(t, now), values, valid, segment, lost, after)
        if self._polarity is None:
            return frame
        # Channels whose values fall with force end at 0 counts.
        counted = self.header is not None and self.header.bits is not None
        at_limit = (self._polarity < 0) & (values <= 0)
        return frame._replace(polarity=self._polarity, saturated=at_limit if counted else None)

    def _judge_clock(self, frames: Sequence[Frame], now: float) -> None:
        """From the next frame on, take the time from the host if the device's clock cannot be trusted."""
        if frames[0].segment != frames[-1].segment or frames[-1].after not in ("", "gap"):
            self._watch.restart()
        speed = (self.header and self.header.speed) or 1.0
        if self._clocked and not self._watch.trust([frame.t for frame in frames], now, speed):
            self.stats.clock_trusted = False
            self._order.cut("reset")
            self.stats.clock = "the device's clock cannot be trusted: the host's is used"

    def _compare(self, now: float, good: int, bad: int) -> None:
        """Compare the good frames received by ``now``, s, with the bad ones, over two seconds at a time."""
        self._compared_at = now if self._compared_at is None else self._compared_at
        self._good += good
        self._bad += bad
        if now - self._compared_at < _SPAN:
            return
        trouble = self._doubt
        if self._bad > max(self._good, _FEW):
            share = f"{self._bad} of {self._bad + self._good} frames in {_SPAN:g} s were bad"
            trouble = f"{share} ({self._latest_bad.reason}): wrong baud rate or format?"
            if self._latest_bad.reason == "fields":
                trouble = f"{share}: the device sends {self._latest_bad.found} values per frame now"
        self.stats.trouble, self._compared_at, self._good, self._bad = trouble, now, 0, 0
