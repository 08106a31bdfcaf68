"""What a device's numbers mean while it is watched: force above what the untouched skin reads."""

from collections.abc import Callable

import numpy as np

from skin.errors import InputError
from skin.port.baseline import rest
from skin.port.errors import SkinTouched
from skin.port.frame import Frame
from skin.port.text import Header
from skin.session import newtons as meanings
from skin.session.reduction import reduced

__all__ = ["Meaning", "Newtons"]

Meaning = Callable[[np.ndarray | None, Header | None], meanings.Newtons]
"""From a baseline (S,), or None, and what a device tells of itself to what its values mean; InputError where
nobody knows."""

_HEADER = 3.0  # s in which a device must tell its unit
_OFTEN = 0.2  # s between two attempts at a baseline


class Newtons:
    """Turns frames as sent into frames in N above the baseline.

    The baseline is that of the first quiet stretch; until then there are no frames, and ``waiting`` says why.
    It is kept over restarts of the device: nobody knows whether that happened under a touch.

    Args:
        meaning: what values mean.
        tare: s without touch that give the baseline, of values reduced as the model's are; 0: there is none.
        rate: of the model, Hz.
        header: what the device tells of itself, once it does.

    Attributes:
        waiting: why there are no frames; empty if there are.
    """

    def __init__(
        self,
        meaning: Meaning,
        tare: float,
        rate: float,
        header: Callable[[], Header | None] = lambda: None,
    ) -> None:
        self._meaning, self._header = meaning, header
        self._tare, self._rate = tare, rate
        self.waiting = "waiting for the first frame"
        self._known: meanings.Newtons | None = None
        self._quiet: list[Frame] = []
        self._first: float | None = None
        self._tried = -np.inf

    def __call__(self, frame: Frame) -> Frame | None:
        """Return a frame in N; None while unit or baseline are not known.

        Raises:
            InputError: the device does not tell what its numbers mean and nobody else does, or too short a
                tare.
        """
        if self._known is None and self._told(frame.t_host):
            self._known = self._settled(frame)
        if self._known is None:
            return None
        self.waiting = ""
        values = (frame.values - self._known.zero) * self._known.scale
        return frame._replace(values=values, valid=frame.valid & ~self._known.broken)

    def _told(self, now: float) -> bool:
        """Return whether it is known what numbers mean; a device may tell a little late."""
        self._first = now if self._first is None else self._first
        header = self._header()
        try:
            self._meaning(None, header)
        except InputError:
            if header is not None or now - self._first > _HEADER:
                raise
            self.waiting = "waiting for the device to tell its unit"
            return False
        return True

    def _settled(self, frame: Frame) -> meanings.Newtons | None:
        """Take the baseline from the last quiet frames, if they are long enough and quiet."""
        if not self._tare:
            return self._meaning(None, self._header())
        if self._quiet and self._quiet[-1].segment != frame.segment:
            self._quiet.clear()
        self._quiet.append(frame)
        while frame.t - self._quiet[0].t > 1.5 * self._tare:
            self._quiet.pop(0)
        if frame.t - self._quiet[0].t < self._tare:
            self.waiting = "taking the baseline: do not touch the skin"
        elif frame.t_host - self._tried >= _OFTEN:
            self._tried = frame.t_host
            return self._rested()
        return None

    def _rested(self) -> meanings.Newtons | None:
        intervals = int(self._tare * self._rate + 1e-6)
        begin = self._quiet[-1].t - intervals / self._rate
        newest = [frame for frame in self._quiet if frame.t >= begin]
        try:
            baseline = rest(*reduced(newest, begin, self._rate, intervals))
        except SkinTouched as touched:
            self.waiting = f"no baseline yet: {str(touched).split(';')[0]}"
            return None
        return self._meaning(baseline, self._header())
