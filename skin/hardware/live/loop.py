"""The live loop: read frames, classify, update the views."""

from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic

import numpy as np

from skin.hardware.live.display import Display
from skin.hardware.live.engine import Engine
from skin.hardware.live.verdict import Verdict
from skin.signal.frame import Frame
from skin.wire.conversion import UnitConversion
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.skin import Skin
from skin.wire.tare import Tare

STALE = 1.5
"""s without frames after which nothing is known of the skin."""
FROZEN_READINGS = "readings are frozen: no channel has changed for 5 s"
_PATIENCE = 0.3  # s for which one read waits
_AT_ONCE = 1024  # frames
_STATUS = 0.5  # s between two updates of the status
_ENOUGH = 10  # frames for each one of the model: with n, a tap of one frame reads 1/n too low at worst
_DELAYS = 2000  # verdicts for the percentile of the delay


class LiveLoop:
    """Classifies the frames of a skin until the recording ends, the time is over, a view closes, or Ctrl-C.

    What it decides depends on the frames alone (:class:`skin.hardware.live.engine.Engine`); the load of the
    computer can only delay it.

    Args:
        skin: open.
        tare: gives the conversion of values to N.
        engine: gives verdicts.
        display: shows them.
        before: called once with the conversion, before the first decision; it may raise InputError.

    Attributes:
        verdicts: number of verdicts so far.
    """

    def __init__(
        self,
        skin: Skin,
        tare: Tare,
        engine: Engine,
        display: Display,
        before: Callable[[UnitConversion], None] | None = None,
    ) -> None:
        self._skin, self._tare, self._engine, self._display = skin, tare, engine, display
        self._before, self._heard_at = before, monotonic()
        self._delays: deque[float] = deque(maxlen=_DELAYS)
        self._updated_at = -np.inf
        self.verdicts = 0

    def run(self, seconds: float | None = None) -> None:
        """Run the loop.

        Args:
            seconds: duration, s; None: no limit.

        Raises:
            InputError: nothing can be read, the stream is too slow, its scale is unknown, or the self-test
                failed.
        """
        until = np.inf if seconds is None else monotonic() + seconds
        while monotonic() < until and not self._display.closed.is_set():
            try:
                frames = self._skin.read(1, _PATIENCE)
            except SkinTimeout as silent:
                self._wait(str(silent).split(": ", 1)[-1])
            except SkinDisconnected:
                return
            else:
                self._take(frames + self._waiting())
            self._update_status()

    def _wait(self, reason: str) -> None:
        """Show why no frames come, once they are overdue: those of a bridge come in bursts."""
        if monotonic() - self._heard_at >= STALE or self._skin.away:
            self._display.set_verdict(None, reason, self._engine.alarm)

    @property
    def p99(self) -> float:
        """Seconds from a frame to the verdict on it that 99 of 100 verdicts do not exceed."""
        return float(np.percentile(self._delays, 99)) if self._delays else float("nan")

    def _waiting(self) -> list[Frame]:
        """Return the other frames that have arrived."""
        try:
            return self._skin.read(_AT_ONCE, 0.0)
        except (SkinTimeout, SkinDisconnected) as few:
            return few.frames

    def _take(self, frames: list[Frame]) -> None:
        self._heard_at = monotonic()
        if request := self._display.take_tare():
            self._tare.restart(force=request == "forced")
        taken = self._tare.count
        for frame in frames:
            self._tare.add(frame, self._engine.contact or self._engine.alarm)
        conversion = self._tare.conversion
        if conversion is None:
            self._engine.push(frames, None)
            self._display.set_verdict(None, self._tare.status, self._engine.alarm)
            return
        if self._tare.count > taken:
            self._engine.reset()
        if self._before is not None:
            self._before(conversion)
            self._before = None
        for frame in frames:
            self._display.add_frame(frame, conversion)
        self._show(self._engine.push(frames, conversion))

    def _show(self, verdicts: Sequence[Verdict]) -> None:
        """Show the verdicts that were due; none while the readings are frozen."""
        if self._engine.frozen:
            self._display.set_verdict(None, FROZEN_READINGS, self._engine.alarm)
            return
        for verdict in verdicts:
            self.verdicts += 1
            self._display.set_verdict(verdict)
        if verdicts:
            self._delays.append(monotonic() - verdicts[-1].t_host)

    def _update_status(self) -> None:
        now = monotonic()
        if now - self._updated_at >= _STATUS:
            self._updated_at = now
            self._display.set_status(self.line)

    @property
    def _rate(self) -> str:
        """Text with the rate of the device, and what it misses."""
        rate, model = self._skin.stats.rate_hz, self._engine.window.rate
        slow = f" (short taps read low below {_ENOUGH * model:g} Hz)"
        return f"{rate:.1f} Hz" + slow * (0 < rate < 0.95 * _ENOUGH * model)

    @property
    def line(self) -> str:
        """Text with rate, lost frames, broken sensors and delay."""
        stats = self._skin.stats
        counts = {
            "bad": stats.bad_frames,
            "lost": stats.lost,
            "dropped": stats.dropped,
            "restarts": stats.resets,
            "reconnected": stats.reconnects,
        }
        faulty = [
            f"sensor {number} {state}" for number, state in enumerate(self._skin.channels) if state != "ok"
        ]
        parts = [
            self._tare.status if self._tare.conversion is not None else "",
            self._tare.warning,
            self._rate,
            *(f"{count} {name}" for name, count in counts.items() if count),
            *faulty[:3],
            f"and {len(faulty) - 3} more" if len(faulty) > 3 else "",
            f"frame to verdict {1e3 * self.p99:.1f} ms (p99)" if self._delays else "",
            stats.trouble,
        ]
        return ", ".join(part for part in parts if part)
