"""Constants of a real device, one per sensor, and ranges to draw others from; their YAML file."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skin.body.base import MOST
from skin.core import files
from skin.core.files import candidates
from skin.core.safe_loading import TEXT, ChecksumError, check_text, parse_yaml, read_file, text_sum
from skin.device.curves import Curves, Table, read_tables
from skin.errors import InputError

FORMAT = 1
_KEYS = (
    *("format", "sha256", "count", "scale", "zero", "polarity", "channels", "exponent_at", "sensors"),
    *("tables", "broken", "ranges", "about"),
)
QUANTITIES = {
    "gain": 1.0,
    "offset": 0.0,
    "noise": 0.0,
    "drift": 0.0,
    "hysteresis": 0.0,
    "time_constant": 0.0,
    "clip": math.inf,
    "quantum": 0.0,
    "exponent": 1.0,
}
"""Quantities per sensor, as in :class:`skin.device.effects.Constants`, with defaults."""
_SIGNED = ("offset", "drift")
BROKEN = ("dead", "stuck", "saturated")
"""Kinds of broken sensors; ``stuck`` and ``saturated`` ones always read their ``offset``."""


@dataclass(frozen=True)
class Calibration:
    """The constants of a device, and ranges from which similar devices are drawn.

    Attributes:
        sensors: quantity -> a number per sensor, None if unknown.
        broken: kind of ``BROKEN`` -> numbers of sensors, from 0.
        ranges: quantity -> (low, high), drawn evenly for every sensor of a device; ``dead`` -> (fewest, most)
            sensors of a device that are dead.
        scale: N per raw unit of the session; 1 where that is N.
        zero: raw units that stand for 0 N before offsets: a raw value is (raw - zero) scale, N.
        about: origin of the calibration; any JSON data.
        polarity: 1 or -1 per sensor: -1 where the raw value falls with force. Readings in N rise with force
            either way. Empty: 1 for all.
        channels: the device's channel, from 0, of every sensor of the layout. Empty: the same order.
        exponent_at: N, at which the curves of all exponents meet (:class:`skin.device.curves.Curves`). There
            the noise of a curved sensor has its value: at other readings the curve has other slopes.
        tables: curves of sensors, from 0, that follow no power law.

    Raises:
        InputError: an unknown name, different lengths, or a number out of range.
    """

    sensors: Mapping[str, Sequence[float | None]]
    broken: Mapping[str, Sequence[int]] = field(default_factory=dict)
    ranges: Mapping[str, Sequence[float]] = field(default_factory=dict)
    scale: float = 1.0
    zero: float = 0.0
    about: Mapping[str, Any] = field(default_factory=dict)
    polarity: Sequence[int] = ()
    channels: Sequence[int] = ()
    exponent_at: float = 1.0
    tables: Mapping[int, Table] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _known(self.sensors, QUANTITIES, "sensors")
        _known(self.broken, BROKEN, "broken")
        _known(self.ranges, (*QUANTITIES, "dead"), "ranges")
        counts = {name: len(values) for name, values in self.sensors.items()}
        if len(set(counts.values())) != 1:
            raise InputError(f"a calibration needs as many numbers of every quantity, got {counts or 'none'}")
        for name, values in self.sensors.items():
            _check(name, [value for value in values if value is not None])
        for name, values in self.ranges.items():
            _check(name, values)
            if len(values) != 2 or values[0] > values[1] or not math.isfinite(values[1]):
                raise InputError(f"ranges.{name} must be [low, high], both finite, got {list(values)}")
        if any(number not in range(len(self) + 1) for number in self.ranges.get("dead", ())):
            raise InputError(f"ranges.dead must be whole numbers up to {len(self)} sensors")
        wrong = [number for group in self.broken.values() for number in group if not self._has(number)]
        if wrong or not self.scale > 0 or not math.isfinite(self.scale) or not math.isfinite(self.zero):
            raise InputError(
                f"a calibration of {len(self)} sensors breaks sensors 0 to {len(self) - 1} and has a scale "
                f"above 0, got sensors {wrong}, scale {self.scale}, zero {self.zero}"
            )
        self._check_wiring()
        if not 0 < self.exponent_at < math.inf or (self.known("exponent") <= 0).any():
            raise InputError(
                "exponent and exponent_at must be above 0, as those of sensors that follow force^0.5"
            )
        read_tables(self.tables, len(self))

    def __len__(self) -> int:
        return len(next(iter(self.sensors.values())))

    def _has(self, number: Any) -> bool:
        return isinstance(number, int) and not isinstance(number, bool) and 0 <= number < len(self)

    def newtons(self, raw: np.ndarray) -> np.ndarray:
        """Return raw values (..., S), in the layout's order, in N, with offsets and gains.

        They are like the readings of a simulated device: they rise with force, along the sensor's curve.
        """
        return (raw - self.zero) * (self.scale * self.signs)

    @property
    def signs(self) -> np.ndarray:
        """The polarity of every sensor, (S,), float64: 1 or -1."""
        return np.array(self.polarity, dtype=float) if self.polarity else np.ones(len(self))

    @property
    def curves(self) -> Curves | None:
        """The curves of the sensors; None: all are linear."""
        exponent = self.known("exponent")
        if not self.tables and (exponent == 1).all():
            return None
        return Curves(exponent, np.full(len(self), self.exponent_at), self.tables)

    def _check_wiring(self) -> None:
        """Raise InputError unless polarity and channels fit the number of sensors."""
        if self.polarity and (len(self.polarity) != len(self) or not set(self.polarity) <= {1, -1}):
            raise InputError(
                f"polarity must be 1 or -1 for each of {len(self)} sensors, got {list(self.polarity)}"
            )
        if self.channels and sorted(self.channels) != list(range(len(self))):
            raise InputError(
                f"channels must hold each of 0 to {len(self) - 1} once, the channel of every sensor, got "
                f"{list(self.channels)}"
            )

    def corrected(self, raw: np.ndarray) -> np.ndarray:
        """Return the true readings of raw values, (..., S), N: no offset, gain 1; NaN for broken sensors."""
        values = self.values()
        linear = self.newtons(raw) - values["offset"]
        true = (linear if self.curves is None else self.curves.straighten(linear)) / values["gain"]
        return np.where(values["dead"], np.nan, true)

    def fits(self, sensors: int) -> None:
        """Raise InputError if the calibration has another number of sensors."""
        if sensors != len(self):
            raise InputError(
                f"the calibration has {len(self)} sensors, the layout {sensors}: give the layout that it was "
                "made with, as in layout=file layout.path=FILE.csv, or device.calibration=null"
            )

    def known(self, name: str) -> np.ndarray:
        """Return a quantity, (S,): unknown values are the median of known ones, or neutral without any.

        A sensor that was never driven to its limit thus clips like the others: channels share a converter.
        """
        values = np.array([np.nan if value is None else value for value in self.sensors.get(name, [None])])
        values = np.broadcast_to(values, (len(self),))
        spare = QUANTITIES[name]
        if np.isfinite(values).any():
            spare = float(np.nanmedian(values))
        return np.where(np.isnan(values), spare, values)

    def values(self) -> dict[str, np.ndarray]:
        """Return every quantity, (S,), with ``dead`` and the constant ``level`` of broken sensors, N."""
        quantities = {name: self.known(name) for name in QUANTITIES}
        dead = np.zeros(len(self), dtype=bool)
        dead[[number for group in self.broken.values() for number in group]] = True
        level = np.array(quantities["offset"])
        level[list(self.broken.get("dead", []))] = 0.0
        return quantities | {"dead": dead, "level": level}

    def draw(self, shape: tuple[int, ...], generator: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the same for similar devices, (..., S) each, drawn from the ranges.

        Quantities without a range keep their values. Broken sensors are drawn as well.
        """
        own_values, converted = self.values(), dict[str, np.ndarray]()
        for name in QUANTITIES:
            low, high = self.ranges.get(name, (0.0, 0.0))
            drawn = generator.uniform(low, high, shape)
            converted[name] = (
                drawn if name in self.ranges else np.broadcast_to(own_values[name], shape).copy()
            )
        fewest, maximum = self.ranges.get("dead", (0, 0))
        count = generator.integers(int(fewest), int(maximum), (*shape[:-1], 1), endpoint=True)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        return converted | {"dead": rank < count, "level": np.zeros(shape)}


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration file; a single number applies to every sensor.

    Args:
        path: YAML file; relative paths are searched in the current folder, then beside the package.

    Raises:
        InputError: no such file, unreadable, invalid contents, or a line ``sha256`` with the checksum of
            other contents.
    """
    file = next((candidate for candidate in candidates(path) if candidate.is_file()), None)
    if file is None:
        raise InputError(f"no calibration {path}: skin calibrate session=FILE out={path} makes one")
    try:
        text = read_file(file, TEXT).decode("utf-8")
        stored: Any = parse_yaml(text)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the calibration {file}: {error}") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise InputError(f"{file} is no calibration: it needs format: {FORMAT}, count: and sensors:")
    try:
        check_text(text, stored)
        return _calibration(stored)
    except ChecksumError as error:
        raise InputError(f"{file}: {error}: remove its line sha256 if you changed it by hand") from error
    except (InputError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{file} is no calibration: {error}") from error


def _calibration(stored: Mapping[str, Any]) -> Calibration:
    """Return the calibration that a file describes; its size is checked before memory is allocated."""
    _known(stored, _KEYS, "a calibration")
    count = stored["count"]
    if type(count) is not int or not 1 <= count <= MOST:
        raise InputError(f"count must be a whole number from 1 to {MOST}, got {count!r}")
    sensors = {
        name: value if isinstance(value, list) else [value] * count
        for name, value in stored["sensors"].items()
    }
    if wrong := [name for name, values in sensors.items() if len(values) != count]:
        raise InputError(
            f"a calibration needs as many numbers of every quantity as count says, {count}, got "
            f"{len(sensors[wrong[0]])} of {wrong[0]}"
        )
    broken, ranges, about = (stored.get(name) or {} for name in ("broken", "ranges", "about"))
    if not isinstance(about, dict):
        raise InputError(f"about must be settings by name, got {about!r}")
    scale, zero = float(stored.get("scale", 1.0)), float(stored.get("zero", 0.0))
    polarity, channels = stored.get("polarity") or [], stored.get("channels") or []
    polarity = [polarity] * count if isinstance(polarity, int) else polarity
    if not isinstance(polarity, list) or not isinstance(channels, list):
        raise InputError("polarity and channels must be lists")
    curves = float(stored.get("exponent_at", 1.0)), read_tables(stored.get("tables") or {}, count)
    return Calibration(sensors, broken, ranges, scale, zero, about, tuple(polarity), tuple(channels), *curves)


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration atomically, one quantity per line, with a checksum.

    Raises:
        InputError: the file cannot be written.
    """
    groups = {"sensors": calibration.sensors, "broken": calibration.broken, "ranges": calibration.ranges}
    lines = ["# Forces in N, times in s. device.calibration takes this file.", f"format: {FORMAT}"]
    lines += [f"count: {len(calibration)}", f"scale: {calibration.scale!r}  # N per raw unit"]
    lines.append(f"zero: {calibration.zero!r}  # raw units at 0 N, before offsets")
    if calibration.polarity:
        lines.append(f"polarity: {json.dumps(list(calibration.polarity))}  # -1: falls with force")
    if calibration.channels:
        lines.append(f"channels: {json.dumps(list(calibration.channels))}  # of the device, by sensor")
    if calibration.curves is not None:
        lines.append(f"exponent_at: {calibration.exponent_at!r}  # N, where curves of all exponents meet")
    if calibration.tables:
        lines.append("tables:  # by sensor: linear readings and values, N")
        lines += [f"  {number}: {json.dumps(table)}" for number, table in calibration.tables.items()]
    for group, values in groups.items():
        lines.append(f"{group}:" + ("" if values else " {}"))
        lines += [f"  {name}: {json.dumps(list(value))}" for name, value in values.items()]
    lines.append(f"about: {json.dumps(dict(calibration.about))}")
    # Before the count, which no file lacks: who cuts off the checksum cuts off more than it.
    lines.insert(2, text_sum("\n".join(lines)))
    return files.write("\n".join(lines) + "\n", Path(path).expanduser())


def _known(names_given: Mapping[str, Any], names: Sequence[str] | Mapping[str, Any], group: str) -> None:
    if unknown := set(names_given) - set(names):
        raise InputError(f"{group} takes {', '.join(names)}, got {', '.join(sorted(map(str, unknown)))}")


def _check(name: str, values: Sequence[float]) -> None:
    numbers = isinstance(values, Sequence) and all(_is_number(name, value) for value in values)
    if not numbers or (name not in _SIGNED and min(values, default=0) < 0):
        minimum = "" if name in _SIGNED else " from 0 up"
        minimum += " (a channel whose values fall with force has polarity: -1)" if name == "gain" else ""
        text = str(values)
        raise InputError(f"{name} must be numbers{minimum}, got {text[:80]}")


def _is_number(name: str, value: Any, largest: float = 1e12) -> bool:
    """Return whether a value is a number that a device can have; a limit may be infinite."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= largest or (name == "clip" and value == math.inf)
