"""Translate the settings of earlier runs, whose gestures were given in frames instead of seconds."""

from collections.abc import Callable, Mapping
from typing import Any

_DURATIONS = ("window", "tap", "press", "gap", "stride")
_DEFAULT_RATE = 10.0


def in_seconds(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored configuration with the gestures in s and m/s, at the model's rate ``touch.rate``.

    Earlier runs gave durations in frames and speeds in m per frame, and had one rate, ``device.rate``.

    Args:
        config: in plain containers; one that is already in seconds is returned as it is.
    """
    rate = float(_device(config).get("rate") or _DEFAULT_RATE)

    def translated(touch: dict[str, Any]) -> dict[str, Any]:
        if "rate" in touch:
            return touch
        found = _changed(touch, lambda frames: _rounded(frames / rate), lambda speed: _rounded(speed * rate))
        if "frames" in (limits := found.get("thresholds") or {}):
            rest = {name: value for name, value in limits.items() if name != "frames"}
            found["thresholds"] = rest | {"duration": _rounded(limits["frames"] / rate)}
        return found | {"rate": rate}

    return _with_touch(config, translated)


def in_frames(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration as earlier runs had it, so that its hash stays the same.

    A configuration whose device has another rate than the model is returned as it is: earlier runs had none.
    """

    def translated(touch: dict[str, Any]) -> dict[str, Any]:
        rate = touch.get("rate")
        if rate is None or _device(config).get("rate", rate) != rate:
            return touch
        found = _changed(touch, lambda seconds: round(seconds * rate), lambda speed: _rounded(speed / rate))
        if "duration" in (limits := found.get("thresholds") or {}):
            rest = {name: value for name, value in limits.items() if name != "duration"}
            found["thresholds"] = rest | {"frames": round(limits["duration"] * rate)}
        return {name: value for name, value in found.items() if name != "rate"}

    return _with_touch(config, translated)


def _changed(
    touch: dict[str, Any], duration: Callable[[float], float], speed: Callable[[float], float]
) -> dict[str, Any]:
    """Return settings of gestures with changed durations and speeds."""
    changes = dict.fromkeys(_DURATIONS, duration) | {"speed": speed}
    return {name: _each(value, changes[name]) if name in changes else value for name, value in touch.items()}


def _device(config: Mapping[str, Any]) -> Mapping[str, Any]:
    device = config.get("device")
    return device if isinstance(device, Mapping) else {}


def _with_touch(
    config: Mapping[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]
) -> dict[str, Any]:
    """Return a configuration with both places of its gestures changed: ``touch`` and ``device.touch``."""
    found = dict(config)
    if isinstance(touch := found.get("touch"), dict):
        found["touch"] = change(touch)
    device = _device(found)
    if isinstance(touch := device.get("touch"), dict):
        found["device"] = {**device, "touch": change(touch)}
    return found


def _each(value: Any, change: Callable[[float], float]) -> Any:
    """Apply a change to a number, or to each of a range."""
    return [change(one) for one in value] if isinstance(value, list) else change(value)


def _rounded(value: float) -> float:
    # To 12 digits, so that 0.03 m/s at 10 Hz is exactly 0.003 m per frame.
    return float(f"{value:.12g}")
