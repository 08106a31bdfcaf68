"""What the values of channels mean: their state, and their conversion to newtons."""

import math
from dataclasses import dataclass, field
from math import inf
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import betainc

from skin.device.calibration import Calibration, Curves
from skin.device.resampling import Frame
from skin.errors import InputError
from skin.wire.protocol import Header

Limits = tuple[float | None, float | None]


class Reason:  # plain numbers: an enumeration would cost a tenth of the time of a frame
    """Why a reading cannot be used, or only as a lower bound: bits of a mask."""

    SATURATED = 1
    """At the limit of the channel: the force is at least the reading, which is usable."""
    MISSING = 2
    """The device sent no number, or an error value."""
    IMPOSSIBLE = 4
    """The converter cannot give the value."""
    DEAD = 8
    """The channel has never changed."""
    STUCK = 16
    """It does not change while most others do."""
    UNKNOWN = 32
    """It has no baseline, or is broken according to the calibration."""
    FROZEN = 64
    """It does not change, though it did while the baseline was taken."""
    IMPLAUSIBLE = 128
    """No skin can have the reading."""


@dataclass(frozen=True)
class RawRange:
    """Values that a device can send.

    Attributes:
        minimum, maximum: of a channel; None: unknown.
        whole: it sends whole numbers.
        limits: at which a channel is saturated.
    """

    minimum: float | None = None
    maximum: float | None = None
    whole: bool = False
    limits: Limits = (None, None)


class ChannelHealth:
    """Checks channels frame by frame.

    A value at a limit is saturated and usable: the force is at least that. A channel that does not change for
    five seconds while most others do is stuck, or dead if it has never changed. A channel that has never
    changed is also dead if another has had noise of more than one count for five seconds. Neither state is
    detected if the noise of the untouched skin is below one count. A single change makes the channel usable
    again. A channel that stays where it had the most force ever, far from its other end, is saturated at an
    unknown limit rather than stuck, because a held press must not be masked.

    A value that the converter cannot give is unusable at once.

    Args:
        limits: smallest and largest value of a channel; None where an untouched channel may have this value,
            such as 0 of a resistor that conducts only under load.
        silent: s without any change after which a channel is stuck.
        active: s within which most channels change, if their noise can be seen at all.
        far: smallest steps of a channel: more than its noise ranges over.
        below: fraction of the range below 0 that an offset explains.
        judges: channels whose changes tell what the skin does: not those along the surface of three axes,
            whose faults would then hide those of the others.

    Attributes:
        limits: as given; a new value applies from the next frame on.
        largest: largest count of the converter, whose smallest is 0; infinite: unknown.
        mask: (S,), int, of :class:`Reason`, of the last frame; empty before the first.
    """

    def __init__(
        self,
        limits: Limits = (None, None),
        silent: float = 5.0,
        active: float = 1.0,
        far: float = 20.0,
        below: float = 0.01,
        judges: slice = slice(None),
    ) -> None:
        self.limits, self.largest, self._judges = limits, inf, judges
        self._silent, self._active, self._far, self._below = silent, active, far, below
        self._last: np.ndarray | None = None
        self._clock = self._time = 0.0
        self._begins, self.mask = True, np.zeros(0, dtype=int)

    def restart(self) -> None:
        """Let the device's clock begin anew; what is known of each channel is kept, also that it is stuck."""
        self._begins = True

    def check(
        self,
        values: np.ndarray,
        t: float,
        limited: np.ndarray | None = None,
        polarity: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the mask of a frame, (S,), int, of :class:`Reason`.

        Args:
            values: (S,), as sent.
            t: s, rising.
            limited: (S,), bool, channels that are known to be at a limit; None: none is.
            polarity: (S,), below 0 where values fall with force; None: nowhere.
        """
        self._clock += 0.0 if self._begins else t - self._time
        self._time, self._begins, t = t, False, self._clock
        if self._last is None or len(values) != len(self._last):
            self._last = values
            self._minimum, self._maximum = np.array(values, dtype=float), np.array(values, dtype=float)
            self._smallest = np.full(len(values), np.inf)
            self._ever = np.zeros(len(values), dtype=bool)
            self._changed_at, self._noisy_since, self._large_step_at = np.full((3, len(values)), t)
            self._active_since = t
        step, self._last = np.abs(values - self._last), values
        changed = step > 0
        self._changed_at[changed] = t
        self._ever |= changed
        self._smallest = np.minimum(self._smallest, np.where(changed, step, np.inf))
        np.minimum(self._minimum, values, out=self._minimum)
        np.maximum(self._maximum, values, out=self._maximum)
        unchanged = t - self._changed_at
        if 2 * np.count_nonzero(unchanged[self._judges] < self._active) <= len(values[self._judges]):
            self._active_since = t
        # Noise below half a step changes only values near an edge; a double step is more than that.
        self._large_step_at[step > 1.5 * self._smallest[self._judges].min()] = t
        self._noisy_since[t - self._large_step_at >= self._active] = t
        never = ~self._ever & (t - self._noisy_since[self._judges].min() >= self._silent)
        inactive = (unchanged >= self._silent) & ((t - self._active_since >= self._silent) | never)
        low, high = (
            end if limit is None else limit for limit, end in zip(self.limits, (-inf, inf), strict=True)
        )
        loaded = self._ever & (self._maximum - self._minimum >= self._far * self._smallest)
        # The end without force is no bound of a force, as of a broken wire; along the surface both ends are.
        rising = np.ones(len(values), dtype=bool)
        rising[self._judges] = True if polarity is None else polarity[self._judges] > 0
        saturated = (
            (rising & (values >= high))
            | (values <= low)
            | (inactive & loaded & np.where(rising, values >= self._maximum, values <= self._minimum))
            | (False if limited is None else limited)
        )
        impossible = (values > self.largest) | (values < -self._below * self.largest)
        self.mask = np.where(
            impossible,
            Reason.IMPOSSIBLE,
            saturated * Reason.SATURATED
            + (inactive & ~saturated) * np.where(self._ever, Reason.STUCK, Reason.DEAD),
        )
        return self.mask

    def states(self) -> tuple[str, ...]:
        """Return the state of each channel at the last frame; empty before the first."""
        names = {bit: name.lower() for name, bit in vars(Reason).items()} | {0: "ok"}
        return tuple(map(names.__getitem__, self.mask.tolist()))


class NewtonFrame(NamedTuple):
    """A frame in newtons, made once.

    Attributes:
        t: s, time of the stream, which goes on over restarts of the device.
        newtons: (S,), float32; 0 where there is no usable value.
        mask: (S,), int, of :class:`Reason`.
        frame: as the device sent it.
        three: all channels of sites with three axes, where these are those inwards; None: unknown, or none.
    """

    t: float
    newtons: np.ndarray
    mask: np.ndarray
    frame: Frame
    three: "NewtonFrame | None" = None

    @property
    def usable(self) -> np.ndarray:
        """(S,), bool, readings that are forces or lower bounds of forces."""
        return np.asarray(self.mask <= Reason.SATURATED)

    @property
    def saturated(self) -> np.ndarray:
        """(S,), bool, usable readings that are lower bounds."""
        return np.asarray(self.mask == Reason.SATURATED)


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
        largest: N; more would overflow in a network or in JSON, and no skin has it.
    """

    scale: np.ndarray
    zero: np.ndarray
    broken: np.ndarray
    noise: np.ndarray | None = None
    changing: np.ndarray | None = None
    equal: np.ndarray = field(default_factory=lambda: np.zeros(0))
    curves: Curves | None = None
    rest: np.ndarray | None = None
    largest: ClassVar[float] = 1e9

    def __call__(self, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (..., S), N, float32, 0 where invalid, and a mask of the valid ones, (..., S)."""
        with np.errstate(over="ignore", invalid="ignore"):
            newtons = self.newtons(values)
            valid = valid & ~self.broken & (np.abs(newtons) <= self.largest)
        return np.where(valid, newtons, 0.0).astype(np.float32), valid

    def convert(self, frame: Frame, t: float | None = None, mask: np.ndarray | int = 0) -> NewtonFrame:
        """Return a frame in newtons.

        Args:
            frame: as the device sent it.
            t: s, time of the stream; None: that of the frame.
            mask: (S,), int, what else makes its readings unusable.
        """
        newtons, valid = self(frame.values, frame.valid)
        sent = ~frame.valid * Reason.MISSING if frame.mask is None else frame.mask
        limited = 0 if frame.saturated is None else frame.saturated * Reason.SATURATED
        refused = (frame.valid & ~valid) * np.where(self.broken, Reason.UNKNOWN, Reason.IMPLAUSIBLE)
        mask = sent | limited | refused | mask
        return NewtonFrame(frame.t if t is None else t, newtons, np.asarray(mask), frame)

    def newtons(self, values: np.ndarray) -> np.ndarray:
        """Return values (..., S) in N, whatever they are."""
        linear = (values - self.zero) * self.scale
        return linear if self.curves is None else self.curves.straighten(linear)

    def raw(self, newtons: np.ndarray) -> np.ndarray:
        """Return the values (..., S) that the device sends at readings in N."""
        linear = newtons if self.curves is None else self.curves.bend(newtons)
        return linear / self.scale + self.zero


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


def fails_in_contact(
    failed: int,
    frames: int,
    failed_at_rest: int,
    frames_at_rest: int,
    *,
    enough: tuple[int, int] = (3, 100),
    times: float = 2.0,
    probability: float = 1e-4,
) -> bool:
    """Return whether so many frames fail in a contact that it is no accident, given those at rest.

    Values beyond the range may make frames, or values in them, unreadable.

    Args:
        failed, frames: in contact.
        failed_at_rest, frames_at_rest: the same at rest.
        enough: failures in contact, and frames at rest, of which less tell nothing.
        times: frames may fail so many times as often as at rest.
        probability: greatest probability of so many failures or more that is no accident.
    """
    usual = min(times * (failed_at_rest + 1) / (frames_at_rest + enough[1]), 1.0)
    known = failed >= enough[0] and frames_at_rest >= enough[1]
    return bool(known and betainc(failed, frames - failed + 1, usual) < probability)
