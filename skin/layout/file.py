"""Sensors listed in a CSV file."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.layout._place import place
from skin.layout.base import AbstractLayout, Sensors

__all__ = ["File"]

_ROOT = Path(__file__).parents[2]
_NEED = "a layout has the columns x_m, y_m and optionally depth_m, in metres from the upper left corner"


class File(AbstractLayout):
    """Sensors of a CSV file with the columns ``x_m``, ``y_m`` and optionally ``depth_m``, all m.

    The order of the rows is the order of the readings: that of the hardware's channels. Other columns are
    ignored.

    Args:
        path: the file; a relative path is looked for in the working directory, then in the repository.
        footprint: extent (x, y) over which a sensor feels, m.

    Raises:
        InputError: no such file, nothing in it, a column missing, or a cell that is no number, with its line.
    """

    def __init__(self, path: str, footprint: Sequence[float] = (0.01, 0.01)) -> None:
        self.path = _find(path)
        self.places = _read(self.path)
        self.footprint = footprint

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in the order of the file."""
        return place(body, self.places["x_m"], self.places["y_m"], self.places.get("depth_m"), self.footprint)


def _find(given: str) -> Path:
    path = Path(given).expanduser()
    candidates = [path] if path.is_absolute() else [Path.cwd() / path, _ROOT / path]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    looked = " and ".join(dict.fromkeys(map(str, candidates)))
    raise InputError(f"no layout file {given}: looked for {looked}; give layout.path=FILE.csv")


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the file, each (S,), m."""
    try:
        # utf-8-sig, because spreadsheets write a byte order mark.
        with path.open(encoding="utf-8-sig", newline="") as lines:
            reader = csv.DictReader(lines, skipinitialspace=True)
            names = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = names
            if missing := {"x_m", "y_m"} - set(names):
                found = ", ".join(names) or "nothing"
                raise InputError(f"{path}: no column {' and '.join(sorted(missing))}, found {found}; {_NEED}")
            columns = [name for name in names if name in ("x_m", "y_m", "depth_m")]
            rows = list(_rows(path, reader, columns))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read the layout {path}: {error}; {_NEED}") from error
    if not rows:
        raise InputError(f"{path}: no sensor below the header; {_NEED}")
    return dict(zip(columns, np.array(rows).T, strict=True))


def _rows(path: Path, reader: csv.DictReader, columns: list[str]) -> Iterator[list[float]]:
    for row in reader:
        numbers = []
        for name in columns:
            try:
                number = float(row[name] or "")
            except ValueError:
                number = math.nan
            if not math.isfinite(number):
                raise InputError(
                    f"{path}, line {reader.line_num}: {name} must be a number in m, got {row[name]!r}"
                )
            numbers.append(number)
        yield numbers
