"""The tare: the baseline of an untouched skin, taken and kept while it is read."""

from collections.abc import Callable
from dataclasses import replace
from math import inf

import numpy as np

from skin.errors import InputError
from skin.signal.frame import Frame, StreamClock
from skin.signal.resampling import Window, check_rate
from skin.wire.baseline import FEWEST, median_baseline, quiet_baseline
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
_AT_LIMIT = 0.5  # share of the time at its limit from which a channel cannot be tared
FROZEN = 5.0
"""s without a change after which readings are frozen."""
EXPECTED = 20
"""Changes of any channel that noise would have caused in that time: without one, readings are frozen."""


class Tare:
    """Takes the baseline from the first quiet stretch of a stream, and again on request.

    The baseline is that of values resampled to the model's rate: the maximum of noise is not 0. It is kept
    over restarts of the device, because the restart may have happened under a touch. A channel at its limit
    cannot be tared: it keeps its previous baseline, or is invalid without one.

    Args:
        conversion: makes the conversion of values to N.
        seconds: s without touch from which the baseline is taken; 0: no baseline.
        rate: of the model, Hz.
        header: returns the header of the device, None until it has sent one.

    Attributes:
        conversion: of values to N; None until unit and baseline are known.
        status: message about what the tare is waiting for; empty if nothing.
        warning: message about what the latest baseline lacks; empty if nothing.
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
        self.status, self.warning = "waiting for the first frame", ""
        self.count = 0
        self._clock, self._quiet = StreamClock(), list[Frame]()
        self._first: float | None = None
        self._tried = -inf
        self._deadline: float | None = None
        self._forced = False

    def restart(self, force: bool = False) -> None:
        """Take a new baseline from the next quiet stretch, during which nothing may touch the skin.

        After a minute without a quiet stretch the old baseline stays.

        Args:
            force: take it from the next frames, even if the skin seems touched.
        """
        if self._seconds and self.conversion is not None:
            self._quiet.clear()
            self._tried, self._deadline, self._forced = -inf, inf, force
            self.status = _UNTOUCHED

    def add(self, frame: Frame, touched: bool = False) -> None:
        """Add a frame.

        Args:
            frame: as the device sent it.
            touched: something touches the skin, so that a new baseline must wait unless it is forced.

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
        if not self._seconds:
            self.conversion, self.status = self._conversion(None, self._header()), ""
        elif touched and not self._forced:
            self._quiet.clear()
            self.status = "the new baseline waits: something touches the skin"
        else:
            self._collect(frame)

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
        time = self._clock(frame)
        # One segment: a device that restarts often would otherwise never get a baseline.
        self._quiet.append(frame._replace(t=time, segment=0))
        while time - self._quiet[0].t > 1.5 * self._seconds:
            self._quiet.pop(0)
        if time - self._quiet[0].t < self._seconds:
            self.status = _UNTOUCHED
        elif time - self._tried >= _OFTEN:
            self._tried = time
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
        if known.sum() < FEWEST <= intervals:
            self.status = "taking the baseline: waiting for more frames"
            return
        values, valid = seen.values[known], seen.valid[known]
        try:
            baseline = median_baseline(values) if self._forced else quiet_baseline(values, valid)
        except SkinTouched as touched:
            self.status = f"no baseline yet: {str(touched).split(';')[0]}"
            return
        limited = (seen.saturated[known].mean(axis=0) >= _AT_LIMIT) | ~valid.any(axis=0)
        self._take(baseline, limited)

    def _take(self, baseline: np.ndarray, limited: np.ndarray) -> None:
        """Use a baseline (S,) of all channels but those that are ``limited``, (S,), bool."""
        fresh, before = self._conversion(baseline, self._header()), self.conversion
        untared = limited & ~fresh.broken
        if before is not None:
            kept = untared & ~before.broken
            fresh = replace(fresh, zero=np.where(kept, before.zero, fresh.zero))
            untared &= ~kept
        fresh = replace(fresh, broken=fresh.broken | untared)
        if fresh.broken.all():
            self.status = f"no baseline: {_channels(limited)} at the limit or without a value"
            return
        frames = np.stack([frame.values for frame in self._quiet])
        steps = np.diff(frames, axis=0)
        noise = steps.std(axis=0) / np.sqrt(2) * np.abs(fresh.scale)
        changing = (steps != 0).mean(axis=0)
        self.conversion = replace(fresh, noise=noise, changing=changing)
        self.warning = self._lacks(untared, changing)
        self.count, self.status, self._deadline, self._forced = self.count + 1, "", None, False
        self._quiet.clear()

    def _lacks(self, untared: np.ndarray, changing: np.ndarray) -> str:
        passed = self._quiet[-1].t - self._quiet[0].t
        expected = changing.sum() * (len(self._quiet) - 1) * FROZEN / passed
        silent = f"this device shows no noise: readings that freeze for {FROZEN:g} s cannot be seen"
        texts = (
            [f"{_channels(untared)} at the limit or without a value: no baseline"] if untared.any() else []
        )
        return "; ".join([*texts, silent] if expected < EXPECTED else texts)


def _channels(which: np.ndarray) -> str:
    """Return the numbers of channels in words."""
    numbers = np.flatnonzero(which)
    if len(numbers) == len(which):
        return "all channels"
    return ("channel " if len(numbers) == 1 else "channels ") + ", ".join(map(str, numbers))


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
