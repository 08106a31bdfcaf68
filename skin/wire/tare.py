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
"""Returns the conversion for a baseline (S,), or None, and a header, or None; InputError if the scale is
unknown."""

_HEADER = 3.0  # s within which a device must send its header
_OFTEN = 0.2  # s between two attempts to take a baseline
_PATIENCE = 60.0  # s for which a touch may delay the baseline
_LEAST = 1.0  # s over which the rate is measured
_UNTOUCHED = "taking the baseline: do not touch the skin"


class Tare:
    """Takes the baseline from the first quiet stretch of a stream, and again on request.

    The baseline is that of values resampled to the model's rate: the maximum of noise is not 0. It is kept
    over restarts of the device, because the restart may have happened under a touch. A sensor that is at its
    limit during the whole stretch is pressed or broken: it is invalid until the next tare.

    Args:
        conversion: makes the conversion of values to N.
        seconds: s without touch from which the baseline is taken; 0: no baseline.
        rate: of the model, Hz.
        header: returns the header of the device, None until it has sent one.

    Attributes:
        conversion: of values to N; None until unit and baseline are known.
        status: message about what the tare is waiting for; empty if nothing.
        count: number of baselines taken.
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
        """Take a new baseline from the next quiet stretch, during which nothing may touch the skin.

        After a minute without a quiet stretch the old baseline stays.
        """
        if self._seconds and self.conversion is not None:
            self._quiet.clear()
            self._deadline = inf
            self.status = _UNTOUCHED

    def add(self, frame: Frame) -> None:
        """Add a frame.

        Raises:
            InputError: the scale is unknown, or the tare is too short.
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
        """Return whether unit and scale are known; the header may arrive a little late."""
        self._first = now if self._first is None else self._first
        header = self._header()
        try:
            self._conversion(None, header)
        except InputError:
            if header is not None or now - self._first > _HEADER:
                raise
            self.status = "waiting for the header of the device"
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
        # Intervals in which all frames were lost have no baseline.
        known = seen.valid.any(axis=1)
        try:
            baseline = quiet_baseline(seen.values[known], seen.valid[known])
        except SkinTouched as touched:
            self.status = f"no baseline yet: {str(touched).split(';')[0]}"
            return
        found = self._conversion(baseline, self._header())
        self.conversion = replace(found, broken=found.broken | seen.saturated[known].all(axis=0))
        self.count, self.status, self._deadline = self.count + 1, "", None
        self._quiet.clear()


def warm_up(
    skin: Skin, tare: Tare, rate: float, seconds: float, notify: Callable[[str], None]
) -> list[Frame]:
    """Read frames until rate and conversion are known; return all frames read.

    Args:
        skin: just opened.
        tare: gets every frame.
        rate: of the model, Hz: a slower device is refused.
        seconds: of the tare.
        notify: called with each message for the user.

    Raises:
        InputError: the device is too slow, or the scale is unknown.
        SkinTouched: the skin was still touched after a minute.
    """
    notify("reading the untouched skin: keep off" if seconds else "reading the rate")
    frames, least, measured = list[Frame](), max(seconds, _LEAST), False
    while True:
        frames += skin.read(1)
        if frames[-1].segment != frames[0].segment:
            del frames[:-1]
        tare.add(frames[-1])
        passed = frames[-1].t - frames[0].t
        if len(frames) < 3 or passed < least:
            continue
        if not measured:
            check_rate(_rate(frames), rate)
        if tare.conversion is not None:
            return frames
        if not measured and tare.status.startswith("no baseline"):
            notify("the skin is touched: let go")
        measured = True
        if passed > least + _PATIENCE:
            raise SkinTouched(tare.status)


def _rate(frames: list[Frame]) -> float:
    """Return the rate of a device by its clock, Hz, lost frames included; 0 if unknown."""
    passed = frames[-1].t - frames[0].t
    count = len(frames) - 1 + sum(frame.lost for frame in frames[1:])
    return count / passed if passed > 0 else 0.0
