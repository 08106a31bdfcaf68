"""Refuse values with the wrong unit; warn of skins whose mechanics have no effect.

Classes take any value that has a meaning, however large a sheet or stiff a layer a proof needs; a
configuration describes a skin that somebody could hold, and 12 in place of 0.012 m is a mistake there.
"""

import math
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.sensors import Sensors


class _Range(NamedTuple):
    low: float
    high: float
    unit: str


_LENGTH = _Range(0.005, 3, "m")
_PRESSURE = _Range(100, 1e8, "Pa")
# As configurations are nested; a list is each of its entries.
_RANGES: Mapping[str, Any] = {
    "body": {
        "size": _LENGTH,
        "length": _LENGTH,
        "radius": _LENGTH,
        "layers": {
            "thickness": _Range(1e-5, 0.2, "m"),
            "material": {"young": _Range(1e3, 1e12, "Pa"), "relaxation": {"time": _Range(1e-3, 1e5, "s")}},
        },
    },
    "layout": {"footprint": _Range(1e-4, 0.5, "m")},
    "contact": {"relief": _Range(0, 0.1, "m"), "fillet": _Range(0, 0.1, "m")},
    "device": {"position_error": _Range(0, 0.1, "m")},
    "touch": {
        "rate": _Range(0.1, 1e4, "Hz"),
        "window": _Range(0, 20, "s"),
        "tap": _Range(0, 15, "s"),
        "press": _Range(0, 15, "s"),
        "safe_peak": _PRESSURE,
        "dangerous_peak": _PRESSURE,
        "speed": _Range(0, 10, "m/s"),
        "path": _Range(0, 1, "m"),
        "spare": _Range(0, 1, "m"),
        "thresholds": {"pressure": _PRESSURE, "travel": _Range(1e-6, 0.5, "m")},
    },
}


def check_plausibility(groups: Mapping[str, Any]) -> None:
    """Refuse a configuration with a value that no skin has in the unit that is asked for.

    Args:
        groups: the configuration, in plain containers. What is no number is left to the classes.

    Raises:
        InputError: a value is out of its range.
    """
    for name, ranges in _RANGES.items():
        _within(name, groups.get(name), ranges)


def _within(name: str, group: Any, ranges: Mapping[str, Any]) -> None:
    if isinstance(group, list):
        for number, one in enumerate(group):
            _within(f"{name}.{number}", one, ranges)
    if not isinstance(group, Mapping):
        return
    for key, within in ranges.items():
        given = group.get(key)
        if isinstance(within, Mapping):
            _within(f"{name}.{key}", given, within)
            continue
        low, high, unit = within
        for value in given if isinstance(given, list) else [given]:
            # What is no number, or not above 0, the classes refuse with a sentence of their own.
            if _positive(value) and not low <= value <= high:
                raise InputError(
                    f"{name}.{key}={value:g} {unit} is not plausible: it is given in {unit}, from {low:g} to "
                    f"{high:g} {unit}; was another unit meant?"
                )


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf


def warn_of_surface(body: AbstractBody, sensors: Sensors) -> None:
    """Warn where sensors lie on the surface: there they read the pressure itself, whatever is below."""
    count = int((sensors.positions[:, 2] <= 1e-3 * body.thickness).sum())
    if count:
        warnings.warn(
            f"{count} of {len(sensors)} sensors lie on the surface, where they read the pressure itself: the "
            "layers' thickness and stiffness change nothing; put them at a depth, as in "
            f"layout.depth={body.thickness / 3:.2g} simulator=solid, or with a column depth_m in layout.path",
            UserWarning,
            stacklevel=3,
        )
