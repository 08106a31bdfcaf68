"""Conversion of a device's values to newtons."""

import math
from dataclasses import dataclass

import numpy as np

from skin.errors import InputError
from skin.signal.calibration import Calibration
from skin.wire.text import Header

_LARGEST = 1e9  # N: more would overflow in a network or in JSON


@dataclass(frozen=True)
class UnitConversion:
    """Converts values of a device to N: gain 1, 0 without touch.

    Attributes:
        scale: (S,), N per unit of the device; negative where the value falls with force.
        zero: (S,), values of the untouched skin, in the device's unit.
        broken: (S,), bool: sensors without valid readings according to the calibration, or without a zero.
        noise: (S,), N, standard deviation of a frame of the untouched skin; None: unknown.
        changing: (S,), share of the frames of the untouched skin that differed from the one before; None:
            unknown.
    """

    scale: np.ndarray
    zero: np.ndarray
    broken: np.ndarray
    noise: np.ndarray | None = None
    changing: np.ndarray | None = None

    def __call__(self, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (..., S), N, 0 where invalid, and a mask of the valid ones, (..., S), bool.

        A reading that no skin can have is invalid.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            newtons = (values - self.zero) * self.scale
            valid = valid & ~self.broken & (np.abs(newtons) <= _LARGEST)
        return np.where(valid, newtons, 0.0).astype(np.float32), valid


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
    if calibration is not None:
        calibration.fits(sensors)
        check_scale(scale, calibration)
        known, signs = calibration.values(), calibration.signs
        per_unit = (calibration.scale if scale is None else scale) * signs / known["gain"]
        offset = calibration.zero + signs * known["offset"] / calibration.scale
        return UnitConversion(per_unit, offset if baseline is None else baseline, known["dead"])
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
