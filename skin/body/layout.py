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
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Lt
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from skin.body.base import MOST, AbstractBody, Sensors, plane_axes
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


Axes = Literal["normal", "three"]
"""What each site measures: the force inwards, or forces along x, along y and inwards."""

_UNIT = 1e-3  # of a length of 1: files have few digits


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
    centres: np.ndarray,
    depth: np.ndarray | list[float] | float | None,
    footprint: Footprint,
    normals: np.ndarray | None = None,
    axes: Axes = "normal",
    directions: np.ndarray | None = None,
) -> Sensors:
    """Return sensors at x and y (S, 2), m; three at each position if ``axes`` is ``three``.

    Args:
        body: the body.
        centres: (S, 2), x and y, m.
        depth: of all sensors or of each (S,), m; None: ``body.sensor_depth``.
        footprint: extent (x, y) of the sensitive area, m.
        normals: (S, 3), of any length; None: those of the surface.
        axes: of each site.
        directions: (S, 3), which each measures; None: the normals, or those of ``axes``.

    Raises:
        InputError: a sensor outside the body, two sensors with the same x and
            y, because images and graphs are flat, or directions that are not those of three axes.
    """
    depths = np.broadcast_to(body.sensor_depth if depth is None else depth, len(centres))
    positions = np.column_stack([centres, depths])
    _check_inside(body, positions)
    facing = np.broadcast_to([0.0, 0.0, 1.0] if normals is None else normals, positions.shape)
    facing = facing / np.linalg.norm(facing, axis=1, keepdims=True)
    if axes == "three":
        directions = np.concatenate([plane_axes(facing), facing[:, None]], axis=1).reshape(-1, 3)
        positions, facing = positions.repeat(3, axis=0), facing.repeat(3, axis=0)
    sensors = Sensors(positions, (float(footprint[0]), float(footprint[1])), facing, directions)
    if directions is not None:
        _check_axes(sensors, directions)
    # Two sites less than a micrometre apart in the plane are at one position.
    first, second, distance = _closest(sensors, (1.0, 1.0))
    if distance < 1e-6:
        raise InputError(
            f"sensors {first + 1} and {second + 1} are at one position, x = {positions[first, 0]:g} m, "
            f"y = {positions[first, 1]:g} m: move one or remove it from the layout"
        )
    return sensors


def _check_axes(sensors: Sensors, directions: np.ndarray) -> None:
    lengths, sites = np.linalg.norm(directions, axis=1), len(sensors) // 3
    if (wrong := np.abs(lengths - 1) > _UNIT).any():
        raise InputError(
            f"the direction of sensor {wrong.argmax() + 1} has length {lengths[wrong][0]:.3g}, but must be a "
            "unit vector, such as 1,0,0 along x, 0,1,0 along y or 0,0,1 inwards"
        )
    frames, where = (part[: 3 * sites].reshape(-1, 3, 3) for part in (directions, sensors.positions))
    turned = [
        frames @ frames.transpose(0, 2, 1) - np.eye(3),
        frames[:, 2:] - sensors.normals[: 3 * sites : 3, None],
    ]
    if (
        len(sensors) != 3 * sites
        or (where != where[:, :1]).any()
        or max(np.abs(part).max() for part in turned) > _UNIT
    ):
        raise InputError(
            "a site of three axes has three rows, one after the other, at one position: two directions along "
            "its plane and one inwards, at right angles, such as 1,0,0, then 0,1,0, then 0,0,1; got "
            f"{len(sensors)} rows with {directions[:3].tolist()} first"
        )


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


def _closest(sensors: Sensors, unit: Footprint) -> tuple[int, int, float]:
    """Return sensors of the two closest sites along their farther axis, and how far, in units (x, y)."""
    positions = sensors.positions[:: sensors.axes]
    if len(positions) < 2:
        return 0, 0, math.inf
    # Not all pairs, which would take gigabytes for the most sensors that a file may have.
    from scipy.spatial import cKDTree  # a mistake in the settings must not wait for it

    distance, nearest = cKDTree(positions[:, :2] / unit).query(positions[:, :2] / unit, k=2, p=math.inf)
    first = int(distance[:, 1].argmin())
    second = next(int(index) for index in nearest[first] if index != first)
    return first * sensors.axes, second * sensors.axes, float(distance[first, 1])


# Sensors whose positions are settings: those of a layout that was built in Python.


@checked("layout")
class Listed(AbstractLayout):
    """Sensors at given positions.

    Args:
        positions: of S sensors, (x, y, z) each, m: from the upper left corner, z the depth.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        normals: of the sensors, unit vectors (x, y, into the skin); None: those of the surface.
        directions: which each measures, unit vectors; None: the normals.

    Raises:
        InputError: two sensors at one position, or directions that are not those of three axes.
    """

    def __init__(
        self,
        positions: Sequence[tuple[float, float, float]],
        footprint: Footprint = (0.01, 0.01),
        normals: Sequence[tuple[float, float, float]] | None = None,
        directions: Sequence[tuple[float, float, float]] | None = None,
    ) -> None:
        self.positions, self.footprint = np.array(positions, dtype=float), footprint
        self.normals, self.directions = (
            None if vectors is None else np.array(vectors, dtype=float) for vectors in (normals, directions)
        )

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in their order."""
        centres, depth = self.positions[:, :2], self.positions[:, 2]
        return place_sensors(body, centres, depth, self.footprint, self.normals, directions=self.directions)


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
        axes: ``three``: each site measures along x, along y and inwards, as three sensors one after the
            other. Only ``simulator=solid`` supports it.

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
        axes: Axes = "normal",
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt)
        self.footprint, self.depth, self.axes = footprint, depth, axes

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        centres = self.centres * np.array(body.size)
        return place_sensors(body, centres, self.depth, self.footprint, self.normals, self.axes)


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
        axes: of each site, as in ``layout=grid``.

    Raises:
        InputError: no row or column.
    """

    def __init__(
        self,
        rows: PositiveInt = 5,
        columns: PositiveInt = 5,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
        axes: Axes = "normal",
    ) -> None:
        self.centres = tile_centres(rows, columns)
        # A quarter of a pitch to either side keeps the rows within the surface.
        self.centres[:, 0] += (0.5 * np.repeat(np.arange(rows) % 2, columns) - 0.25) / columns
        self.footprint, self.depth, self.axes = footprint, depth, axes

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down."""
        centres = self.centres * np.array(body.size)
        return place_sensors(body, centres, self.depth, self.footprint, axes=self.axes)


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
        axes: of each site, as in ``layout=grid``.

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
        depth: float | list[float] | None = None,
        normals: np.ndarray | None = None,
        axes: Axes = "normal",
    ) -> None:
        self.centres = tile_centres(rows, columns)
        self.normals = rosette(rows, columns, tilt) if normals is None else normals
        self.pitch = np.array([1 / columns, 1 / rows])
        self.jitter, self.seed = jitter, seed
        self.footprint, self.depth, self.axes = footprint, depth, axes

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors row by row, from the upper left rightwards and down, to the micrometre."""
        moves = np.random.default_rng(self.seed).uniform(-self.jitter, self.jitter, self.centres.shape)
        centres = np.round((self.centres + moves * self.pitch) * body.size, 6)
        return place_sensors(body, centres, self.depth, self.footprint, self.normals, self.axes)


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
        axes: of each site, as in ``layout=grid``.

    Raises:
        InputError: no sensor, or more of them than fit.
    """

    def __init__(
        self,
        count: PositiveInt = 25,
        seed: NonNegativeInt = 0,
        footprint: Footprint = (0.01, 0.01),
        depth: float | None = None,
        axes: Axes = "normal",
    ) -> None:
        self.count, self.seed = count, seed
        self.footprint, self.depth, self.axes = footprint, depth, axes

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors from the top down, to the micrometre."""
        draw, extent = np.random.default_rng(self.seed), np.array(self.footprint)
        positions = np.empty((0, 2))
        for _ in range(10_000 if (extent <= body.size).all() else 0):
            candidate = np.round(extent / 2 + draw.random(2) * (np.array(body.size) - extent), 6)
            if (np.abs(positions - candidate) >= extent).any(axis=1).all():
                positions = np.vstack([positions, candidate])
            if len(positions) == self.count:
                centres = positions[np.argsort(positions[:, 1], kind="stable")]
                return place_sensors(body, centres, self.depth, self.footprint, axes=self.axes)
        width, height = self.footprint
        raise InputError(
            f"{self.count} sensors of {width:g} x {height:g} m do not fit at random on {body.size[0]:g} x "
            f"{body.size[1]:g} m: lower layout.count or layout.footprint, or set layout=grid"
        )


# Sensors listed in a CSV file.


_NEED = (
    "a layout has the columns x_m, y_m and optionally depth_m, in metres from the upper left corner, and "
    "normal_x, normal_y, normal_z, which way a sensor faces, and direction_x, direction_y, direction_z, what "
    "it measures"
)
_FACING, _ALONG = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("normal", "direction"))
_COLUMNS = ("x_m", "y_m", "depth_m", *_FACING, *_ALONG, "sensor")
_SHOWN = 80  # characters of the file, in a message


@checked("layout")
class File(AbstractLayout):
    """Sensors of a CSV file with the columns ``x_m``, ``y_m`` and optionally ``depth_m``, all m.

    The rows are in the order of the readings, which is the order of the hardware's channels, unless a column
    ``sensor`` numbers them. ``normal_x``, ``normal_y`` and ``normal_z``, of any length, are the direction of
    a sensor in the local frame (x, y, into the skin); the default is the surface normal. ``direction_x``,
    ``direction_y`` and ``direction_z`` are the unit vector of the force that it measures: a site of three
    axes has three rows, with directions along x, along y and inwards. Only ``simulator=solid`` supports
    these and tilted sensors. Other columns are ignored. A warning names two sensors whose footprints overlap.

    Args:
        path: of the file; a relative path is searched in the current folder, then beside the package.
        footprint: extent (x, y) of the sensitive area of a sensor, m.
        depth: of all sensors, m, where the file has no ``depth_m``; None: ``body.sensor_depth``.

    Raises:
        InputError: a missing or empty file, more than 10 000 sensors, a missing column, a cell that is not a
            number, or a normal of length 0, with its line; directions that are not those of three axes.
    """

    def __init__(
        self, path: str | Path, footprint: Footprint = (0.01, 0.01), depth: float | None = None
    ) -> None:
        self.path = _find(path)
        self.columns = _read(self.path)
        self.footprint, self.depth = footprint, depth

    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors in the order of their numbers or, without any, of the file."""
        depth = self.columns.get("depth_m", self.depth)
        centres = np.column_stack([self.columns["x_m"], self.columns["y_m"]])
        normals, directions = (
            np.column_stack([self.columns[name] for name in names]) if names[0] in self.columns else None
            for names in (_FACING, _ALONG)
        )
        sensors = place_sensors(body, centres, depth, self.footprint, normals, directions=directions)
        first, second, distance = _closest(sensors, sensors.footprint)
        if distance < 1 - 1e-6:
            warnings.warn(
                f"{self.path.name}: the footprints of sensors {first + 1} and {second + 1} overlap: correct "
                f"their positions, or lower layout.footprint={list(self.footprint)} m",
                UserWarning,
                stacklevel=2,
            )
        return sensors


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
        needed = {"x_m", "y_m"}.union(*(group for group in (_FACING, _ALONG) if set(group) & set(names)))
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
