"""Constants of a real device, one per sensor, its response curves, and ranges to draw others from.

Their YAML file is that of ``skin calibrate``. A curve is the value that a sensor shows under a force.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import MaxLen, MinLen
from pydantic import AfterValidator, AllowInfNan, NonNegativeInt, PositiveFloat

from skin.body.base import MOST
from skin.core import files
from skin.core.safe_loading import TEXT, ChecksumError, check_text, parse_yaml, read_file, text_sum
from skin.core.settings import RISING, checked, configured
from skin.device.resampling import INWARDS
from skin.errors import InputError

_LEAST = 1e-9  # of an exponent, and of the reference: below, a power law is a line, whose slope is finite


def _check_rising(table: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
    """Refuse a table whose rows have different lengths or do not rise from 0."""
    if len(table[0]) != len(table[1]) or any(row[0] != 0 or min(np.diff(row)) <= 0 for row in table):
        raise ValueError("must have two rows, readings and values in N, each rising from 0: [[0,1],[0,2]]")
    return table


_Row = Annotated[Sequence[float], MinLen(2), MaxLen(1000)]
Table = Annotated[Sequence[_Row], MinLen(2), MaxLen(2), AfterValidator(_check_rising)]
"""Linear readings and values of a curve, each rising from 0, N."""


@dataclass(frozen=True)
class Curves:
    """The curves of S sensors: power laws, or tables.

    A linear reading x, the gain times the force, becomes ``at`` (x / ``at``) ^ ``exponent``, or the value of
    a table, interpolated linearly and continued with its last slope. Below 0, curves are those above it with
    both signs changed. The exponent of force-sensitive resistors is about 0.5, where the value is the
    resistance's inverse.

    Attributes:
        exponent: (S,), or (B, 1, S); 1: linear.
        at: reading at which linear reading and value are equal, (S,) or a number, N.
        tables: of sensors, from 0, that follow no power law.
    """

    exponent: Any
    at: Any
    tables: Mapping[int, Table] = field(default_factory=dict)

    def bend(self, linear: Any) -> Any:
        """Return the values of linear readings (..., S), array or tensor, N."""
        values = linear * (abs(linear) / self.at).clip(_LEAST) ** (self.exponent - 1)
        for sensor, (readings, shown) in self.tables.items():
            values[..., sensor] = _interpolate(linear[..., sensor], readings, shown)
        return values

    def straighten(self, values: Any) -> Any:
        """Return the linear readings of values (..., S), array or tensor, N."""
        linear = values * (abs(values) / self.at).clip(_LEAST) ** (1 / self.exponent - 1)
        for sensor, (readings, shown) in self.tables.items():
            linear[..., sensor] = _interpolate(values[..., sensor], shown, readings)
        return linear

    @property
    def slopes(self) -> np.ndarray:
        """Change of the value per change of the linear reading at :attr:`at` within 1 %, (S,); 1: a line."""
        at = np.broadcast_to(self.at, np.shape(self.exponent)).astype(float)
        return np.asarray((self.bend((1 + 0.01) * at) - self.bend((1 - 0.01) * at)) / (2 * 0.01 * at))

    def scaled(self, factor: np.ndarray) -> "Curves":
        """Return these curves for readings and values in another unit; ``factor`` (S,) of that per N."""
        tables = {n: (np.array(table) * factor[n]).tolist() for n, table in self.tables.items()}
        return Curves(self.exponent, self.at * factor, tables)

    def to_json(self) -> dict[str, Any]:
        """Return JSON data from which :meth:`of_json` makes these curves."""
        tables = {str(n): [list(row) for row in table] for n, table in self.tables.items()}
        return {"exponent": self.exponent.tolist(), "at": self.at.tolist(), "tables": tables}

    @classmethod
    def of_json(cls, stored: Mapping[str, Any]) -> "Curves":
        """Return the curves of which :meth:`to_json` gave the data."""
        tables = {int(number): table for number, table in stored["tables"].items()}
        return cls(np.array(stored["exponent"], float), np.array(stored["at"], float), tables)


def _interpolate(values: Any, given: Sequence[float], result: Sequence[float]) -> Any:
    """Return values of a table, odd, and continued with the last slope."""
    if not isinstance(values, np.ndarray):
        import torch  # only here: settings are checked without it

        return torch.from_numpy(_interpolate(values.cpu().numpy(), given, result)).to(values)
    size = np.abs(values)
    slope = (result[-1] - result[-2]) / (given[-1] - given[-2])
    beyond = np.maximum(size - given[-1], 0.0) * slope
    return np.sign(values) * (np.interp(size, given, result) + beyond)


# The file.


FORMAT = 1
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
"""Quantities per sensor, as in :class:`skin.device.imperfection.Constants`, with defaults."""
_LARGEST = 1e12  # of a quantity: a device has less; only a clip may be infinite
BROKEN = ("dead", "stuck", "saturated")
"""Kinds of broken sensors; ``stuck`` and ``saturated`` ones always read their ``offset``."""


@checked("a calibration")
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
        exponent_at: N, at which the curves of all exponents meet (:class:`Curves`). There
            the noise of a curved sensor has its value: at other readings the curve has other slopes.
        tables: curves of sensors, from 0, that follow no power law.

    Raises:
        InputError: an unknown name, different lengths, or a number out of range.
    """

    sensors: Annotated[Mapping[str, Sequence[Annotated[float, AllowInfNan(True)] | None]], MinLen(1)]
    broken: Mapping[str, Sequence[NonNegativeInt]] = field(default_factory=dict)
    ranges: Mapping[str, Annotated[Sequence[float], MinLen(2), MaxLen(2), RISING]] = field(
        default_factory=dict
    )
    scale: PositiveFloat = 1.0
    zero: float = 0.0
    about: dict = field(default_factory=dict)
    polarity: Sequence[int] = ()
    channels: Sequence[NonNegativeInt] = ()
    exponent_at: PositiveFloat = 1.0
    tables: Mapping[int, Table] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = {"sensors": (*QUANTITIES,), "broken": BROKEN, "ranges": (*QUANTITIES, "dead")}
        for group, allowed in names.items():
            if unknown := getattr(self, group).keys() - set(allowed):
                raise InputError(f"{group} takes {', '.join(allowed)}, got {', '.join(sorted(unknown))}")
        for name, values in (*self.sensors.items(), *self.ranges.items()):
            low = {"offset": -_LARGEST, "drift": -_LARGEST, "exponent": _LEAST}.get(name, 0.0)
            high = {"clip": math.inf, "dead": len(self)}.get(name, _LARGEST)
            if not all(low <= value <= high for value in values if value is not None):
                raise InputError(
                    f"{name} must be numbers from {low:g} to {high:g} (a channel whose values fall with "
                    f"force has polarity: -1), got {str(values)[:80]}"
                )
        if len(set(counts := {name: len(values) for name, values in self.sensors.items()}.values())) != 1:
            raise InputError(f"a calibration needs as many numbers of every quantity, got {list(counts)}")
        if len(self.signs) != len(self) or not set(self.polarity) <= {1, -1}:
            raise InputError(
                f"polarity must be 1 or -1 for each of {len(self)} sensors, got {list(self.polarity)}"
            )
        numbers = [*self.tables, *(number for group in self.broken.values() for number in group)]
        if wrong := [number for number in numbers if number not in range(len(self))]:
            raise InputError(
                f"broken and tables of {len(self)} sensors take sensors 0 to {len(self) - 1}, got {wrong}"
            )
        if self.channels and sorted(self.channels) != list(range(len(self))):
            raise InputError(
                f"channels must hold each of 0 to {len(self) - 1} once, the channel of every sensor, got "
                f"{list(self.channels)}"
            )

    def __len__(self) -> int:
        return len(next(iter(self.sensors.values())))

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

    def inwards(self) -> "Calibration":
        """Return the calibration of the channels inwards of sites with three axes; without ranges."""
        numbers = range(len(self))[INWARDS]
        return replace(
            self,
            sensors={name: values[INWARDS] for name, values in self.sensors.items()},
            broken={
                kind: [numbers.index(number) for number in group if number in numbers]
                for kind, group in self.broken.items()
            },
            tables={numbers.index(number): t for number, t in self.tables.items() if number in numbers},
            ranges={},
            polarity=self.polarity[INWARDS],
            channels=(),
        )

    def known(self, name: str) -> np.ndarray:
        """Return a quantity, (S,): unknown values are the median of known ones, or neutral without any.

        A sensor that was never driven to its limit thus clips like the others: channels share a converter.
        """
        values = np.array([np.nan if value is None else value for value in self.sensors.get(name, [None])])
        spare = float(np.nanmedian(values)) if np.isfinite(values).any() else QUANTITIES[name]
        return np.where(np.isnan(values), spare, np.broadcast_to(values, (len(self),)))

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
        ranges = {name: self.ranges.get(name, (0.0, 0.0)) for name in QUANTITIES}
        drawn = {name: generator.uniform(low, high, shape) for name, (low, high) in ranges.items()}
        converted = {
            name: drawn[name] if name in self.ranges else np.broadcast_to(self.known(name), shape).copy()
            for name in QUANTITIES
        }
        fewest, maximum = self.ranges.get("dead", (0, 0))
        count = generator.integers(int(fewest), int(maximum), (*shape[:-1], 1), endpoint=True)
        rank = generator.random(shape).argsort(axis=-1).argsort(axis=-1)
        return converted | {"dead": rank < count, "level": np.zeros(shape)}


def read_calibration(path: str | Path, inwards: bool = False) -> Calibration:
    """Read a calibration file; a single number applies to every sensor.

    Args:
        path: YAML file; relative paths are searched in the current folder, then beside the package.
        inwards: it is of sites with three axes, and only the channels inwards are used.

    Raises:
        InputError: no such file, unreadable, invalid contents, or a line ``sha256`` with the checksum of
            other contents.
    """
    file = next((candidate for candidate in files.candidates(path) if candidate.is_file()), None)
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
        return _calibration(stored, inwards)
    except ChecksumError as error:
        raise InputError(f"{file}: {error}: remove its line sha256 if you changed it by hand") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{file} is no calibration: {error}") from error


def _calibration(stored: Mapping[str, Any], inwards: bool) -> Calibration:
    """Return what a file describes, or its channels inwards; no count allocates memory unchecked."""
    count = stored["count"]
    if type(count) is not int or not 1 <= count <= MOST:
        raise InputError(f"count must be a whole number from 1 to {MOST}, got {count!r}")

    def each(value: Any) -> Any:
        return value if isinstance(value, list) else [value] * count

    settings = {name: value for name, value in stored.items() if name not in ("format", "sha256", "count")}
    settings = {name: value for name, value in settings.items() if value is not None}
    settings["sensors"] = {name: each(value) for name, value in stored["sensors"].items()}
    settings |= {name: tuple(each(settings[name])) for name in {"polarity", "channels"} & settings.keys()}
    calibration = configured(Calibration, settings, "a calibration")
    if len(calibration) != count:
        raise InputError(f"a calibration needs as many numbers as count, {count}, got {len(calibration)}")
    return calibration.inwards() if inwards else calibration


_LINES = {
    "scale": "N per raw unit",
    "zero": "raw units at 0 N, before offsets",
    "polarity": "-1: falls with force",
    "channels": "of the device, by sensor",
    "exponent_at": "N, where curves of all exponents meet",
    "tables": "by sensor: linear readings and values, N",
    "sensors": "",
    "broken": "",
    "ranges": "",
    "about": "",
}
"""Settings of a file in their order -> what they are."""


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration atomically, one quantity per line, with a checksum.

    Raises:
        InputError: the file cannot be written.
    """
    lines = ["# Forces in N, times in s. device.calibration takes this file.", f"format: {FORMAT}"]
    lines.append(f"count: {len(calibration)}")
    for name, comment in _LINES.items():
        value = getattr(calibration, name)
        if name in ("tables", "sensors", "broken", "ranges") and value:
            lines.append(f"{name}:" + f"  # {comment}" * bool(comment))
            lines += [f"  {key}: {json.dumps(list(part))}" for key, part in value.items()]
        elif value:  # 0 and nothing are defaults
            lines.append(f"{name}: {json.dumps(value)}" + f"  # {comment}" * bool(comment))
    # Before the count, which no file lacks: who cuts off the checksum cuts off more than it.
    lines.insert(2, text_sum("\n".join(lines)))
    return files.write("\n".join(lines) + "\n", Path(path).expanduser())
