"""A session of a bench: its files, the force gauge, presses, and their simulated true readings."""

import json
import logging
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import torch
from annotated_types import Ge, Le

from skin.body.base import AbstractBody, require_memory
from skin.core.files import tabular, whole, write
from skin.core.safe_loading import read_parts
from skin.core.settings import checked
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.fingertips import half_extents, peak_per_newton
from skin.touch.shapes import Shapes

_KEY = b"skin_session"
_log = logging.getLogger(__name__)
GAUGE = ("force", "x_m", "y_m", "indenter", "radius_m", "angle", "press")
"""Columns besides ``time``; the first three are required."""
_PAUSE = 1.0  # s without a row end a press
_SLOWEST, _FASTEST = 1.0, 5000.0  # Hz of a bench's files
_UNITS = {"ms": 1e-3, "microseconds": 1e-6, "minutes": 60.0, "ms in place of microseconds": 1e3}
"""Units that a time may have by mistake, in s."""
_OTHER = ("time", "t_us", "seq", "gesture", *GAUGE)


def load_table(path: str | Path, what: str) -> tuple[pa.Table, dict[str, Any]]:
    """Return a table and its metadata: JSON in the Parquet schema, or in ``x.csv.json`` beside a CSV.

    Lines of a CSV that start with ``#`` are comments. The folder of a session of skin record becomes the
    table of its frames; damaged files are left out, with a warning.

    Raises:
        InputError: no such file, another ending, unreadable, or no rows.
    """
    path = Path(path).expanduser()
    path = path if path.is_dir() else tabular(path, f"a {what}")
    if not path.exists():
        raise InputError(f"no {what} {path}")
    try:
        if path.is_dir():
            about, table = _join(path)
        elif path.suffix == ".parquet":
            with pa.parquet.ParquetFile(path) as file:
                size = 16.0 * file.metadata.num_rows * file.metadata.num_columns
                require_memory(size, f"the {what} {path}", "give fewer rows")
                table = file.read()
            about = json.loads((table.schema.metadata or {}).get(_KEY, b"{}"))
        else:
            frame = pd.read_csv(path, comment="#", index_col=False, encoding="utf-8-sig", low_memory=False)
            table = pa.Table.from_pandas(frame, preserve_index=False)
            sidecar = path.with_name(path.name + ".json")
            about = json.loads(sidecar.read_text(encoding="utf-8")) if sidecar.is_file() else {}
        if not isinstance(about, dict):
            raise ValueError(f"its metadata are {about!r}, and must be an object, as in {{}}")
        if not len(table):
            raise ValueError("it has no rows below its header")
    except InputError:
        raise
    except (OSError, pa.ArrowException, ValueError, RecursionError) as error:
        raise InputError(f"cannot read the {what} {path}: {' '.join(str(error).split())}") from error
    return table.rename_columns([name.strip() for name in table.column_names]), about


def _join(folder: Path) -> tuple[dict[str, Any], pa.Table]:
    """Return the metadata of a session of skin record, and the frames in all of its intact files."""
    about, parts = read_parts(folder)
    if damaged := [path.name for path, part in parts.items() if part is None]:
        _log.warning("%s: damaged files are left out: %s", folder, ", ".join(damaged))
    intact = [part for part in parts.values() if part is not None]
    if not intact:
        raise ValueError("it has no frames: record some")
    table = pa.concat_tables(intact).sort_by("time")
    names = [name for name in table.column_names if name in _OTHER or name.startswith("raw_")]
    return about, table.select(names)


def numbers(table: pa.Table, name: str, where: str) -> np.ndarray:
    """Return a column as float64; empty cells are NaN.

    Raises:
        InputError: the column is missing or is not numeric.
    """
    try:
        # A copy, because Arrow's memory cannot be written to and torch warns of that.
        return np.array(table[name].cast(pa.float64()).to_numpy())
    except (KeyError, pa.ArrowException) as error:
        present = ", ".join(table.column_names)
        raise InputError(f"{where}: the column {name} must hold numbers, found {present}: {error}") from error


@dataclass(frozen=True)
class Gauge:
    """Rows of a force gauge, in order of time; one press after the other.

    Attributes:
        time: (N,), s, by the clock of the session.
        force: (N,), N.
        position: (N, 2), m: centre of the indenter, x right and y down from the upper left corner.
        radius: (N,), m: half the larger extent of the indenter.
        angle: (N,), rad: rotation from x towards y.
        indenter: (N,), names as in ``touch.shapes``.
        press: (N,): number of the press.
    """

    time: np.ndarray
    force: np.ndarray
    position: np.ndarray
    radius: np.ndarray
    angle: np.ndarray
    indenter: np.ndarray
    press: np.ndarray

    def __len__(self) -> int:
        return int(self.press.max()) + 1

    @cached_property
    def first(self) -> np.ndarray:
        """The first row of every press, (P,)."""
        return np.searchsorted(self.press, np.arange(len(self)))

    def lies_on(self, size: Sequence[float]) -> bool:
        """Return whether all positions are on a sheet of this size, x and y, m."""
        return bool((self.position >= 0).all() and (self.position <= np.array(size)).all())

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return force, (T,), N, and number of the press, (T,), -1 outside of presses, at times (T,), s."""
        row = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        after = np.minimum(row + 1, len(self.time) - 1)
        press = np.where(self.press[row] == self.press[after], self.press[row], -1)
        press = np.where(time == self.time[row], self.press[row], press)
        press[(time < self.time[0]) | (time > self.time[-1])] = -1
        return np.where(press >= 0, np.interp(time, self.time, self.force), 0.0), press

    def contacts(self, time: np.ndarray, peaks: np.ndarray) -> np.ndarray:
        """Return the presses as contacts at times (T,), s, (T, 1, 5), NaN without force.

        Args:
            time: s.
            peaks: (P,), highest pressure of each press under 1 N, Pa (:func:`pressed_peaks`).

        Returns:
            The columns :data:`skin.touch.labels.CONTACT`.
        """
        force, press = self.at(time)
        rows = self.first[np.maximum(press, 0)]
        values = np.column_stack([self.position[rows], self.radius[rows], force, force * peaks[press]])
        return np.where((force > 0)[:, None], values, np.nan)[:, None]


@dataclass(frozen=True)
class Units:
    """Units of force and time in the files of a bench.

    Attributes:
        force_scale: N per unit of the gauge, negative where pressing is; None: N.
        time_scale: s per unit of ``time``; None: s, and a rate that no bench has is refused.
        command: whose settings these are; errors name it.
    """

    force_scale: float | None = None
    time_scale: float | None = None
    command: str = "calibrate"

    def __post_init__(self) -> None:
        if self.force_scale == 0 or (self.time_scale is not None and not self.time_scale > 0):
            raise InputError(
                f"{self.command}.force_scale must not be 0, and {self.command}.time_scale must be above 0"
            )

    def seconds(self, time: np.ndarray, where: str) -> np.ndarray:
        """Return times (N,) in s.

        Raises:
            InputError: their steps are those of another unit.
        """
        if self.time_scale is not None or len(time) < 3:
            return time * (1.0 if self.time_scale is None else self.time_scale)
        step = float(np.median(np.diff(time)))
        if not step > 0 or _SLOWEST <= 1 / step <= _FASTEST:
            return time
        fits = {name: unit for name, unit in _UNITS.items() if _SLOWEST <= 1 / (step * unit) <= _FASTEST}
        near = sorted(fits, key=lambda name: abs(np.log(100 * step * fits[name])))
        hint = "check the column time"
        if near:
            unit = fits[near[0]]
            hint = f"{near[0]} would be {1 / (step * unit):.4g} Hz: add {self.command}.time_scale={unit:g}"
        raise InputError(
            f"{where}: a row every {step:.4g} s is not the rate of a bench "
            f"({_SLOWEST:g} to {_FASTEST:g} Hz); {hint}"
        )


def read_gauge(
    path: str | Path, indenter: str, radius: float, delay: float = 0.0, units: Units | None = None
) -> Gauge:
    """Read a gauge file with the columns ``time``, ``force``, ``x_m``, ``y_m`` and others of ``GAUGE``.

    Args:
        path: .csv or .parquet.
        indenter: of a file without this column.
        radius: m, of a file without this column.
        delay: s, added to the times of the file to match the session's.
        units: of the file; None: N and s.

    Raises:
        InputError: the file is invalid.
    """
    table, _ = load_table(path, "gauge file")
    return gauge_from_table(table, str(path), indenter, radius, delay, units)


def gauge_from_table(
    table: pa.Table,
    where: str,
    indenter: str,
    radius: float,
    delay: float = 0.0,
    units: Units | None = None,
) -> Gauge:
    """Return a gauge from the complete rows of a table; see :func:`read_gauge`."""
    units = units or Units()
    columns = {name: numbers(table, name, where) for name in ("time", "force", "x_m", "y_m")}
    for name, spare in (("radius_m", radius), ("angle", 0.0), ("press", 0.0)):
        present = name in table.column_names
        columns[name] = numbers(table, name, where) if present else np.full(len(table), spare)
    names = (
        table["indenter"].fill_null("").to_numpy(zero_copy_only=False)
        if "indenter" in table.column_names
        else np.full(len(table), indenter, dtype=object)
    )
    rows = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if not rows.any():
        raise InputError(f"{where}: no row has a time, a force and a place")
    complete = {name: values[rows] for name, values in columns.items()}
    time = units.seconds(complete["time"], where) + delay
    force = complete["force"] * (units.force_scale or 1.0)
    if (np.diff(time) <= 0).any():
        raise InputError(f"{where}: time must grow from row to row, in s")
    if -force.min() > 2 * force.max():
        raise InputError(
            f"{where}: force goes down to {force.min():g}, so pressing seems to be negative: add "
            f"{units.command}.force_scale={-(units.force_scale or 1.0):g}"
        )
    if force.min() < -0.05 * force.max():
        raise InputError(f"{where}: force must be at least 0 N, got {force.min():g}: zero the gauge")
    position = np.stack([complete["x_m"], complete["y_m"]], axis=1)
    same = np.column_stack([position, complete["radius_m"], complete["angle"], complete["press"]])
    new = (np.diff(same, axis=0) != 0).any(axis=1) | (names[rows][1:] != names[rows][:-1])
    press = np.concatenate([[0], np.cumsum(new | (np.diff(time) > _PAUSE))])
    return Gauge(
        time,
        np.maximum(force, 0),
        position,
        complete["radius_m"],
        complete["angle"],
        names[rows].astype(str),
        press,
    )


@torch.no_grad()
def per_newton(simulator: AbstractSimulator, body: AbstractBody, gauge: Gauge) -> np.ndarray:
    """Return the true readings of every sensor per N of each press, (P, S).

    Simulators are positively homogeneous, so one frame of 1 N determines a press of any force.

    Raises:
        InputError: a position outside the sheet, a radius that is not above 0, or an unknown indenter.
    """
    position, radius = gauge.position[gauge.first], gauge.radius[gauge.first]
    if (position < 0).any() or (position > body.size).any():
        wrong = position[((position < 0) | (position > body.size)).any(axis=1)][0]
        raise InputError(
            f"a press at {wrong.tolist()} m is outside the sheet of {list(body.size)} m: x_m and y_m are "
            "metres from its upper left corner"
        )
    if not (radius > 0).all():
        raise InputError(f"radius_m must be above 0 m, got {radius.min():g}")
    return torch.cat([simulator(image).readings for image in pressed_images(body, gauge)]).double().numpy()


def pressed_images(body: AbstractBody, gauge: Gauge) -> Iterator[torch.Tensor]:
    """Yield the pressure of each press under 1 N, (1, H, W), Pa."""
    shapes, kind, scale = _indenters(body, gauge)
    for number, row in enumerate(gauge.first):
        pose = kind[[number]], gauge.angle[[row]], scale[[number]], gauge.position[[row]]
        yield shapes.render(*pose) / float(np.prod(body.cell))


def pressed_peaks(body: AbstractBody, gauge: Gauge) -> np.ndarray:
    """Return the highest pressure of each press under 1 N, (P,), Pa, by the picture of its indenter."""
    shapes, kind, _ = _indenters(body, gauge)
    return peak_per_newton(shapes, kind, gauge.radius[gauge.first])


def _indenters(body: AbstractBody, gauge: Gauge) -> tuple[Shapes, np.ndarray, np.ndarray]:
    """Return the shapes that press, and of each press the shape's index and the scale, m."""
    names, kind = np.unique(gauge.indenter[gauge.first], return_inverse=True)
    shapes = Shapes(names.tolist(), body)
    return shapes, kind, gauge.radius[gauge.first] / half_extents(shapes)[kind]


@checked("session")
@dataclass(frozen=True)
class BenchSession:
    """Raw readings of a skin, and the force gauge during the same time.

    Attributes:
        time: (T,), s.
        raw: (T, S), in ``unit``; NaN where a frame was lost.
        unit: ``N``, or ``adc`` for counts of a converter.
        gauge: rows of the force gauge in the same file; None if they are in another file.
        bits: of the converter; None if unknown.
        channels: the device's channel of every column, where skin record has put them into the order of the
            layout; None: columns are in the device's order.

    Raises:
        InputError: another unit, or times that do not increase.
    """

    time: np.ndarray
    raw: np.ndarray
    unit: Literal["N", "adc"]
    gauge: Gauge | None = None
    bits: Annotated[int, Ge(1), Le(64)] | None = None
    channels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if len(self.time) < 2:
            raise InputError(f"a session needs at least two frames, this one has {len(self.time)}")
        if (self.time == self.time[0]).all():
            raise InputError(
                f"the device's clock stood still: all {len(self.time)} frames of the session have the time "
                f"{self.time[0]:g} s; let it send micros() and record again"
            )
        if (back := np.flatnonzero(~(np.diff(self.time) > 0))).size:
            before, after = self.time[back[0] : back[0] + 2]
            raise InputError(
                f"the session's time must grow from frame to frame: after frame {back[0]} it goes from "
                f"{before:.9g} to {after:.9g} s"
            )


def read_bench_session(
    path: str | Path, indenter: str, radius: float, unit: str | None = None, units: Units | None = None
) -> BenchSession:
    """Read a session.

    The file has a column ``time`` (s) or ``t_us`` (microseconds) and one per sensor in the layout's order, of
    any name; ``seq`` is ignored. Columns of a gauge may stand beside them, empty outside the presses. Unit
    and bits may stand in the Parquet schema or in ``x.csv.json``: ``{"unit": "adc", "bits": 10}``.

    Args:
        path: .csv or .parquet, or the folder of a session of skin record.
        indenter: of gauge rows without one.
        radius: m, of gauge rows without one.
        unit: ``N`` or ``adc``; None: the unit in the file, else N.
        units: of the columns of a gauge, and of ``time``; None: N and s.

    Raises:
        InputError: the file is invalid.
    """
    table, about = load_table(path, "session")
    names = [name for name in table.column_names if name not in _OTHER]
    if not names:
        raise InputError(f"{path}: no column of a sensor beside {', '.join(table.column_names)}")
    in_microseconds = "time" not in table.column_names and "t_us" in table.column_names
    time = numbers(table, "t_us" if in_microseconds else "time", str(path))
    units = units or Units()
    time = units.seconds(1e-6 * time if in_microseconds else time, str(path))
    raw = np.stack([numbers(table, name, str(path)) for name in names], axis=1)
    inside = "force" in table.column_names
    if inside:
        present = [name for name in table.column_names if name != "time"]
        table = table.select(present).append_column("time", [time])
    in_seconds = replace(units, time_scale=1.0)
    rows = gauge_from_table(table, str(path), indenter, radius, units=in_seconds) if inside else None
    try:
        unit_of_values: Any = unit or about.get("unit", "N")
        return BenchSession(time, raw, unit_of_values, rows, about.get("bits"), about.get("channels"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_bench_session(session: BenchSession, path: str | Path) -> Path:
    """Write a session with its gauge atomically, as :func:`load_table` reads it; single precision.

    Raises:
        InputError: another ending than .csv or .parquet, or the file cannot be written.
    """
    path, digits = tabular(path, "a session"), max(2, len(str(session.raw.shape[1] - 1)))
    counts = session.unit == "adc" and np.isfinite(session.raw).all()
    raw = session.raw.T.astype(np.int32 if counts else np.float32)
    columns = {"time": session.time} | {f"raw_{n:0{digits}d}": values for n, values in enumerate(raw)}
    if (gauge := session.gauge) is not None:
        force, press = gauge.at(session.time)
        row = gauge.first[np.maximum(press, 0)]
        position, shape = gauge.position[row].T, (gauge.indenter[row], gauge.radius[row], gauge.angle[row])
        values = zip(GAUGE, (force, *position, *shape, press), strict=True)
        columns |= {name: np.ma.masked_array(column, press < 0) for name, column in values}
    table, about = pa.table(columns), json.dumps({"unit": session.unit, "bits": session.bits})
    with whole(path) as partial:
        if path.suffix == ".parquet":
            pa.parquet.write_table(table.replace_schema_metadata({_KEY: about}), partial)
        else:
            pa.csv.write_csv(table, partial)
            write(about + "\n", path.with_name(path.name + ".json"))
    return path


_LEAD, _TAIL = 0.2, 1.0  # s around a press that are not idle
_FEWEST = 50  # idle frames


def true_readings(gauge: Gauge, each: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return true readings (T, S), N, of presses that give ``each`` (P, S) per N; 0 outside of them."""
    force, press = gauge.at(time)
    return np.where(press[:, None] >= 0, force[:, None] * each[press], 0.0)


@dataclass(frozen=True)
class BenchData:
    """Measured readings and simulated true readings of a bench session, frame by frame.

    Attributes:
        session: the raw readings.
        gauge: force and position of the presses.
        each: true readings per N of every press, (P, S).
    """

    session: BenchSession
    gauge: Gauge
    each: np.ndarray

    @cached_property
    def true(self) -> np.ndarray:
        """Simulated true readings, (T, S), N."""
        return true_readings(self.gauge, self.each, self.session.time)

    @cached_property
    def applied(self) -> tuple[np.ndarray, np.ndarray]:
        """The gauge's force, (T,), N, and the number of the press, (T,), -1 outside."""
        return self.gauge.at(self.session.time)

    @cached_property
    def idle(self) -> np.ndarray:
        """Frames without a press, (T,), bool."""
        first, time = self.gauge.first, self.session.time
        ends = self.gauge.time[np.append(first[1:], len(self.gauge.time)) - 1]
        begun = np.searchsorted(self.gauge.time[first] - _LEAD, time, side="right")
        return (begun == 0) | (time > ends[begun - 1] + _TAIL)

    def frames_of(self, presses: Collection[int]) -> np.ndarray:
        """Frames of some presses, (T,), bool."""
        return np.isin(self.applied[1], list(presses))

    @cached_property
    def peaks(self) -> np.ndarray:
        """The largest force of the press so far, (T,), N."""
        force, press = self.applied
        return pd.Series(force).groupby(press).cummax().to_numpy()

    @property
    def loading(self) -> np.ndarray:
        """Frames at the largest force of their press so far, (T,), bool."""
        return (self.applied[0] > 0) & (self.applied[0] >= 0.995 * self.peaks)


def check_channels(device: Simulated, session: BenchSession) -> None:
    """Raise InputError unless a session has a channel for each sensor of the layout."""
    channels, sensors = session.raw.shape[1], len(device.sensors)
    if channels != sensors:
        raise InputError(
            f"the session has {channels} channels, the layout {sensors} sensors: give the layout it was "
            "recorded with, as in layout=file layout.path=FILE.csv"
        )


def build_bench_data(device: Simulated, session: BenchSession, gauge: Gauge | None) -> BenchData:
    """Simulate the presses of a session on the skin as designed.

    Raises:
        InputError: no gauge, another number of sensors, or times of gauge and session that do not overlap.
    """
    rows = gauge or session.gauge
    if rows is None:
        raise InputError("no force in the session: add presses=gauge.csv with time, force, x_m and y_m")
    check_channels(device, session)
    model = device.simulator(device.body, device.sensors)
    bench = BenchData(session, rows, per_newton(model, device.body, rows))
    if not bench.loading.any():
        spans = [np.ptp(values) for values in (session.time, rows.time)]
        raise InputError(
            f"no frame of the session ({spans[0]:.4g} s long) falls into a press of the gauge "
            f"({spans[1]:.4g} s): check the clocks and their units, see calibrate.delay"
        )
    if bench.idle.sum() < _FEWEST:
        raise InputError(
            f"{bench.idle.sum()} idle frames, needed are {_FEWEST}: do not touch the skin for some seconds"
        )
    return bench
