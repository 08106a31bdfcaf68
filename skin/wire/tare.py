"""The newtons of a stream: its baseline, and readings that freeze."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Literal

import numpy as np

from skin.device.resampling import Frame, StreamClock, Window
from skin.errors import InputError
from skin.wire.channels import NewtonFrame, Reason, UnitConversion
from skin.wire.protocol import Header

FEWEST = 10
"""Frames that a baseline needs."""


def take_baseline(
    values: np.ndarray,
    valid: np.ndarray,
    before: np.ndarray | None = None,
    force: bool = False,
    moved: tuple[float, float] = (8.0, 3.0),
    shifted: tuple[float, float] = (20.0, 10.0),
    smooth: float = 0.5,
) -> np.ndarray:
    """Return the median of each channel over frames without touch, (S,).

    A touch is detected as a change, within the frames or against the previous baseline. A constant load
    cannot be distinguished from an offset.

    Args:
        values: (F, S).
        valid: (F, S); channels without a valid value are not checked.
        before: the previous baseline, (S,), or None.
        force: do not check for a touch.
        moved: standard deviations of the noise, and smallest steps, that are a touch within the frames.
        shifted: the same against the previous baseline, because offsets drift.
        smooth: von Neumann's ratio of successive differences to variance, 2 for noise and near 0 for a
            touch, below which a change has one direction.

    Raises:
        InputError: too few frames.
        SkinTouched: the skin was touched.
    """
    if len(values) < FEWEST:
        raise InputError(f"a baseline needs {FEWEST} frames, got {len(values)}: give more seconds")
    baseline = np.asarray(np.median(values, axis=0))
    if force:
        return baseline
    steps = np.abs(np.diff(values, axis=0))
    # From differences: a touch that lasts half of the time would otherwise count as noise. A stroke changes
    # by as much as noise does, but in a consistent direction.
    noise = 1.4826 * np.median(steps, axis=0) / np.sqrt(2)
    noise = np.where((steps**2).mean(axis=0) < smooth * values.var(axis=0), 0.0, noise)
    smallest = np.where(steps > 0, steps, np.inf).min(axis=0)
    smallest[np.isinf(smallest)] = 0.0
    changes = {"moved by": (np.abs(values - baseline).max(axis=0), moved)}
    if before is not None:
        changes["differs from its old baseline by"] = (np.abs(baseline - before), shifted)
    for what, (change, (sigmas, counts)) in changes.items():
        limit = np.maximum(sigmas * noise, counts * smallest)
        beyond = np.where(valid.any(axis=0), change - limit, -np.inf)
        channel = int(beyond.argmax())
        if beyond[channel] > 0:
            raise SkinTouched(
                f"the skin is touched: channel {channel} {what} {change[channel]:.4g}, noise explains "
                f"{limit[channel]:.4g}; let go and tare again, or tare(force=True) if nothing touches it"
            )
    return baseline


class SkinTouched(InputError):  # noqa: N818
    """No baseline can be taken, because something touches the skin."""


EXPECTED = 20
"""Changes of any channel that noise would have caused in a time: without one, readings are frozen."""

Frozen = Literal["", "still", "repeated"]
"""Why readings count as frozen: they do not; none has changed; a block of frames is sent again and again."""


class Freshness:
    """Finds readings that do not change, though they did while the baseline was taken.

    Args:
        silence: s without a change after which readings are frozen.
        changing: fraction of changes at the tare from which a single channel must change within that time.
        distinct: different frames of a block that is repeated; sensors at their limit, all but one, may
            repeat a few values.
        pause: s that a pause between two frames counts for at most: nothing is known of it.

    Attributes:
        frozen: why the device cannot be working; empty if it may be.
    """

    def __init__(
        self, silence: float = 5.0, changing: float = 0.3, distinct: int = 10, pause: float = 0.5
    ) -> None:
        self.silence, self._changing, self._distinct, self._pause = silence, changing, distinct, pause
        self.frozen: Frozen = ""
        self._values: np.ndarray | None = None
        self._unchanged, self._time, self._clock = 0, 0.0, 0.0
        self._rows, self._equal = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)

    def check(self, frame: Frame, t: float, conversion: UnitConversion | None) -> np.ndarray | int:
        """Compare a frame with those before; return the mask of its frozen readings, (S,), or 0.

        Args:
            frame: as the device sent it.
            t: s, time of the stream.
            conversion: with what the tare tells of the untouched skin; None: it is not known yet.
        """
        self._clock, self._time = self._clock + min(t - self._time, self._pause), t
        if self._values is None:
            self._changed_at = np.zeros(len(frame.values))
        # Nor is a restart a sign of life.
        changed = frame.values != (np.nan if self._values is None else self._values)
        self._changed_at[changed] = self._clock
        self._unchanged = 0 if changed.any() else self._unchanged + 1
        self._values = frame.values
        if conversion is None or conversion.changing is None:
            return 0
        silent = self._clock - self._changed_at >= self.silence - 1e-6  # a rounding of the clock
        still = silent.all() and self._unchanged * conversion.changing.sum() >= EXPECTED
        self.frozen = "still" if still else "repeated" if self._repeats(frame, conversion.equal) else ""
        stuck = silent & (conversion.changing >= self._changing)
        return (stuck if frame.saturated is None else stuck & ~frame.saturated) * Reason.FROZEN

    def _repeats(self, frame: Frame, equal: np.ndarray) -> bool:
        """Return whether the latest frames are, one after the other, those before them.

        Args:
            frame: the latest.
            equal: (L,), probability that a frame at rest equals that 1, 2, ... frames before.
        """
        if len(equal) != len(self._rows):
            self._rows, self._equal = (np.zeros(len(equal), dtype=np.int64) for _ in range(2))
        row = hash(frame.values.tobytes())
        self._equal = np.where(self._rows == row, self._equal + 1, 0)
        self._rows = np.concatenate([[row], self._rows[:-1]])
        likely = -self._equal * np.log(equal) < EXPECTED
        return not likely.all() and len(np.unique(self._rows[: self._equal[~likely].max()])) >= self._distinct


MakeConversion = Callable[[np.ndarray | None, Header | None], UnitConversion]
"""Returns the conversion for a baseline (S,), or None, and a header, or None; InputError if the scale is
unknown."""

HEADER = 6.0
"""s within which a device must send its header: many repeat it every five."""
PATIENCE = 60.0
"""s for which a touch may delay the baseline."""

TareState = Literal["", "first", "header", "quiet", "few", "touched", "waits", "limited"]
_STATUS: dict[TareState, str] = {
    "": "",
    "first": "waiting for the first frame",
    "header": "waiting for the header of the device",
    "quiet": "taking the baseline: do not touch the skin",
    "few": "taking the baseline: waiting for more frames",
    "touched": "no baseline yet: {}",
    "waits": "the new baseline waits: something touches the skin",
    "limited": "no baseline: {} at the limit or without a value",
}


class Tare:
    """Converts a stream of frames to newtons; takes the baseline from its first quiet stretch, or on request.

    The baseline is that of values resampled to the model's rate: the maximum of noise is not 0. It is kept
    over restarts of the device, because the restart may have happened under a touch. A channel at its limit
    cannot be tared: it keeps its previous baseline, or is invalid without one.

    Args:
        conversion: makes the conversion of values to N.
        seconds: s without touch from which the baseline is taken; 0: no baseline.
        rate: of the model, Hz.
        header: returns the header of the device, None until it has sent one.
        interval: s between two attempts to take the baseline.
        limited: fraction of the time at its limit from which a channel cannot be tared.
        lags: frames of the longest block that is recognised when it is sent again and again.
        three: of all channels of sites with three axes, where frames have those inwards: of its own, so that
            nothing that a channel along the surface does delays the baseline of the others. None: there are
            no other channels.

    Attributes:
        seconds, three: as given.
        conversion: of values to N; None until unit and baseline are known.
        state: what the tare is waiting for; empty if for nothing.
        warning: message about what the latest baseline lacks; empty if nothing.
        count: number of baselines taken.
        freshness: tells whether the device still works.
    """

    def __init__(
        self,
        conversion: MakeConversion,
        seconds: float,
        rate: float,
        header: Callable[[], Header | None] = lambda: None,
        interval: float = 0.2,
        limited: float = 0.5,
        lags: int = 1000,
        three: "Tare | None" = None,
    ) -> None:
        self._conversion, self._header, self.seconds, self._rate = conversion, header, seconds, rate
        self._interval, self._limited, self._lags = interval, limited, lags
        self.conversion: UnitConversion | None = None
        self.state: TareState = "first"
        self._detail = self.warning = ""
        self.count = 0
        self.freshness, self.three = Freshness(), three
        self._clock, self._quiet = StreamClock(), list[Frame]()
        self._waiting = deque[tuple[Frame, float]](maxlen=4096)  # as many as a skin queues
        self._first: float | None = None
        self._tried = -inf
        self._deadline: float | None = None
        self._forced = False

    @property
    def status(self) -> str:
        """What the tare is waiting for, in words; empty if for nothing."""
        return _STATUS[self.state].format(self._detail)

    def restart(self, force: bool = False) -> None:
        """Take a new baseline from the next quiet stretch, during which nothing may touch the skin.

        After a minute without a quiet stretch the old baseline stays.

        Args:
            force: take it from the next frames, even if the skin seems touched.
        """
        if self.three is not None:
            self.three.restart(force)
        if self.seconds and self.conversion is not None:
            self._quiet.clear()
            self._tried, self._deadline, self._forced = -inf, inf, force
            self.state = "quiet"

    def add(self, frame: Frame, touched: bool = False) -> NewtonFrame | None:
        """Return a frame in newtons; None before the conversion is known.

        Args:
            frame: as the device sent it.
            touched: something touches the skin, so that a new baseline must wait unless it is forced.

        Raises:
            InputError: the scale is unknown, or the tare is too short.
        """
        time = self._clock(frame)
        three = self.three.add(frame.three, touched) if self.three and frame.three else None
        if self.conversion is None or self._deadline is not None:
            self._update(frame, time, touched)
        mask = self.freshness.check(frame, time, self.conversion)
        if self.conversion is None:
            self._waiting.append((frame, time))
            return None
        return self.conversion.convert(frame, time, mask)._replace(three=three)

    def take_earlier(self) -> list[NewtonFrame]:
        """Return the frames before the first conversion in newtons, once that is known, and once."""
        earlier = [self.conversion.convert(*each) for each in self._waiting] if self.conversion else []
        self._waiting.clear()
        return earlier

    def _update(self, frame: Frame, time: float, touched: bool) -> None:
        """Take the baseline if it is due; see what it waits for."""
        if self._deadline is not None:
            self._deadline = min(self._deadline, frame.t_host + PATIENCE)
            if frame.t_host > self._deadline:
                self._deadline, self.state = None, ""
                return
        self._first = frame.t_host if self._first is None else self._first
        header = self._header()
        try:
            untared = self._conversion(None, header)
        except InputError:
            # The header may arrive a little late.
            if header is not None or frame.t_host - self._first > HEADER:
                raise
            self.state = "header"
            return
        if not self.seconds:
            self.conversion, self.state = untared, ""
        elif touched and not self._forced:
            self._quiet.clear()
            self.state = "waits"
        else:
            # One segment: a device that restarts often would otherwise never get a baseline.
            self._quiet.append(frame._replace(t=time, segment=0))
            while time - self._quiet[0].t > 1.5 * self.seconds:
                self._quiet.pop(0)
            if time - self._quiet[0].t < self.seconds:
                self.state = "quiet"
            elif time - self._tried >= self._interval:
                self._tried = time
                self._try_baseline()

    def _try_baseline(self) -> None:
        """Take the baseline from the latest frames if they are enough and quiet."""
        intervals = int(self.seconds * self._rate + 1e-6)
        window = Window(max(1, intervals), self._rate, len(self._quiet[-1].values))
        for frame in self._quiet:
            window.add(frame)
        seen = window.read()
        if seen is None:
            return
        # Intervals in which all frames were lost have no baseline.
        complete = seen.valid.any(axis=1)
        if complete.sum() < FEWEST <= intervals:
            self.state = "few"
            return
        values, valid = seen.values[complete], seen.valid[complete]
        try:
            baseline = take_baseline(values, valid, force=self._forced)
        except SkinTouched as touched:
            self.state, self._detail = "touched", str(touched).split(";")[0]
            return
        self._take(baseline, (seen.saturated[complete].mean(axis=0) >= self._limited) | ~valid.any(axis=0))

    def _take(self, baseline: np.ndarray, limited: np.ndarray) -> None:
        """Use a baseline (S,) of all channels but those that are ``limited``, (S,), bool."""
        fresh, before = self._conversion(baseline, self._header()), self.conversion
        untared = limited & ~fresh.broken
        if before is not None:
            retained = untared & ~before.broken
            fresh = replace(fresh, zero=np.where(retained, before.zero, fresh.zero))
            untared &= ~retained
        fresh = replace(fresh, broken=fresh.broken | untared)
        if fresh.broken.all():
            self.state, self._detail = "limited", _channels(limited)
            return
        frames = np.stack([frame.values for frame in self._quiet])
        newtons, changing = fresh.newtons(frames), (np.diff(frames, axis=0) != 0).mean(axis=0)
        noise, rest = np.diff(newtons, axis=0).std(axis=0) / np.sqrt(2), newtons.mean(axis=0)
        equal = _repeat_probability(frames, self._lags)
        self.conversion = replace(fresh, noise=noise, changing=changing, rest=rest, equal=equal)
        lacks = [f"{_channels(untared)} at the limit or without a value: no baseline"] * bool(untared.any())
        passed, silence = self._quiet[-1].t - self._quiet[0].t, self.freshness.silence
        if changing.sum() * (len(self._quiet) - 1) * silence / passed < EXPECTED:
            lacks.append(f"this device shows no noise: readings that freeze for {silence:g} s cannot be seen")
        self.warning = "; ".join(lacks)
        self.count, self.state, self._deadline, self._forced = self.count + 1, "", None, False
        self._quiet.clear()


def _repeat_probability(frames: np.ndarray, maximum: int) -> np.ndarray:
    """Return the probability (L,) that one of the frames (F, S) equals that 1, 2, ... frames before."""
    rows = np.array([hash(frame.tobytes()) for frame in frames])
    lags = range(1, min(len(rows) // 2, maximum) + 1)
    return np.array([((rows[lag:] == rows[:-lag]).sum() + 1) / (len(rows) - lag + 2) for lag in lags])


def _channels(which: np.ndarray) -> str:
    """Return the numbers of channels in words."""
    numbers = np.flatnonzero(which)
    if len(numbers) == len(which):
        return "all channels"
    return ("channel " if len(numbers) == 1 else "channels ") + ", ".join(map(str, numbers))
