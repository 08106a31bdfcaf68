"""Decode bytes into frames, without input or output, and count what goes wrong."""

import re
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

import numpy as np

from skin.device.resampling import After, Frame, FrameError
from skin.errors import InputError
from skin.wire.adapter import Adapter
from skin.wire.clocks import UNITS, FrameClock
from skin.wire.formats import FrameFormat
from skin.wire.protocol import Announcement, Header, RawFrame, parse_announcement, parse_header

Identity = Literal["known", "missing", "other"]
"""Of the device by its headers: known; none since it was connected again; another."""


@dataclass
class Stats:
    """Numbers of frames and errors of a connection, and its state.

    Attributes:
        bytes: received.
        frames: good frames.
        bad: reason -> number of frames that could not be decoded.
        skipped: pieces before the first good frame of a connection: half a line, a banner, noise.
        lost: missing frames, according to frame numbers.
        resets: restarts of the device.
        invalid: values in good frames for which the device sent no number, such as ``nan`` or ``ovf``.
        dropped: good frames dropped from a full queue.
        reconnects: reconnections.
        rate_hz: frames per second by the device's clock, Hz; 0 if unknown.
        format: ``text`` or ``binary``; empty if not known yet, or if the source sends no bytes.
        check: ``crc16``, ``xor`` or ``none``; empty likewise.
        ignored: kind of line, with # for its numbers -> number of those lines, which are no frames.
        timing: the device's clock and its counter.
        identity: whether the device is the one of the first header.
        header, other_header: the first header, and one that differs.
        bad_fraction: number of bad frames and of all in 2 s, reason of the latest bad one, and number of its
            values; None: most frames were good.
    """

    bytes: int = 0
    frames: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    skipped: int = 0
    lost: int = 0
    resets: int = 0
    invalid: int = 0
    dropped: int = 0
    reconnects: int = 0
    rate_hz: float = 0.0
    format: str = ""
    check: str = ""
    ignored: Counter[str] = field(default_factory=Counter)
    timing: FrameClock = field(default_factory=FrameClock, compare=False, repr=False)
    identity: Identity = "known"
    header: Header | None = None
    other_header: Header | None = None
    bad_fraction: tuple[int, int, str, int | None] | None = None

    @property
    def bad_frames(self) -> int:
        """Number of frames that could not be decoded."""
        return self.bad.total()

    @property
    def clock(self) -> str:
        """What the device's clock and its counter were found to count; empty: as they should, or unknown."""
        timing = self.timing
        if not timing.trusted:
            return "the device's clock cannot be trusted: the host's is used"
        if not timing.confirmed:
            return ""
        unit = next(name for name, unit in UNITS.items() if unit == timing.unit)
        modulus = f", its counter wraps at {timing.modulus}" if timing.modulus else ""
        return f"the device's clock counts {unit}, by the host's clock{modulus}"

    @property
    def trouble(self) -> str:
        """A message about the current problem; empty if there is none."""
        if self.identity == "missing":
            return "the device has not sent its header since it was connected again"
        if self.identity == "other" and self.header and self.other_header:
            changes = self.other_header.changes(self.header)
            return f"the header of the device has changed, or another device is connected: {changes}"
        if self.bad_fraction is None:
            return ""
        bad, frames, reason, found = self.bad_fraction
        fraction = f"{bad} of {frames} frames in 2 s were bad"
        if reason == "fields":
            return f"{fraction}: the device sends {found} values per frame now"
        return f"{fraction} ({reason}): wrong baud rate or format?"

    def list_counts(self, **words: str) -> list[str]:
        """Return counts above 0 in words, as ``3 lost``; ``words`` has the word of each."""
        return [f"{count} {word}" for name, word in words.items() if (count := getattr(self, name))]


_CORRECTED = 6.0  # s in which the next header must correct a changed one: many devices repeat it every five
_LONGEST = 65536  # bytes of a line, and in which a format must show that needs a dozen frames of many lines


class Decoder:
    """Decodes bytes into frames; resynchronises at the next delimiter and never raises for its input.

    The format is detected, as the adapter describes it (of our protocol: two binary frames with a correct
    CRC, or three lines with equal numbers of fields), and then kept. Without a CRC, the bytes before the
    first delimiter are skipped: they may be half a frame.

    After a reconnection another device may be at the port. If the one before sent a header, frames count only
    once the same header has arrived, apart from its rate.

    Args:
        sensors: S; None: taken from the header or from eight lines.
        channels: the device's channel, from 0, of every sensor; empty: frames keep the device's order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        adapter: describes the frames; None: our protocol.

    Attributes:
        stats: numbers of frames and errors; kept by :meth:`restart`.
        frame_format: the format, once it is known.
        announcements: of an emulated skin, since it was connected; the latest 64.
    """

    def __init__(
        self,
        sensors: int | None = None,
        channels: Sequence[int] = (),
        polarity: Sequence[int] = (),
        adapter: Adapter | None = None,
    ) -> None:
        self.sensors, self.adapter = sensors, adapter or Adapter()
        self.stats, self.announcements = Stats(), deque[Announcement](maxlen=64)
        self._compared: tuple[float, int, int] | None = None  # s, good and bad frames until then
        self._latest_bad = FrameError("")
        self._changed_at = inf  # s, when another header came
        self._clock = self.stats.timing = FrameClock(modulus=self.adapter.modulus)
        self._latest = np.zeros(sensors or 0)
        self._channels = np.array(channels) if len(channels) else None
        self._polarity = np.array(polarity, dtype=float) if min(polarity, default=1) < 0 else None
        self._begin()

    @property
    def header(self) -> Header | None:
        """Of the device; None until it sends one."""
        return self.stats.header

    def _begin(self) -> None:
        self.frame_format: FrameFormat | None = None
        self.announcements.clear()
        self.stats.format = self.stats.check = ""
        self._buffer = b""
        self._count_seen: int | None = None
        self._receiving, self._fed_at, self._unseen = 0.0, float("nan"), 0
        self._whole = self._overlong = self._synchronous = False
        self._missing = 0

    def restart(self, after: After = "reconnect") -> None:
        """Start another connection: detect the format again, with the same number of sensors."""
        self._begin()
        self._clock.restart(after)
        self.stats.identity, self._changed_at = "missing" if self.header else "known", inf
        self.stats.bad_fraction = None

    def feed(self, data: bytes, now: float = 0.0) -> list[Frame]:
        """Return the frames that end in ``data``.

        Args:
            data: any bytes, cut anywhere.
            now: s, the host's monotonic clock at their arrival.
        """
        self.stats.bytes += len(data)
        passed, self._fed_at = now - self._fed_at, now
        if self.frame_format is None:
            # A silence counts for 0.2 s at most, because a board may take seconds to start.
            self._receiving += min(passed, 0.2) if passed > 0 else 0.0
            # Bounds the search while no format is recognised.
            self._buffer = self._buffer[-2 * self._enough :]
        self._buffer += data
        if self.frame_format is None and not self._recognise(data):
            return []
        assert self.frame_format is not None
        pieces, self._buffer = self.frame_format.split(self._buffer)
        self._compared = self._compared or (now, self.stats.frames, self.stats.bad_frames)
        frames = [frame for piece in pieces if (frame := self._frame(piece, now))]
        if frames and self._clocked:
            self._clock.judge(now, (self.header and self.header.speed) or 1.0)
        if len(self._buffer) > _LONGEST:
            self._buffer, self._overlong = b"", True
        self._compare(now, *self._compared)
        return frames

    def error(self, patience: float = 2.0) -> InputError | None:
        """Return an error once receiving shows no format, or if the header has changed; else None.

        Args:
            patience: s of receiving, or 4 kB or four frames; twice that, or 64 kB, of an adapter.
        """
        if self._fed_at - self._changed_at > _CORRECTED:
            return InputError(f"{self.stats.trouble}: start the command again to read this device")
        patience *= 1 if self.adapter.kind == "protocol" else 2
        if self.frame_format or (self._receiving < patience and len(self._buffer) < self._enough):
            return None
        return self.explain()

    def explain(self) -> InputError:
        """Return why no format was detected so far."""
        return self.adapter.explain(self._buffer, self._count_seen, self.sensors)

    @property
    def _enough(self) -> int:
        """Bytes in which the format must show: 4 kB, or four frames of 12 bytes a field."""
        return _LONGEST if self.adapter.kind != "protocol" else max(4096, 4 * 12 * (2 + (self.sensors or 0)))

    def _recognise(self, data: bytes) -> bool:
        """Buffer the first bytes until they show the format; they are then decoded from the first one on."""
        self._unseen += len(data)
        # What is left unread grows with what was read, or the time to read it all would grow as its square.
        if not self.adapter.may_end(self._buffer[-len(data) - 64 :]) or 16 * self._unseen < len(self._buffer):
            return False
        self._unseen = 0
        detected = self.adapter.detect(self._buffer, self.sensors)
        if not isinstance(detected, FrameFormat):
            self._count_seen = detected
            return False
        self.frame_format, self.sensors = detected, detected.sensors
        self.stats.format, self.stats.check = detected.name, detected.check
        # The next connection may send the keys in another order.
        self.adapter = replace(self.adapter, names=detected.keys) if detected.keys else self.adapter
        if (roles := detected.roles) and roles.unit is not None:
            self._clock.expect(roles.unit, self.adapter.time_unit is not None)
        self._all_valid = np.broadcast_to(np.True_, self.sensors)  # nobody can change it
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
                if raw.startswith(b"#"):
                    self._update_header(parse_header(raw))
                    self.announcements.extend(filter(None, [parse_announcement(raw)]))
                elif raw:
                    self.stats.ignored[kind_of_line(raw)] += 1
                return None
            if first and self.frame_format.check != "crc16":
                raise FrameError("structure")
            return self._place_frame(raw, now) if self.stats.identity == "known" else None
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
        stats = self.stats
        if header is None:
            return
        if stats.header is None or not header.changes(stats.header):
            stats.header = stats.header or header
            stats.identity, self._changed_at = "known", inf
        else:
            stats.identity, self._changed_at = "other", min(self._changed_at, self._fed_at)
        stats.other_header = header

    def _place_frame(self, raw: RawFrame, now: float) -> Frame:
        stats, clock, header = self.stats, self._clock, self.stats.header
        self._clocked = raw.ticks is not None and clock.trusted
        frame = clock.place(raw.seq, raw.ticks, now, self._missing, header.rate if header else None)
        stats.frames += 1
        stats.lost += frame.lost
        stats.resets += frame.after == "reset"
        self._synchronous, self._missing = True, 0
        if self._channels is not None:
            raw = raw._replace(values=raw.values[self._channels])
        values, valid, over = raw.values, self._all_valid, None
        if not raw.finite:
            over = np.isinf(values)
            limit = (
                2.0**header.bits - 1
                if self.adapter.limit is None and header and header.bits
                else self.adapter.limit
            )
            values = np.where(over, np.nan if limit is None else limit, values)
            valid = np.isfinite(values)
            stats.invalid += len(valid) - int(np.count_nonzero(valid))
            values = np.where(valid, values, self._latest)
        self._latest = values
        if self._polarity is not None and header and header.bits:
            # Channels whose values fall with force end at 0 counts.
            at_limit = (self._polarity < 0) & (values <= 0)
            over = at_limit if over is None else at_limit | over
        return frame._replace(values=values, valid=valid, saturated=over, polarity=self._polarity)

    def _compare(
        self, now: float, since: float, good: int, bad: int, span: float = 2.0, few: int = 3
    ) -> None:
        """Compare the good frames received by ``now``, s, with the bad ones, over ``span`` s at a time.

        Up to ``few`` bad frames are too few for a conclusion.
        """
        if now - since < span:
            return
        latest, good, bad = self._latest_bad, self.stats.frames - good, self.stats.bad_frames - bad
        most = bad > max(good, few)
        self.stats.bad_fraction = (bad, bad + good, latest.reason, latest.found) if most else None
        self._compared = now, self.stats.frames, self.stats.bad_frames


def kind_of_line(line: bytes, longest: int = 40) -> str:
    """Return the first characters of a line, with # for its numbers."""
    return re.sub(r"\d+", "#", line[:longest].decode("ascii", "replace").strip())
