"""The live loop: read frames, classify, update the views."""

from collections import deque
from time import monotonic

import numpy as np

from skin.hardware.live.board import Board
from skin.hardware.live.engine import Engine
from skin.signal.frame import Frame
from skin.wire.errors import SkinDisconnected, SkinTimeout
from skin.wire.skin import Skin
from skin.wire.tare import Tare

_PATIENCE = 0.3  # s of silence after which no verdict holds
_AT_ONCE = 1024  # frames
_TOLD = 0.5  # s between two lines about the state
_DELAYS = 2000  # verdicts over which the delay is taken


class Session:
    """Watches a skin until its recording ends, the time is over, or Ctrl-C.

    Frames that came while another was classified slide through the window unasked, so the verdict is always
    about the latest; what they showed is still in the window.

    Args:
        skin: open.
        tare: finds out what its values mean.
        engine: what gives verdicts.
        board: where they are shown.

    Attributes:
        verdicts: how many there were.
    """

    def __init__(self, skin: Skin, tare: Tare, engine: Engine, board: Board) -> None:
        self._skin, self._tare, self._engine, self._board = skin, tare, engine, board
        self._delays: deque[float] = deque(maxlen=_DELAYS)
        self._told = -np.inf
        self.verdicts = 0

    def run(self, seconds: float | None = None) -> None:
        """Watch.

        Raises:
            InputError: nothing can be read, the stream is too slow, or its numbers have no known meaning.
        """
        until = np.inf if seconds is None else monotonic() + seconds
        while monotonic() < until:
            try:
                frames = self._skin.read(1, _PATIENCE)
            except SkinTimeout as silent:
                self._board.say(None, str(silent).split(": ", 1)[-1], self._engine.alarm)
            except SkinDisconnected:
                return
            else:
                self._take(frames + self._waiting())
            self._tell()

    @property
    def p99(self) -> float:
        """Seconds from a frame to the verdict on it that 99 of 100 verdicts do not exceed."""
        return float(np.percentile(self._delays, 99)) if self._delays else float("nan")

    def _waiting(self) -> list[Frame]:
        """Return what else has come."""
        try:
            return self._skin.read(_AT_ONCE, 0.0)
        except (SkinTimeout, SkinDisconnected) as few:
            return few.frames

    def _take(self, frames: list[Frame]) -> None:
        if self._board.tare.is_set():
            self._board.tare.clear()
            self._tare.again()
        taken = self._tare.count
        for frame in frames:
            self._tare.add(frame)
        newtons = self._tare.newtons
        for frame in frames[:-1]:
            self._engine.add(frame)
        if newtons is None:
            self._engine.add(frames[-1])
            self._board.say(None, self._tare.waiting)
            return
        if self._tare.count > taken:
            self._engine.tared()
        for frame in frames:
            self._board.show(frame, newtons)
        verdict = self._engine.push(frames[-1], newtons)
        if verdict is None:
            self._board.say(None, f"filling the window: {100 * self._engine.window.filled:.0f} %")
        else:
            self._delays.append(monotonic() - verdict.t_host)
            self.verdicts += 1
            self._board.say(verdict)

    def _tell(self) -> None:
        now = monotonic()
        if now - self._told >= _TOLD:
            self._told = now
            self._board.tell(self.line)

    @property
    def line(self) -> str:
        """Rate, what was lost, sensors that say nothing, and delay, for a person."""
        stats = self._skin.stats
        counts = {
            "bad": stats.bad_frames,
            "lost": stats.lost,
            "dropped": stats.dropped,
            "restarts": stats.resets,
            "reconnected": stats.reconnects,
        }
        sick = [
            f"sensor {number} {state}" for number, state in enumerate(self._skin.channels) if state != "ok"
        ]
        parts = [
            self._tare.waiting if self._tare.newtons is not None else "",
            f"{stats.rate_hz:.1f} Hz",
            *(f"{count} {name}" for name, count in counts.items() if count),
            *sick[:3],
            f"and {len(sick) - 3} more" if len(sick) > 3 else "",
            f"frame to verdict {1e3 * self.p99:.1f} ms (p99)" if self._delays else "",
            stats.trouble,
        ]
        return ", ".join(part for part in parts if part)
