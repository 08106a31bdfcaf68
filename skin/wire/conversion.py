"""Conversion of a device's values to newtons."""

from dataclasses import dataclass

import numpy as np

from skin.errors import InputError
from skin.signal.calibration import Calibration
from skin.wire.text import Header


@dataclass(frozen=True)
class UnitConversion:
    """Turns values into N: gain 1, and 0 where nothing touches.

    Attributes:
        scale: (S,), N per unit of the device.
        zero: (S,), what the untouched skin says, in its unit.
        broken: (S,), bool: sensors that mean nothing, as the calibration knows.
    """

    scale: np.ndarray
    zero: np.ndarray
    broken: np.ndarray

    def __call__(self, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return readings (..., S), N, 0 where invalid, and which are valid."""
        valid = valid & ~self.broken
        return np.where(valid, (values - self.zero) * self.scale, 0.0).astype(np.float32), valid


def unit_conversion(
    sensors: int,
    baseline: np.ndarray | None,
    scale: float | None,
    calibration: Calibration | None,
    header: Header | None,
) -> UnitConversion:
    """Return what values mean.

    Args:
        sensors: S.
        baseline: (S,), in the device's unit; None: the calibration's offsets, or 0.
        scale: N per unit; None: as the calibration says, or 1 where the device says that it sends N.
        calibration: of this device.
        header: what the device tells of itself.

    Raises:
        InputError: nobody knows what a count is worth, or a calibration of another number of sensors.
    """
    if calibration is not None:
        calibration.fits(sensors)
        known = calibration.values()
        per_unit = (calibration.scale if scale is None else scale) / known["gain"]
        offset = calibration.zero + known["offset"] / calibration.scale
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
