"""The tare: the baseline of an untouched skin, taken and kept while it is read."""

from collections.abc import Callable
from dataclasses import replace
from math import inf

import numpy as np

from skin.errors import InputError
from skin.signal.frame import Frame
from skin.signal.resampling import Window, check_rate
from skin.wire.baseline import quiet_baseline
from skin.wire.conversion import UnitConversion
from skin.wire.errors import SkinTouched
from skin.wire.skin import Skin
from skin.wire.text import Header

MakeConversion = Callable[[np.ndarray | None, Header | None], UnitConversion]
"""From a baseline (S,), or None, and what a device tells of itself to what its values mean; InputError where
nobody knows."""

_HEADER = 3.0  # s in which a device must tell its unit
_OFTEN = 0.2  # s between two attempts at a baseline
_PATIENCE = 60.0  # s for which a touch may delay the baseline
_LEAST = 1.0  # s in which the rate shows
_UNTOUCHED = "taking the baseline: do not touch the skin"


class Tare:
    """Takes the baseline from the first quiet stretch of a stream, and again when an operator asks.

    The baseline is that of values resampled to the model's rate: the maximum of noise is not 0. It is kept
    over restarts of the device, because the restart may have happened under a touch. A sensor that is at its
    limit during the whole stretch is pressed or broken: it is unknown until the next tare.

    Args:
        conversion: what values mean.
        seconds: s without touch that give the baseline; 0: there is none.
        rate: of the model, Hz.
        header: what the device tells of itself, once it does.

    Attributes:
        conversion: what values mean; None until unit and baseline are known.
        status: what is being waited for; empty if nothing is.
        count: how many baselines were taken.
    """

    def __init__(
        self,
        conversion: MakeConversion,
        seconds: float,
        rate: float,
        header: Callable[[], Header | None] = lambda: None,
    ) -> None:
        self._conversion, self._header = conversion, header
        self._seconds, self._rate = seconds, rate
        self.conversion: UnitConversion | None = None
        self.status = "waiting for the first frame"
        self.count = 0
        self._quiet: list[Frame] = []
        self._first: float | None = None
        self._tried = -inf
        self._deadline: float | None = None

    def restart(self) -> None:
        """Take a new baseline from the next quiet stretch: an operator says that nothing touches the skin.

        After a minute without a quiet stretch the old baseline stays.
        """
        if self._seconds and self.conversion is not None:
            self._quiet.clear()
            self._deadline = inf
            self.status = _UNTOUCHED

    def add(self, frame: Frame) -> None:
        """Look at a frame.

        Raises:
            InputError: nobody knows what values mean, or too short a tare.
        """
        if self.conversion is not None and self._deadline is None:
            return
        if self._deadline is not None:
            self._deadline = min(self._deadline, frame.t_host + _PATIENCE)
            if frame.t_host > self._deadline:
                self._deadline, self.status = None, ""
                return
        if not self._conversion_known(frame.t_host):
            return
        if self._seconds:
            self._collect(frame)
        else:
            self.conversion, self.status = self._conversion(None, self._header()), ""

    def _conversion_known(self, now: float) -> bool:
        """Return whether it is known what values mean; a device may tell a little late."""
        self._first = now if self._first is None else self._first
        header = self._header()
        try:
            self._conversion(None, header)
        except InputError:
            if header is not None or now - self._first > _HEADER:
                raise
            self.status = "waiting for the device to tell its unit"
            return False
        return True

    def _collect(self, frame: Frame) -> None:
        """Take the baseline from the latest frames if they are long enough and quiet."""
        if self._quiet and self._quiet[-1].segment != frame.segment:
            self._quiet.clear()
            self._tried = -inf
        self._quiet.append(frame)
        while frame.t - self._quiet[0].t > 1.5 * self._seconds:
            self._quiet.pop(0)
        if frame.t - self._quiet[0].t < self._seconds:
            self.status = _UNTOUCHED
        elif frame.t - self._tried >= _OFTEN:
            self._tried = frame.t
            self._try_baseline()

    def _try_baseline(self) -> None:
        intervals = int(self._seconds * self._rate + 1e-6)
        window = Window(max(1, intervals), self._rate, len(self._quiet[-1].values))
        for frame in self._quiet:
            window.add(frame)
        seen = window.read()
        if seen is None:
            return
        # Where all frames of an interval were lost, it tells nothing about the baseline.
        come = seen.valid.any(axis=1)
        try:
            baseline = quiet_baseline(seen.values[come], seen.valid[come])
        except SkinTouched as touched:
            self.status = f"no baseline yet: {str(touched).split(';')[0]}"
            return
        known = self._conversion(baseline, self._header())
        self.conversion = replace(known, broken=known.broken | seen.saturated[come].all(axis=0))
        self.count, self.status, self._deadline = self.count + 1, "", None
        self._quiet.clear()


def warm_up(
    skin: Skin, tare: Tare, rate: float, seconds: float, notify: Callable[[str], None]
) -> list[Frame]:
    """Read until the rate has shown and the tare knows what values mean; return all frames that came.

    Args:
        skin: just opened.
        tare: looks at every frame.
        rate: of the model, Hz: a slower device is refused.
        seconds: of the tare.
        notify: says a sentence to the person.

    Raises:
        InputError: too slow a device, or values of unknown meaning.
        SkinTouched: the skin was still touched after a minute.
    """
    notify("reading the untouched skin: keep off" if seconds else "reading the rate")
    frames, least, told = list[Frame](), max(seconds, _LEAST), False
    while True:
        frames += skin.read(1)
        if frames[-1].segment != frames[0].segment:
            del frames[:-1]
        tare.add(frames[-1])
        passed = frames[-1].t - frames[0].t
        if len(frames) < 3 or passed < least:
            continue
        if not told:
            check_rate(_rate(frames), rate)
        if tare.conversion is not None:
            return frames
        if not told and tare.status.startswith("no baseline"):
            notify("the skin is touched: let go")
        told = True
        if passed > least + _PATIENCE:
            raise SkinTouched(tare.status)


def _rate(frames: list[Frame]) -> float:
    """Return the rate of a device by its clock, Hz, lost frames counted in; 0 if it cannot be told."""
    passed = frames[-1].t - frames[0].t
    count = len(frames) - 1 + sum(frame.lost for frame in frames[1:])
    return count / passed if passed > 0 else 0.0
