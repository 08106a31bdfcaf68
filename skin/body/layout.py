"""Layouts: where the sensors of a skin are."""

import csv
import math
import warnings
from abc import ABC, abstractmethod
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Sequence
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Lt
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from skin.body.base import MOST, AbstractBody, Sensors
from skin.core.files import candidates
from skin.core.safe_loading import read_file
from skin.core.settings import checked
from skin.errors import InputError

# Positions and normals of sensors on a regular grid.


Tilt = Annotated[float, Ge(0), Lt(math.pi / 2)]
"""Angle between the normals of a sensor and of the surface, rad."""


def tile_centres(rows: int, columns: int) -> np.ndarray:
    """Return the centres (S, 2) of rows x columns equal tiles of the unit square, row by row."""
    y, x = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])


def rosette(rows: int, columns: int, tilt: float) -> np.ndarray:
    """Return the normals (S, 3) of a grid's sensors, row by row, tilted along +x, +y, -x and -y in turn.

    Each row is shifted by two directions against the row above. A sensor then differs from its eight
    neighbours, and each block of two by two sensors has all four directions, so that shear along any
    direction is sensed everywhere.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        tilt: angle between the sensors' normals and the surface's, rad, from 0 to below pi / 2.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    axes = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    lean = math.sin(tilt) * axes[(column + 2 * row) % 4]
    # -0.0 and 0.0 would give different keys of stored operators.
    return np.column_stack([lean + 0.0, np.full(len(lean), math.cos(tilt))])


Footprint = tuple[PositiveFloat, PositiveFloat]
"""Extent (x, y) of the sensitive area of a sensor, m."""


class AbstractLayout(ABC):
    """Places sensors in a body."""

    @abstractmethod
    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors of this layout in ``body``.

        Raises:
            InputError: a sensor lies outside the body, or two lie at one position.
        """


def place_sensors(
    body: AbstractBody,
    x: np.ndarray,
    y: np.ndarray,
    depth: np.ndarray | float | None,
    footprint: Footprint,
    normals: np.ndarray | None = None,
) -> Sensors:
    """Return sensors at x and y, each (S,), m.

    Args:
        body: the body.
        x, y: (S,), m.
        depth: of all sensors or of each (S,), m; None: ``body.sensor_depth``.
        footprint: extent (x, y) of the sensitive area, m.
        normals: (S, 3), unit vectors; None: those of the surface.

    Raises:
        InputError: a depth that is not a number, a sensor outside the body, or two sensors with the same x
            and y, because images and graphs are flat.
    """
    depths = np.asarray(body.sensor_depth if depth is None else depth)
    if depths.dtype.kind not in "if":
        raise InputError(f"layout.depth must be a length in m or null, got {depth!r}: as in 0.004")
    positions = np.column_stack([x, y, np.broadcast_to(depths, x.shape)])
    _check_inside(body, positions)
    # Two sensors less than a micrometre apart in the plane are at one position.
    first, second, distance = _closest(positions, (1.0, 1.0))
    if distance < 1e-6:
        raise InputError(
            f"sensors {first + 1} and {second + 1} are at one position, x = {x[first]:g} m, "
            f"y = {y[first]:g} m: move one or remove it from the layout"
        )
    extent = float(footprint[0]), float(footprint[1])
    return Sensors(positions, extent) if normals is None else Sensors(positions, extent, normals)


def _check_inside(body: AbstractBody, positions: np.ndarray, rounding: float = 1e-9) -> None:
    extent = np.array([*body.size, body.thickness])
    outside = ((positions < 0) | (positions > extent + rounding)).any(axis=1)
    if outside.any():
        number = int(outside.argmax())
        x, y, depth = positions[number]
        inside = (positions[:, :2] >= 0).all() and (1e-3 * positions[:, :2] <= body.size).all()
        unit = "in mm? " if inside and positions[:, :2].max() > 1 else ""
        raise InputError(
            f"{outside.sum()} of {len(positions)} sensors lie outside the body; the first is "
            f"sensor {number + 1} at x = {x:g} m, y = {y:g} m, depth = {depth:g} m, on a surface of "
            f"{extent[0]:g} x {extent[1]:g} m, {extent[2]:g} m thick: {unit}positions are in metres from the "
            "upper left corner; correct the layout, set a larger body or layout=grid"
        )


def _closest(positions: np.ndarray, unit: Footprint) -> tuple[int, int, float]:
    """Return the two sensors that are closest along their farther axis, and how far, in units (x, y)."""
    if len(positions) < 2:
        return 0, 0, math.inf
    # Not all pairs, which would take gigabytes for the most sensors that a file may have.
    from scipy.spatial import cKDTree  # a mistake in the settings must not wait for it

    distance, nearest = cKDTree(positions[:, :2] / unit).query(positions[:, :2] / unit, k=2, p=math.inf)
    first = int(distance[:, 1].argmin())
    second = next(int(index) for index in nearest[first] if index != first)
    return first, second, float(distance[first, 1])


# Sensors whose positions are settings: those of a layout that was built in Python.


@checked("layout")
class Listed(AbstractLayout):
    """Sensors at given positions.

    Args:
        positions: of S sensors, (x, y, z) each, m: from the upper left corner, z the depth.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        normals: of the sensors, unit vectors (x, y, into the skin); None: those of the surface.

    Raises:
        InputError: two sensors at one position.
    """

    def __init__(
        self,
        positions: Sequence[tuple[float, float, float]],
        footprint: Footprint = (0.01, 0.01),
        normals: Sequence[tuple[float, float, float]] | None = None,
    ) -> None:
        self.positions, self.footprint = np.array(positions, dtype=float), footprint
        self.normals = None if normals is None else np.array(normals, dtype=float)

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in their order."""
        x, y, depth = self.positions.T
        return place_sensors(body, x, y, depth, self.footprint, self.normals)


# Sensors on a regular grid.


@checked("layout")
class Grid(AbstractLayout):
    """Sensors at the centres of equal tiles of the body's surface.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        tilt: angle between the normals of each sensor and of the surface, rad, along +x, +y, -x and -y in
            turn, so that neighbours respond to different directions of shear. Only ``simulator=solid``
            supports it.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column, or a tilt outside 0 to pi / 2.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        footprint: Footprint = (0.01, 0.01),
        tilt: Tilt = 0.0,
        depth: float | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt)
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        x, y = (self.centres * np.array(body.size)).T
        return place_sensors(body, x, y, self.depth, self.footprint, self.normals)


# Sensors in staggered rows.


@checked("layout")
class Hexagonal(AbstractLayout):
    """Sensors in rows of which every other one is moved by half a pitch.

    Every sensor has six nearest neighbours at equal distances if the pitch of the rows is 0.87 times the
    pitch within a row.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        odd = np.repeat(np.arange(rows) % 2, columns)
        # A quarter of a pitch to either side keeps the rows within the surface.
        self.centres[:, 0] += (0.5 * odd - 0.25) / columns
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        x, y = (self.centres * np.array(body.size)).T
        return place_sensors(body, x, y, self.depth, self.footprint)


# Sensors scattered at random around a grid.


@checked("layout")
class Scattered(AbstractLayout):
    """A grid of sensors with random displacements, as in a hand-made skin.

    Args:
        rows: number of rows (along y).
        columns: number of columns (along x).
        jitter: largest displacement along x and y, as a fraction of the pitch, 0 to 0.5.
        seed: of the displacements.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        tilt: angle between the normals of each sensor and of the surface, rad, as in ``layout=grid``.
        normals: (S, 3), direction of each sensor; None: from ``tilt``.
        depth: of all sensors or of each (S,), m; None: ``body.sensor_depth``.

    Raises:
        InputError: no row or column, a jitter at which two sensors could meet, or a tilt outside 0 to pi / 2.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        jitter: Annotated[float, Ge(0), Lt(0.5)] = 0.25,
        seed: NonNegativeInt = 0,
        footprint: Footprint = (0.01, 0.01),
        tilt: Tilt = 0.0,
        depth: float | np.ndarray | None = None,
        normals: np.ndarray | None = None,
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt) if normals is None else normals
        self.pitch = np.array([1 / columns, 1 / rows])
        self.jitter, self.seed = jitter, seed
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down, to the micrometre."""
        moves = np.random.default_rng(self.seed).uniform(-self.jitter, self.jitter, self.centres.shape)
        x, y = np.round((self.centres + moves * self.pitch) * body.size, 6).T
        return place_sensors(body, x, y, self.depth, self.footprint, self.normals)


# Sensors at random positions.


@checked("layout")
class Random(AbstractLayout):
    """Sensors at random positions whose footprints neither overlap nor leave the surface.

    Positions are drawn one by one, uniformly, in 10,000 tries; one that is too near to an earlier one is
    drawn again (random sequential adsorption).

    Args:
        count: number of sensors.
        seed: of the positions.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m; None: ``body.sensor_depth``.

    Raises:
        InputError: no sensor, or more of them than fit.
    """

    def __init__(
        self,
        count: PositiveInt = 25,
        seed: NonNegativeInt = 0,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
    ) -> None:
        self.count, self.seed = count, seed
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors from the top down, to the micrometre."""
        draw, extent = np.random.default_rng(self.seed), np.array(self.footprint)
        positions = np.empty((0, 2))
        for _ in range(10_000 if (extent <= body.size).all() else 0):
            candidate = np.round(extent / 2 + draw.random(2) * (np.array(body.size) - extent), 6)
            if (np.abs(positions - candidate) >= extent).any(axis=1).all():
                positions = np.vstack([positions, candidate])
            if len(positions) == self.count:
                x, y = positions[np.argsort(positions[:, 1], kind="stable")].T
                return place_sensors(body, x, y, self.depth, self.footprint)
        width, height = self.footprint
        raise InputError(
            f"{self.count} sensors of {width:g} x {height:g} m do not fit at random on {body.size[0]:g} x "
            f"{body.size[1]:g} m: lower layout.count or layout.footprint, or set layout=grid"
        )


# Sensors listed in a CSV file.


_NEED = (
    "a layout has the columns x_m, y_m and optionally depth_m, in metres from the upper left corner, and "
    "normal_x, normal_y, normal_z, which way a sensor faces"
)
_FACING = ("normal_x", "normal_y", "normal_z")
_COLUMNS = ("x_m", "y_m", "depth_m", *_FACING, "sensor")
_SHOWN = 80  # characters of the file, in a message


@checked("layout")
class File(AbstractLayout):
    """Sensors of a CSV file with the columns ``x_m``, ``y_m`` and optionally ``depth_m``, all m.

    The rows are in the order of the readings, which is the order of the hardware's channels, unless a column
    ``sensor`` numbers them. ``normal_x``, ``normal_y`` and ``normal_z``, of any length, are the direction of
    a sensor in the local frame (x, y, into the skin); the default is the surface normal. Only
    ``simulator=solid`` supports tilted sensors. Other columns are ignored. A warning names two sensors whose
    footprints overlap.

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
        self.columns = _read(self.path)
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in the order of their numbers or, without any, of the file."""
        x, y, depth = self.columns["x_m"], self.columns["y_m"], self.columns.get("depth_m", self.depth)
        sensors = place_sensors(body, x, y, depth, self.footprint, self._normals())
        first, second, distance = _closest(sensors.positions, sensors.footprint)
        if distance < 1 - 1e-6:
            warnings.warn(
                f"{self.path.name}: the footprints of sensors {first + 1} and {second + 1} overlap: correct "
                f"their positions, or lower layout.footprint={list(self.footprint)} m",
                UserWarning,
                stacklevel=2,
            )
        return sensors

    def _normals(self) -> np.ndarray | None:
        """Return the unit vectors of the file, (S, 3), if it has any."""
        if _FACING[0] not in self.columns:
            return None
        vectors = np.column_stack([self.columns[name] for name in _FACING])
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _find(name: str | Path) -> Path:
    paths = candidates(name)
    if path := next(filter(Path.is_file, paths), None):
        return path
    looked = " and ".join(dict.fromkeys(map(str, paths)))
    raise InputError(f"no layout file {name}: looked for {looked}; give layout.path=FILE.csv")


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the file, each (S,), m."""
    try:
        content = read_file(path, 1 << 22)  # bytes: some hundred for each of the most sensors
        # utf-8-sig, because spreadsheets write a byte order mark.
        text = content.decode("utf-16" if content[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig")
        reader = csv.DictReader(StringIO(text, newline=""), skipinitialspace=True)
        reader.fieldnames = names = [" ".join(name.split()) for name in reader.fieldnames or []]
        needed = {"x_m", "y_m"} | (set(_FACING) if set(_FACING) & set(names) else set())
        if missing := needed - set(names):
            if any(";" in name for name in names):
                raise ValueError("semicolons between its columns: save it with commas, and 0.04 for 0,04")
            present = ", ".join(names) or "nothing"
            raise ValueError(f"no column {' and '.join(sorted(missing))}, found {present[:_SHOWN]}")
        columns = [name for name in names if name in _COLUMNS]
        if twice := [name for name in columns if columns.count(name) > 1]:
            raise ValueError(f"the column {twice[0]} is there twice")
        rows = [_numbers(reader.line_num, row, columns) for row in islice(reader, MOST + 1)]
        if not rows:
            raise ValueError("no sensor below the header")
        if len(rows) > MOST:
            raise ValueError(f"it has more than {MOST} sensors")
        values = dict(zip(columns, np.array(rows).T, strict=True))
        order = np.argsort(values.get("sensor", np.arange(len(rows))), kind="stable")
        if "sensor" in values and (np.diff(values["sensor"][order]) != 1).any():
            raise ValueError("the column sensor must number the sensors, each once and without a gap")
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"cannot read the layout {path}: {error}; {_NEED}") from error
    return {name: column[order] for name, column in values.items()}


def _numbers(line: int, row: dict[str, str], columns: list[str], largest: float = 1e9) -> list[float]:
    """Return the numbers of a row, or raise a ValueError that says what is wrong."""
    numbers = []
    for name in columns:
        try:
            number = float(row[name] or "")
        except ValueError:
            number = math.nan
        if not abs(number) < largest:  # nor is it NaN
            unit = " in m" if name.endswith("_m") else ""
            raise ValueError(f"line {line}: {name} must be a number{unit}, got {repr(row[name])[:_SHOWN]}")
        numbers.append(number)
    facing = [number for name, number in zip(columns, numbers, strict=True) if name in _FACING]
    if facing and not math.hypot(*facing) > 1 / largest:
        raise ValueError(f"line {line}: a normal of length 0 has no direction: 0,0,1 faces the surface")
    return numbers
