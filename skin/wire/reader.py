"""The reader thread and its queue of frames."""

import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from threading import Condition, Event, Thread
from time import monotonic

from skin.errors import InputError
from skin.signal.frame import Frame
from skin.wire.errors import SkinDisconnected
from skin.wire.feed import Feed

_log = logging.getLogger("skin.wire")

_PAUSE = 0.002  # s between two reads of the port: fewer and larger pieces cost a tenth of the time
_RATE = 256  # frames over which the rate is taken
_WAKE = 0.2  # s: longer waits for a lock would block Ctrl-C on Windows


class Reader:
    """Reads frames until it is closed. A full queue drops its oldest frame; the next one counts it as lost.

    Args:
        connect: opens the feed; called again after each disconnection.
        queue: largest number of frames in the queue.
        reconnect: try to open the feed again after a disconnection.
        backoff: s before the first attempt, and the longest between two; it doubles until frames arrive.

    Attributes:
        dropped: number of frames dropped from a full queue.
        reconnects: number of reconnections.
        away: the feed is disconnected and being reopened.
        error: why the thread ended; EOFError at the end of a recording.
    """

    def __init__(
        self, connect: Callable[[], Feed], queue: int, reconnect: bool, backoff: tuple[float, float]
    ) -> None:
        self._connect, self._reconnect, self._backoff = connect, reconnect, backoff
        self._wait = backoff[0]
        self.dropped = self.reconnects = 0
        self.away = False
        self.error: Exception | None = None
        self._frames: deque[Frame] = deque()
        self._most = queue
        self._times: deque[float] = deque(maxlen=_RATE)
        self._stop, self._fresh = Event(), Condition()
        self.feed = connect()
        self._thread = Thread(target=self._run, name="skin-reader", daemon=True)
        self._thread.start()

    @property
    def rate(self) -> float:
        """Frames per second over the last frames of a segment, by the device's clock, Hz; 0 if unknown."""
        with self._fresh:
            times = self._times
            passed = times[-1] - times[0] if len(times) > 1 else 0.0
            return (len(times) - 1) / passed if passed > 0 else 0.0

    def take(self, count: int, timeout: float) -> Iterator[Frame]:
        """Yield frames as they arrive: ``count``, or fewer if ``timeout`` s pass or the thread ends."""
        deadline = monotonic() + timeout
        for _ in range(count):
            with self._fresh:
                while not self._frames:
                    left = deadline - monotonic()
                    if self.error is not None or left <= 0:
                        return
                    self._fresh.wait(min(left, _WAKE))
                frame = self._frames.popleft()
                self._fresh.notify_all()
            yield frame

    def close(self) -> None:
        """End the thread, then close the source."""
        self._stop.set()
        with self._fresh:
            self._fresh.notify_all()
        self._thread.join(timeout=5)
        with suppress(OSError):
            self.feed.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._step()
        except Exception as error:
            with self._fresh:
                self.error = error
                self._fresh.notify_all()

    def _step(self) -> None:
        try:
            frames = self.feed.poll()
        except OSError as error:
            with suppress(OSError):
                self.feed.close()
            if not self._reconnect:
                raise SkinDisconnected(f"the skin was unplugged: {error}") from error
            _log.warning("the skin was unplugged (%s); trying again", error)
            self._reopen()
            return
        if frames:
            self._wait = self._backoff[0]
            self._push(frames)
            if not self.feed.patient:
                self._stop.wait(_PAUSE)

    def _reopen(self) -> None:
        self.away = True
        while not self._stop.wait(self._wait):
            self._wait = min(2 * self._wait, self._backoff[1])
            with suppress(OSError, InputError):
                self.feed = self._connect()
                self.reconnects += 1
                self.away = False
                return

    def _push(self, frames: list[Frame]) -> None:
        with self._fresh:
            for frame in frames:
                if frame.after not in ("", "gap"):
                    self._times.clear()
                self._times.append(frame.t)
                while self.feed.patient and len(self._frames) >= self._most and not self._stop.is_set():
                    self._fresh.wait(_WAKE)
                self._frames.append(frame)
                if len(self._frames) > self._most:
                    dropped = self._frames.popleft()
                    self._frames[0] = self._frames[0].behind(dropped)
                    self.dropped += 1
                self._fresh.notify_all()
