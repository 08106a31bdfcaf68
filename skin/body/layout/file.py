"""Sensors listed in a CSV file."""

import csv
import math
from io import StringIO
from itertools import islice
from pathlib import Path

import numpy as np

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Footprint, place_sensors
from skin.body.sensors import MOST, Sensors
from skin.core.files import candidates
from skin.core.safe_loading import read_file
from skin.core.settings import checked
from skin.errors import InputError

_NEED = (
    "a layout has the columns x_m, y_m and optionally depth_m, in metres from the upper left corner, and "
    "normal_x, normal_y, normal_z, which way a sensor faces"
)
_FACING = ("normal_x", "normal_y", "normal_z")
_PLACE = ("x_m", "y_m", "depth_m")
_BYTES = 1 << 22  # of a file: some hundred for each of the most sensors
_LARGEST = 1e9
_SHOWN = 80  # characters of the file, in a message


@checked("layout")
class File(AbstractLayout):
    """Sensors of a CSV file with the columns ``x_m``, ``y_m`` and optionally ``depth_m``, all m.

    The rows are in the order of the readings, which is that of the hardware's channels. ``normal_x``,
    ``normal_y`` and ``normal_z``, of any length, are the direction of a sensor in the local frame (x, y,
    into the skin); the default is the surface normal. Only ``simulator=solid`` supports tilted sensors.
    Other columns are ignored.

    Args:
        path: of the file; a relative path is searched in the current folder, then beside the package.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m, where the file has no ``depth_m``; None: ``body.sensor_depth``.

    Raises:
        InputError: a missing or empty file, more than 10 000 sensors, a missing column, a cell that is not a
            number, or a normal of length 0, with its line.
    """

    def __init__(
        self, path: str | Path, footprint: Footprint = (0.01, 0.01), depth: float | None = None
    ) -> None:
        self.path = _find(path)
        self.places = _read(self.path)
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in the order of the file."""
        x, y, depth = self.places["x_m"], self.places["y_m"], self.places.get("depth_m", self.depth)
        return place_sensors(body, x, y, depth, self.footprint, self._normals())

    def _normals(self) -> np.ndarray | None:
        """Return the unit vectors of the file, (S, 3), if it has any."""
        if _FACING[0] not in self.places:
            return None
        vectors = np.column_stack([self.places[name] for name in _FACING])
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _find(name: str | Path) -> Path:
    places = candidates(name)
    for path in places:
        if path.is_file():
            return path
    looked = " and ".join(dict.fromkeys(map(str, places)))
    raise InputError(f"no layout file {name}: looked for {looked}; give layout.path=FILE.csv")


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the file, each (S,), m."""
    try:
        # utf-8-sig, because spreadsheets write a byte order mark.
        lines = StringIO(read_file(path, _BYTES).decode("utf-8-sig"), newline="")
        reader = csv.DictReader(lines, skipinitialspace=True)
        reader.fieldnames = names = [name.strip() for name in reader.fieldnames or []]
        needed = {"x_m", "y_m"} | (set(_FACING) if set(_FACING) & set(names) else set())
        if missing := needed - set(names):
            present = ", ".join(names) or "nothing"
            raise ValueError(f"no column {' and '.join(sorted(missing))}, found {present[:_SHOWN]}")
        columns = [name for name in names if name in _PLACE + _FACING]
        if twice := [name for name in columns if columns.count(name) > 1]:
            raise ValueError(f"the column {twice[0]} is there twice")
        rows = [_numbers(reader.line_num, row, columns) for row in islice(reader, MOST + 1)]
        if not rows:
            raise ValueError("no sensor below the header")
        if len(rows) > MOST:
            raise ValueError(f"it has more than {MOST} sensors")
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"cannot read the layout {path}: {error}; {_NEED}") from error
    return dict(zip(columns, np.array(rows).T, strict=True))


def _numbers(line: int, row: dict[str, str], columns: list[str]) -> list[float]:
    """Return the numbers of a row, or raise a ValueError that says what is wrong."""
    numbers = []
    for name in columns:
        try:
            number = float(row[name] or "")
        except ValueError:
            number = math.nan
        if not abs(number) < _LARGEST:  # nor is it NaN
            unit = " in m" if name in _PLACE else ""
            raise ValueError(f"line {line}: {name} must be a number{unit}, got {repr(row[name])[:_SHOWN]}")
        numbers.append(number)
    facing = [number for name, number in zip(columns, numbers, strict=True) if name in _FACING]
    if facing and not math.hypot(*facing) > 1 / _LARGEST:
        raise ValueError(f"line {line}: a normal of length 0 faces nowhere: 0,0,1 faces the surface")
    return numbers
