"""What the values of channels mean: their state, their conversion to newtons, and their baseline."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal, get_args

import numpy as np
from scipy.special import betainc

from skin.device.calibration import Calibration
from skin.device.curves import Curves
from skin.device.resampling import Frame, StreamClock, Window
from skin.errors import InputError
from skin.wire.protocol import Header

ChannelState = Literal["ok", "saturated", "stuck", "dead", "impossible"]
Limits = tuple[float | None, float | None]

_SILENT = 5.0  # s without any change
_LIVELY = 1.0  # s within which most channels change, if their noise can be seen at all
_BELOW = 0.01  # fraction of the range below 0 that an offset explains
_FAR = 20  # smallest steps of a channel: more than its noise ranges over


@dataclass(frozen=True)
class RawRange:
    """Values that a device can send.

    Attributes:
        least, most: of a channel; None: unknown.
        whole: it sends whole numbers.
        limits: at which a channel is saturated.
    """

    least: float | None = None
    most: float | None = None
    whole: bool = False
    limits: Limits = (None, None)

    @property
    def known(self) -> bool:
        """Whether the scale can be checked: too large or too small a force would leave the range."""
        return self.most is not None


class ChannelHealth:
    """Checks channels frame by frame.

    A value at a limit is saturated and valid: the force is at least that. A channel that does not change for
    five seconds while most others do is stuck, or dead if it has never changed. A channel that has never
    changed is also dead if another has had noise of more than one count for five seconds. Neither state is
    detected if the noise of the untouched skin is below one count. A single change makes the channel valid
    again. A channel that stays at the largest value it has ever sent, far above its smallest, is saturated at
    an unknown limit rather than stuck, because a held press must not be masked.

    A value that the converter cannot give is invalid at once.

    Args:
        limits: smallest and largest value of a channel; None where an untouched channel may have this value,
            such as 0 of a resistor that conducts only under load.

    Attributes:
        limits: as given; a new value applies from the next frame on.
        largest: largest count of the converter, whose smallest is 0; infinite: unknown.
    """

    def __init__(self, limits: Limits = (None, None)) -> None:
        self.limits, self.largest = limits, inf
        self._last: np.ndarray | None = None
        self._begin_time, self._faults = True, (np.zeros(0, dtype=bool),) * 4

    def restart(self) -> None:
        """Reset the times after a restart of the device; the known range of each channel is kept."""
        self._begin_time = True

    def check(self, values: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return which values (S,) are valid and which are saturated, (S,), bool each.

        Args:
            values: as sent.
            t: s, rising.
        """
        if self._last is None or len(values) != len(self._last):
            self._last, self._begin_time = values, True
            self._least, self._most = np.array(values, dtype=float), np.array(values, dtype=float)
            self._smallest = np.full(len(values), np.inf)
            self._ever = np.zeros(len(values), dtype=bool)
        if self._begin_time:
            self._changed_at, self._noisy_since, self._coarse_at = np.full((3, len(values)), t)
            self._lively_since, self._begin_time = t, False
        step, self._last = np.abs(values - self._last), values
        changed = step > 0
        self._changed_at[changed] = t
        self._ever |= changed
        self._smallest = np.minimum(self._smallest, np.where(changed, step, np.inf))
        np.minimum(self._least, values, out=self._least)
        np.maximum(self._most, values, out=self._most)
        silent = t - self._changed_at
        if 2 * np.count_nonzero(silent < _LIVELY) <= len(values):
            self._lively_since = t
        # Noise below half a step changes only values near an edge; a double step is more than that.
        self._coarse_at[step > 1.5 * self._smallest.min()] = t
        self._noisy_since[t - self._coarse_at >= _LIVELY] = t
        dull = (silent >= _SILENT) & (
            (t - self._lively_since >= _SILENT) | (~self._ever & (t - self._noisy_since.min() >= _SILENT))
        )
        low, high = self.limits
        at_limit = (values >= (np.inf if high is None else high)) | (
            values <= (-np.inf if low is None else low)
        )
        loaded = self._ever & (self._most - self._least >= _FAR * self._smallest)
        impossible = (values > self.largest) | (values < -_BELOW * self.largest)
        saturated = at_limit | (dull & loaded & (values >= self._most))
        dull, saturated = dull & ~saturated, saturated & ~impossible
        self._faults = impossible, dull & ~self._ever, dull, saturated
        return ~dull & ~impossible, saturated

    def states(self) -> tuple[ChannelState, ...]:
        """Return the state of each channel at the last frame; empty before the first."""
        worst = np.select(self._faults, [4, 3, 2, 1], 0)
        return tuple(get_args(ChannelState)[number] for number in worst)


_LARGEST = 1e9  # N: more would overflow in a network or in JSON


@dataclass(frozen=True)
class UnitConversion:
    """Converts values of a device to N: gain 1, 0 without touch.

    Attributes:
        scale: (S,), N per unit of the device; negative where the value falls with force.
        zero: (S,), values of the untouched skin, in the device's unit.
        broken: (S,), bool: sensors without valid readings according to the calibration, or without a zero.
        noise: (S,), N, standard deviation of a frame of the untouched skin; None: unknown.
        changing: (S,), fraction of the frames of the untouched skin that differed from the one before; None:
            unknown.
        equal: (L,), probability that a frame of the untouched skin equals that 1, 2, ... frames before.
        curves: of the sensors, for gain 1; None: all are linear.
        rest: (S,), N, mean of the frames of the untouched skin: below 0, because the zero is that of the
            largest values of intervals; None: unknown.
    """

    scale: np.ndarray
    zero: np.ndarray
    broken: np.ndarray
    noise: np.ndarray | None = None
    changing: np.ndarray | None = None
    equal: np.ndarray = field(default_factory=lambda: np.zeros(0))
    curves: Curves | None = None
    rest: np.ndarray | None = None

    def __call__(self, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (..., S), N, 0 where invalid, and a mask of the valid ones, (..., S), bool.

        A reading that no skin can have is invalid.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            newtons = self.newtons(values)
            valid = valid & ~self.broken & (np.abs(newtons) <= _LARGEST)
        return np.where(valid, newtons, 0.0).astype(np.float32), valid

    def newtons(self, values: np.ndarray) -> np.ndarray:
        """Return values (..., S) in N, whatever they are."""
        linear = (values - self.zero) * self.scale
        return linear if self.curves is None else self.curves.straighten(linear)

    def raw(self, newtons: np.ndarray) -> np.ndarray:
        """Return the values (..., S) that the device sends at readings in N."""
        bent = newtons if self.curves is None else self.curves.bend(newtons)
        return bent / self.scale + self.zero


def unit_conversion(
    sensors: int,
    baseline: np.ndarray | None,
    scale: float | None,
    calibration: Calibration | None,
    header: Header | None,
) -> UnitConversion:
    """Return the conversion of a device's values to N.

    Args:
        sensors: S.
        baseline: (S,), in the device's unit; None: the calibration's offsets, or 0.
        scale: N per unit, negative if values fall with force; None: that of the calibration, or 1 if the
            header has the unit N.
        calibration: of this device.
        header: of the device; None if it sends none.

    Raises:
        InputError: the scale is unknown, negative beside a calibration, or the calibration has another number
            of sensors.
    """
    check_scale(scale, calibration)
    if calibration is not None:
        calibration.fits(sensors)
        quantities, signs = calibration.values(), calibration.signs
        if quantities["dead"].all():
            raise InputError("every sensor is broken in device.calibration: give that of this device")
        per_unit = (calibration.scale if scale is None else scale) * signs / quantities["gain"]
        offset = calibration.zero + signs * quantities["offset"] / calibration.scale
        curves = calibration.curves
        return UnitConversion(
            per_unit,
            offset if baseline is None else baseline,
            quantities["dead"],
            # Values are divided by the gain, which stands before the curve.
            curves=None if curves is None else curves.scaled(1 / quantities["gain"]),
        )
    if scale is None:
        if header is None or header.unit != "N":
            raise InputError(
                f"the device sends {header.unit if header and header.unit else 'values of no unit'}, a model "
                "takes N: give device.calibration=FILE.yaml of skin calibrate, or N per count "
                "as in device.scale=0.039"
            )
        scale = 1.0
    zero = np.zeros(sensors) if baseline is None else baseline
    return UnitConversion(np.full(sensors, scale), zero, np.zeros(sensors, dtype=bool))


def check_scale(scale: float | None, calibration: Calibration | None) -> None:
    """Raise InputError unless a scale, N per unit, can be used with a calibration, or without one."""
    if scale is None:
        return
    if not math.isfinite(scale) or scale == 0:
        raise InputError(
            f"device.scale is N per count and must not be 0, got {scale}: as in device.scale=0.039, or "
            "device.scale=-0.039 if values fall with force"
        )
    if calibration is not None and scale < 0:
        raise InputError(
            "device.scale must be above 0 beside a calibration, which has the polarity of every channel, "
            f"got {scale}: leave out device.scale"
        )


AGREES = 0.25
"""Relative difference up to which two references agree: a finger on a kitchen scale is not more exact."""


def check_sensitivity(conversion: UnitConversion, declared: float | None) -> None:
    """Raise InputError if the median scale of a conversion contradicts that of a data sheet, N per unit."""
    scale = float(np.median(np.abs(conversion.scale[~conversion.broken])))
    if declared is not None and abs(scale / declared - 1) > AGREES:
        raise InputError(
            f"device.scale or device.calibration converts by {scale:.4g} N per unit, "
            f"device.sensitivity={declared:g} says otherwise: give the scale that the data sheet confirms "
            f"within {AGREES:.0%}, or leave out the wrong one"
        )


FEWEST = 10
"""Frames that a baseline needs."""

# As multiples of the noise and of the smallest step seen.
_MOVED = 8.0, 3.0  # within the frames
_SHIFTED = 20.0, 10.0  # against the old baseline, because offsets drift
_SMOOTH = 0.5  # von Neumann ratio of successive differences to variance: 2 for noise, near 0 for a touch


def take_baseline(
    values: np.ndarray,
    valid: np.ndarray,
    before: np.ndarray | None = None,
    touch: float = 0.0,
    force: bool = False,
) -> np.ndarray:
    """Return the median of each channel over frames without touch, (S,).

    A touch is detected as a change, within the frames or against the previous baseline. A constant load
    cannot be distinguished from an offset.

    Args:
        values: (F, S).
        valid: (F, S); channels without a valid value are not checked.
        before: the previous baseline, (S,), or None.
        touch: smallest shift of the baseline that counts as a touch, however small the noise.
        force: do not check for a touch.

    Raises:
        InputError: too few frames.
        SkinTouched: the skin was touched.
    """
    if len(values) < FEWEST:
        raise InputError(f"a baseline needs {FEWEST} frames, got {len(values)}: give more seconds")
    baseline = np.asarray(np.median(values, axis=0))
    if force:
        return baseline
    checked = np.asarray(valid.any(axis=0))
    steps = np.abs(np.diff(values, axis=0))
    # From differences: a touch that lasts half of the time would otherwise count as noise.
    noise = 1.4826 * np.median(steps, axis=0) / np.sqrt(2)
    smallest = np.where(steps > 0, steps, np.inf).min(axis=0)
    smallest[np.isinf(smallest)] = 0.0
    moved = np.abs(values - baseline).max(axis=0)
    # A stroke changes by as much as noise does, but in a consistent direction.
    smooth = (steps**2).mean(axis=0) < _SMOOTH * values.var(axis=0)
    noise = np.where(smooth, 0.0, noise)
    _refuse_touch("moved by", moved, np.maximum(_MOVED[0] * noise, _MOVED[1] * smallest), checked)
    if before is not None:
        limit = np.maximum(np.maximum(_SHIFTED[0] * noise, _SHIFTED[1] * smallest), touch)
        _refuse_touch("differs from its old baseline by", np.abs(baseline - before), limit, checked)
    return baseline


def _refuse_touch(what: str, change: np.ndarray, limit: np.ndarray, checked: np.ndarray) -> None:
    beyond = np.where(checked, change - limit, -np.inf)
    channel = int(beyond.argmax())
    if beyond[channel] > 0:
        raise SkinTouched(
            f"the skin is touched: channel {channel} {what} {change[channel]:.4g}, noise explains "
            f"{limit[channel]:.4g}; let go and tare again, or tare(force=True) if nothing touches it"
        )


MakeConversion = Callable[[np.ndarray | None, Header | None], UnitConversion]
"""Returns the conversion for a baseline (S,), or None, and a header, or None; InputError if the scale is
unknown."""

HEADER = 6.0
"""s within which a device must send its header: many repeat it every five."""
_OFTEN = 0.2  # s between two attempts to take a baseline
PATIENCE = 60.0  # s for which a touch may delay the baseline
_UNTOUCHED = "taking the baseline: do not touch the skin"
_AT_LIMIT = 0.5  # fraction of the time at its limit from which a channel cannot be tared
FROZEN = 5.0
"""s without a change after which readings are frozen."""
_LAGS = 1000  # frames of the longest block that is recognised when it is sent again and again
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
            self._deadline = min(self._deadline, frame.t_host + PATIENCE)
            if frame.t_host > self._deadline:
                self._deadline, self.status = None, ""
                return
        self._first = frame.t_host if self._first is None else self._first
        header = self._header()
        try:
            plain = self._conversion(None, header)
        except InputError:
            # The header may arrive a little late.
            if header is not None or frame.t_host - self._first > HEADER:
                raise
            self.status = "waiting for the header of the device"
            return
        if not self._seconds:
            self.conversion, self.status = plain, ""
        elif touched and not self._forced:
            self._quiet.clear()
            self.status = "the new baseline waits: something touches the skin"
        else:
            self._collect(frame)

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
        complete = seen.valid.any(axis=1)
        if complete.sum() < FEWEST <= intervals:
            self.status = "taking the baseline: waiting for more frames"
            return
        values, valid = seen.values[complete], seen.valid[complete]
        try:
            baseline = take_baseline(values, valid, force=self._forced)
        except SkinTouched as touched:
            self.status = f"no baseline yet: {str(touched).split(';')[0]}"
            return
        limited = (seen.saturated[complete].mean(axis=0) >= _AT_LIMIT) | ~valid.any(axis=0)
        self._take(baseline, limited)

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
            self.status = f"no baseline: {_channels(limited)} at the limit or without a value"
            return
        frames = np.stack([frame.values for frame in self._quiet])
        steps = np.diff(frames, axis=0)
        newtons = fresh.newtons(frames)
        noise, rest = np.diff(newtons, axis=0).std(axis=0) / np.sqrt(2), newtons.mean(axis=0)
        changing = (steps != 0).mean(axis=0)
        self.conversion = replace(
            fresh, noise=noise, changing=changing, rest=rest, equal=_repeat_probability(frames)
        )
        lacks = (
            [f"{_channels(untared)} at the limit or without a value: no baseline"] if untared.any() else []
        )
        passed = self._quiet[-1].t - self._quiet[0].t
        if changing.sum() * (len(self._quiet) - 1) * FROZEN / passed < EXPECTED:
            lacks.append(f"this device shows no noise: readings that freeze for {FROZEN:g} s cannot be seen")
        self.warning = "; ".join(lacks)
        self.count, self.status, self._deadline, self._forced = self.count + 1, "", None, False
        self._quiet.clear()


_FRAMES, _FEW = 100, 3  # minimum number of frames at rest and of failures
_TIMES, _ACCIDENT = 2.0, 1e-4  # times the failures at rest; least probability of an accident


def fails_in_contact(failed: int, frames: int, failed_at_rest: int, frames_at_rest: int) -> bool:
    """Return whether more frames fail in a contact than by accident, given those at rest.

    Values beyond the range may make frames, or values in them, unreadable.
    """
    usual = min(_TIMES * (failed_at_rest + 1) / (frames_at_rest + _FRAMES), 1.0)
    # The probability of so many or more.
    known = frames_at_rest >= _FRAMES and failed >= _FEW
    return bool(known and betainc(failed, frames - failed + 1, usual) < _ACCIDENT)


def _repeat_probability(frames: np.ndarray) -> np.ndarray:
    """Return the probability (L,) that one of the frames (F, S) equals that 1, 2, ... frames before."""
    rows = np.array([hash(frame.tobytes()) for frame in frames])
    lags = range(1, min(len(rows) // 2, _LAGS) + 1)
    return np.array([((rows[lag:] == rows[:-lag]).sum() + 1) / (len(rows) - lag + 2) for lag in lags])


def _channels(which: np.ndarray) -> str:
    """Return the numbers of channels in words."""
    numbers = np.flatnonzero(which)
    if len(numbers) == len(which):
        return "all channels"
    return ("channel " if len(numbers) == 1 else "channels ") + ", ".join(map(str, numbers))


class SkinTouched(InputError):  # noqa: N818
    """No baseline can be taken, because something touches the skin."""
