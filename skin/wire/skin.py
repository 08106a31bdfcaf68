"""An open skin: ``with open_skin("/dev/ttyACM0", layout=sensors) as skin: ...``; its tare and its newtons.

torch is not imported.
"""

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from threading import Condition, Event, Thread
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from skin.device.calibration import read_calibration
from skin.device.resampling import Frame, check_rate
from skin.errors import InputError
from skin.wire.channels import RawRange, UnitConversion, check_sensitivity, unit_conversion
from skin.wire.decoder import Decoder, Stats
from skin.wire.formats import runs
from skin.wire.protocol import Announcement, Header
from skin.wire.reader import (
    ByteStream,
    PlaybackFeed,
    Port,
    PortStream,
    SkinDisconnected,
    SkinTimeout,
    WireFeed,
)
from skin.wire.tare import HEADER, PATIENCE, SkinTouched, Tare, take_baseline

if TYPE_CHECKING:
    from skin.body.base import Layer
    from skin.device.touches import Touches


_log = logging.getLogger(__name__)


class Skin(AbstractContextManager["Skin"]):
    """Frames from an open skin; iterate over it, or :meth:`read` a block.

    Values are in the device's unit; ``frame.values - skin.baseline`` is the change due to touch. A thread
    reads them until the skin is closed. A full queue drops its oldest frame; the next one counts it as lost.

    Args:
        feed: open.
        decoder: of the feed; None: it needs none.
        port: with timeout and backoff.
        baseline: from an earlier tare.
        queue: largest number of frames in the queue.
        reconnect: try to open the feed again after a disconnection.
        clock: gives the host's monotonic time, s.
        pause: s between two reads of the port: fewer and larger pieces cost a tenth of the time.
        wake: s; longer waits for a lock would block Ctrl-C on Windows.

    Attributes:
        baseline: (S,), values of the untouched skin, in the device's unit; None before the first tare.
        away: the skin is unplugged and being reopened.
    """

    def __init__(
        self,
        feed: WireFeed | PlaybackFeed,
        decoder: Decoder | None,
        port: Port,
        baseline: np.ndarray | None,
        queue: int,
        reconnect: bool = False,
        clock: Callable[[], float] = monotonic,
        pause: float = 0.002,
        wake: float = 0.2,
    ) -> None:
        self._feed, self._decoder, self._clock, self._pause, self._wake = feed, decoder, clock, pause, wake
        self._stats = Stats() if decoder is None else decoder.stats
        self._timeout, self._backoff, self._wait = port.timeout, port.backoff, port.backoff[0]
        self.baseline = baseline
        self._maximum, self._reconnect, self.away = queue, reconnect, False
        self._error: Exception | None = None  # why the thread ended; EOFError at the end of a recording
        self._frames: deque[Frame] = deque()
        self._times: deque[float] = deque(maxlen=256)  # over which the rate is taken
        self._stop, self._fresh = Event(), Condition()
        self._thread = Thread(target=self._run, name="skin-reader", daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and close the port."""
        self._stop.set()
        with self._fresh:
            self._fresh.notify_all()
        self._thread.join(timeout=5)
        with suppress(OSError):
            self._feed.close()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames as they arrive, to the end of a recording.

        Raises:
            SkinTimeout: no frame arrived within the timeout, though the skin was not disconnected.
            SkinDisconnected: it was unplugged, and ``reconnect`` is not set.
        """
        while True:
            reconnects = self._stats.reconnects
            try:
                yield from self.read(1)
            except SkinTimeout:
                if not self.away and self._stats.reconnects == reconnects:
                    raise
            except SkinDisconnected:
                if isinstance(self._error, EOFError):
                    return
                raise

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
        deadline, frames = self._clock() + timeout, list[Frame]()
        while len(frames) < count:
            with self._fresh:
                while not self._frames:
                    left = deadline - self._clock()
                    if self._error is not None or left <= 0:
                        raise self._explain(count, timeout, frames)
                    self._fresh.wait(min(left, self._wake))
                frames.append(self._frames.popleft())
            self._stats.frames += self._decoder is None
        return frames

    def skip(self, kept: float) -> None:
        """Discard the waiting frames that arrived more than ``kept`` s ago."""
        while self._frames and self._clock() - self._frames[0].t_host > kept:
            self.read(1)

    def tare(self, seconds: float = 1.0, force: bool = False) -> np.ndarray:
        """Set the baseline to the readings of the untouched skin, and return it, (S,).

        Args:
            seconds: of frames from now on.
            force: set it even if the skin seems touched.

        Raises:
            InputError: the skin is touched or was restarted meanwhile, or too few frames arrived; the old
                baseline is kept.
        """
        frames, start = list[Frame](), self._clock()
        while not frames or frames[-1].t_host < start + seconds:
            frames += [frame for frame in self.read(1) if frame.t_host >= start]
        if frames[0].segment != frames[-1].segment:
            raise InputError("the skin was restarted meanwhile: tare again; the old baseline is kept")
        values, valid = (np.stack([getattr(frame, name) for frame in frames]) for name in ("values", "valid"))
        self.baseline = take_baseline(values, valid, self.baseline, force)
        return self.baseline

    @property
    def header(self) -> Header | None:
        """The header that the device sent; None if it sent none."""
        return self._decoder.header if self._decoder else None

    @property
    def channels(self) -> tuple[str, ...]:
        """State of each channel at the last frame; empty if channels are not checked."""
        return self._feed.states

    @property
    def announcements(self) -> deque[Announcement]:
        """Announcements of an emulated skin that have not been read yet."""
        return self._decoder.announcements if self._decoder else deque()

    @property
    def stats(self) -> Stats:
        """Statistics of what was received so far."""
        with self._fresh:
            times = self._times
            passed = times[-1] - times[0] if len(times) > 1 else 0.0
            # By the device's clock, over the last frames of a segment.
            rate = (len(times) - 1) / passed if passed > 0 else 0.0
        return replace(self._stats, bad=Counter(self._stats.bad), rate_hz=rate)

    def _explain(self, count: int, timeout: float, frames: list[Frame]) -> Exception:
        """Return the error that explains why ``count`` frames are not available."""
        error, stats = self._error, self._stats
        if isinstance(error, SkinDisconnected | EOFError):
            return SkinDisconnected(str(error), frames)
        if error is not None:
            return error
        if self.away:
            reason = "the skin is unplugged; trying again"
        elif self._feed.unanswered or self._decoder is None or stats.frames:
            reason = self._feed.unanswered or stats.trouble or "the device stopped sending"
        elif not stats.bytes:
            reason = "port open, nothing received; is the device sending?"
        else:
            reason = stats.trouble or str(self._decoder.explain())
        return SkinTimeout(f"{len(frames)} of {count} frames arrived within {timeout:g} s: {reason}", frames)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    frames = self._feed.poll(self._clock)
                except OSError as error:
                    self._reopen(error)
                    continue
                if frames:
                    self._wait = self._backoff[0]
                    self._push(frames)
                    self._stop.wait(self._pause)
        except Exception as error:
            with self._fresh:
                self._error = error
                self._fresh.notify_all()

    def _reopen(self, error: OSError) -> None:
        """Open the feed again; the wait between two attempts doubles until frames arrive."""
        with suppress(OSError):
            self._feed.close()
        if not self._reconnect:
            raise SkinDisconnected(f"the skin was unplugged: {error}") from error
        _log.warning("the skin was unplugged (%s); trying again", error)
        self.away = True
        while self.away and not self._stop.wait(self._wait):
            self._wait = min(2 * self._wait, self._backoff[1])
            with suppress(OSError, InputError):
                self._feed.open()
                self._stats.reconnects += 1
                self.away = False

    def _push(self, frames: list[Frame]) -> None:
        with self._fresh:
            for frame in frames:
                if frame.after not in ("", "gap"):
                    self._times.clear()
                self._times.append(frame.t)
                self._frames.append(frame)
                if len(self._frames) > self._maximum:
                    dropped = self._frames.popleft()
                    self._frames[0] = self._frames[0].behind(dropped)
                    self._stats.dropped += 1
                self._fresh.notify_all()


def open_skin(
    port: str | Port,
    layout: Sized | None = None,
    *,
    opener: Callable[[], ByteStream] | None = None,
    baseline: np.ndarray | None = None,
    channels: Sequence[int] = (),
    polarity: Sequence[int] = (),
    queue: int = 4096,
    reconnect: bool = False,
    inwards: bool = False,
    **settings: Any,
) -> Skin:
    """Open a skin; use it in a ``with`` statement.

    Args:
        port: ``/dev/ttyACM0``, ``COM3`` or ``socket://host:number``; or the settings of a port.
        layout: the sensors (anything with a length); None: their number is detected.
        opener: opens the stream of bytes instead of ``port``, and again after each disconnection.
        baseline: (S,), from an earlier tare.
        channels: the device's channel of every sensor, as in a calibration; empty: the same order.
        polarity: 1 or -1 per sensor, -1 where values fall with force; empty: 1 for all.
        queue: number of frames that are buffered.
        reconnect: wait for an unplugged skin; its next frame has ``after="reconnect"``.
        inwards: of sites with three axes, frames have the channels inwards; ``three`` has all.
        settings: baudrate, adapter, limits, timeout, backoff and silence, as in :class:`Port`.

    Raises:
        InputError: there is nothing at ``port``, it may not be opened or is in use, or a setting is wrong.
    """
    if unused := sorted({"tare", "scale", "calibration"} & settings.keys()):
        raise InputError(f"open_skin gives values as the device sends them: leave out {unused[0]}")
    about = port if isinstance(port, Port) else Port(port=port, **settings)
    if not (isinstance(queue, int) and queue > 0):
        raise InputError(f"queue={queue} must be a whole number above 0: leave it out for 4096")
    address, sensors = str(about.port), None if layout is None else len(layout)
    if about.frames.kind == "auto":
        raise InputError("skin listen adapter=auto proposes an adapter: give device.adapter=FILE.yaml of it")
    decoder = Decoder(sensors, channels=channels, polarity=polarity, adapter=about.frames)
    watched = reconnect and address.startswith("socket://")
    opener = opener or partial(PortStream, address, about.baudrate)
    try:
        silence = (watched and about.silence) or inf
        feed = WireFeed(opener, decoder, about.limits, silence, inwards=inwards)
    except OSError as error:
        raise InputError(f"cannot open {address}: {error}") from error
    return Skin(feed, decoder, about, baseline, queue, reconnect)


def play(strips: "Iterable[Touches]") -> Skin:
    """Return touches in N, all with one rate, as frames in real time, each a segment."""
    return Skin(PlaybackFeed(strips), None, Port(), None, 4096)


@dataclass(frozen=True)
class Source:
    """An open stream of frames and its tare.

    Attributes:
        name: shown in the live view.
        skin: open.
        tare: converts frames to N.
        port: that the frames come from; None: a recording or the simulator.
    """

    name: str
    skin: Skin
    tare: Tare
    port: "SerialSource | None" = None

    @property
    def raw_range(self) -> RawRange:
        """The values that the device can send, as far as it declares them."""
        header, limits = self.skin.header, self.port.settings.limits if self.port else None
        if header is not None and header.bits:
            largest = 2.0**header.bits - 1
            return RawRange(0.0, largest, header.unit != "N", limits or (None, largest))
        limits = limits or (None, None)
        return RawRange(*limits, limits=limits)

    @property
    def calibrated_rest(self) -> np.ndarray | None:
        """Values of the untouched sensors, (S,), when the device was calibrated; None: it was not."""
        if self.port is None or self.port.settings.calibration is None:
            return None
        return self.port.convert(None, self.skin.header).zero

    @classmethod
    def in_newtons(cls, name: str, skin: Skin, sensors: int) -> "Source":
        """Return a source whose values are already in N."""
        # No baseline is taken: a run trained on such values expects their offsets.
        conversion = unit_conversion(sensors, None, 1.0, None, None)
        return cls(name, skin, Tare(lambda baseline, header: conversion, 0.0, 1.0))


class SerialSource:
    """A skin at a port, with its conversion to N.

    Args:
        settings: of the port.
        sensors: S.
        rate: of the model, Hz.
        layers: of the body; empty: unknown.
        inwards: the device sends three values for each of S sites, of which the last is used.

    Attributes:
        three: the same port with the sensors of all axes, if ``inwards``; else None.
        channels: the device's channel of every sensor; empty: the same order.
        polarity: 1 or -1 per sensor, -1 where the value falls with force; empty: 1 for all.

    Raises:
        InputError: a calibration of another number of sensors, or a conversion that contradicts
            ``device.sensitivity``.
    """

    def __init__(
        self,
        settings: Port,
        sensors: int,
        rate: float,
        layers: "Sequence[Layer]" = (),
        inwards: bool = False,
    ) -> None:
        self.settings, self._sensors, self._rate, self.layers = settings, sensors, rate, layers
        # The sensitivity is that of sensors inwards.
        self.three = SerialSource(replace(settings, sensitivity=None), 3 * sensors, rate) if inwards else None
        path = settings.calibration
        calibration = self._calibration = None if path is None else read_calibration(path, inwards)
        self.channels = calibration.channels if calibration else ()
        falling = [-1] * sensors if (settings.scale or 0) < 0 else ()
        self.polarity: Sequence[int] = calibration.polarity if calibration else falling
        if settings.scale is not None or calibration is not None:
            self.convert(None, None)

    def open(self, reconnect: bool = False) -> Skin:
        """Open the port; ``reconnect`` waits for an unplugged skin."""
        if self.settings.port is None:
            raise InputError("device=serial needs a port, device.port=/dev/ttyACM0; skin emulate makes one")
        sent = self.three or self
        return open_skin(
            self.settings,
            range(sent._sensors),
            reconnect=reconnect,
            channels=sent.channels,
            polarity=sent.polarity,
            inwards=self.three is not None,
        )

    def open_source(self) -> Source:
        """Open the port as a stream of frames; wait for an unplugged skin."""
        skin = self.open(reconnect=True)
        return Source(str(self.settings.port), skin, self.tare(skin), self)

    def tare(self, skin: Skin) -> Tare:
        """Return the tare of an open skin."""
        return Tare(
            self.convert,
            self.settings.tare,
            self._rate,
            lambda: skin.header,
            three=None if self.three is None else self.three.tare(skin),
        )

    def convert(self, baseline: np.ndarray | None, header: Header | None) -> UnitConversion:
        """Return the conversion of values to N, given a baseline (S,) and the header of the device.

        Raises:
            InputError: the scale is unknown, or contradicts ``device.sensitivity``.
        """
        conversion = unit_conversion(self._sensors, baseline, self.settings.scale, self._calibration, header)
        check_sensitivity(conversion, self.settings.sensitivity)
        return conversion

    def warm_up(
        self, skin: Skin, notify: Callable[[str], None], minimum: float = 1.0
    ) -> tuple[list[Frame], UnitConversion]:
        """Read frames until rate, conversion and device are known; return all of them, and the conversion.

        Args:
            skin: just opened.
            notify: called with each message for the user.
            minimum: s over which the rate is measured.

        Raises:
            InputError: no frames arrive, the device is too slow, or the scale is unknown.
            SkinTouched: the skin was still touched after a minute.
        """
        tare, frames, measured = self.tare(skin), list[Frame](), False
        minimum = max(self.settings.tare, minimum)
        # Other formats than our protocol have no header.
        patience = HEADER if self.settings.frames.kind == "protocol" else 0.0
        notify("reading the untouched skin: keep off")
        while True:
            try:
                frames += skin.read(1)
            except (SkinTimeout, SkinDisconnected) as error:
                raise InputError(f"{self.settings.port}: {error}") from error
            if frames[-1].segment != frames[0].segment:
                del frames[:-1]
            tare.add(frames[-1])
            passed = frames[-1].t - frames[0].t
            if len(frames) < 3 or passed < minimum:
                continue
            if not measured:
                # By the device's clock, with lost frames.
                check_rate((len(frames) - 1 + sum(frame.lost for frame in frames[1:])) / passed, self._rate)
            if tare.conversion is not None and (skin.header is not None or passed >= patience):
                return frames, tare.conversion
            if not measured and tare.state in ("touched", "limited"):
                notify("the skin is touched: let go")
            measured = True
            if tare.conversion is None and passed > minimum + PATIENCE:
                raise SkinTouched(tare.status)


class PortMonitor:
    """Collects statistics of an open skin.

    Args:
        skin: open.
        kept: frames for the statistics of channels.
    """

    def __init__(self, skin: Skin, kept: int = 10_000) -> None:
        self._skin = skin
        self._frames: deque[Frame] = deque(maxlen=kept)

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
        line = f"{stats.format}, {checksum}, {sensors} sensors, {stats.rate_hz:.4g} Hz, {frames}"
        return "; ".join(filter(None, (line, stats.clock, stats.trouble)))

    def summary(self) -> str:
        """Return the header, and the minimum, median, maximum, noise and state of each channel."""
        if not self._frames:
            return "nothing received"
        values = np.stack([frame.values for frame in self._frames])
        valid = np.stack([frame.valid for frame in self._frames])
        states = self._skin.channels or ("ok",) * values.shape[1]
        # Of a channel that is never valid, the values that it repeats.
        rows = [row[mask] if mask.any() else row for row, mask in zip(values.T, valid.T, strict=True)]
        lines = [f"header: {self._skin.header or 'none'}", "channel     least    median   largest     noise"]
        for channel, (row, state, fraction) in enumerate(zip(rows, states, valid.mean(axis=0), strict=True)):
            middle = np.median(row)
            noise = 1.4826 * np.median(np.abs(row - middle))  # as of a normal distribution
            text = state if fraction == 1 else f"{state}, invalid in {1 - fraction:.0%}"
            if fraction == 0 and state == "ok":
                text = "no value"
            elif runs(row):
                text = "a clock or counter, no sensor: skin listen adapter=auto describes such a board"
            lines.append(f"{channel:7d}{row.min():10.5g}{middle:10.5g}{row.max():10.5g}{noise:10.3g}  {text}")
        return "\n".join(lines)
