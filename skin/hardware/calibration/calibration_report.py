"""Print the result of a calibration."""

import warnings
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from skin.hardware.calibration.held_out import HeldOutErrors
from skin.signal.calibration import QUANTITIES, Calibration

_TOO_FAR = 0.25  # error of a held-out force; positions off by 2 mm cause less
_WEAK = 0.05  # of the median gain: such a channel has 20 times the noise of others
_UNITS = {"gain": "", "hysteresis": "of peak", "time_constant": "s", "drift": "N/s"}


def held_out_summary(outcome: HeldOutErrors) -> dict[str, Any]:
    """Return the rounded errors on held-out presses, for the calibration file."""
    rmse = {name: round(getattr(outcome, name), 6) for name in ("simulated", "tared", "calibrated")}
    return {"held_out": list(outcome.held_out), "rmse": rmse}


def print_calibration(calibration: Calibration, outcome: HeldOutErrors) -> None:
    """Print the constants of working sensors, the broken, inverse and weak ones, and held-out errors."""
    table = Table("", "median", "least", "largest", "", box=None, pad_edge=False)
    for name in QUANTITIES:
        known = [value for value in calibration.sensors[name] if value is not None]
        if known and name in calibration.ranges:
            low, high = calibration.ranges[name]
            middle = f"{np.median(known):.4g}"
            table.add_row(name, middle, f"{low:.4g}", f"{high:.4g}", _UNITS.get(name, "N"))
    Console().print(table)
    for kind, numbers in calibration.broken.items():
        if numbers:
            print(f"{kind}: sensors {', '.join(map(str, numbers))} (from 0)")
    if len(inverse := np.flatnonzero(calibration.signs < 0)):
        print(f"inverse, values fall with force: sensors {', '.join(map(str, inverse))}")
    known = [gain for gain in calibration.sensors["gain"] if gain is not None]
    weak = [n for n, gain in enumerate(calibration.sensors["gain"]) if _weak(gain, known)]
    if weak:
        print(f"weak, less than {_WEAK:.0%} of the median gain: sensors {', '.join(map(str, weak))}")
    broken = {number for group in calibration.broken.values() for number in group}
    unknown = [n for n, gain in enumerate(calibration.sensors["gain"]) if gain is None and n not in broken]
    if unknown:
        print(f"not pressed, or at the limit, so of median gain: sensors {', '.join(map(str, unknown))}")
    print(
        f"RMSE on {len(outcome.held_out)} held-out presses: simulated {outcome.simulated:.4f} N, with tare "
        f"{outcome.tared:.4f} N, calibrated {outcome.calibrated:.4f} N"
    )
    if len(outcome.force):
        off = np.abs(outcome.force - 1)
        print(f"force of these presses from readings: off by {np.median(off):.1%}, at most {off.max():.1%}")
        if off.max() > _TOO_FAR:
            warnings.warn(
                f"the force of a held-out press is off by {off.max():.0%}: sensors are probably not where "
                "the layout says, and then their gains are wrong; measure their positions",
                UserWarning,
                stacklevel=2,
            )


def _weak(gain: float | None, known: list[float]) -> bool:
    return gain is not None and gain < _WEAK * float(np.median(known))
