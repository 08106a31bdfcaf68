"""A session of a bench: its files, the force gauge, presses, and their simulated true readings."""

import json
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import torch
from annotated_types import Ge, Le
from pydantic import NegativeFloat, NonNegativeInt, PositiveFloat

from skin.body.base import AbstractBody, Sensors, require_memory
from skin.core.files import tabular, whole
from skin.core.safe_loading import read_parts
from skin.core.settings import checked, configured
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.inference.mechanics import thicken
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.shapes import pressed_images

_KEY = b"skin_session"
_log = logging.getLogger(__name__)
_PRESS = ["indenter", "x_m", "y_m", "radius_m", "angle"]  # what stays the same during a press
_PAUSE = 1.0  # s without a row end a press
_SLOWEST, _FASTEST = 1.0, 5000.0  # Hz of a bench's files
_OTHER = ("time", "t_us", "seq", "gesture", "force", "press", *_PRESS)  # columns that are no sensor

Turn = Literal[
    "as_given",
    "mirror_x",
    "mirror_y",
    "rotate_180",
    "transpose",
    "rotate_90",
    "rotate_270",
    "transpose_other",
]
TURNS: dict[Turn, tuple[np.ndarray, str]] = {
    "as_given": (np.array([[1, 0], [0, 1]]), "as given"),
    "mirror_x": (np.array([[-1, 0], [0, 1]]), "mirrored in x (the x axis counts to the left)"),
    "mirror_y": (np.array([[1, 0], [0, -1]]), "mirrored in y (the y axis counts upwards)"),
    "rotate_180": (np.array([[-1, 0], [0, -1]]), "turned by 180 degrees (both axes count backwards)"),
    "transpose": (np.array([[0, 1], [1, 0]]), "transposed (x and y are exchanged)"),
    "rotate_90": (np.array([[0, -1], [1, 0]]), "turned by 90 degrees"),
    "rotate_270": (np.array([[0, 1], [-1, 0]]), "turned by 270 degrees"),
    "transpose_other": (
        np.array([[0, -1], [-1, 0]]),
        "mirrored at the other diagonal (x and y are exchanged, and both count backwards)",
    ),
}
"""Values of ``places``, the simplest first: from the direction in the gauge's frame to that on the sheet, x
right and y down; and its words."""


@dataclass(frozen=True)
class BenchSettings:
    """How the files of a bench are read, and what the user confirms about them.

    Attributes:
        indenter, radius: of gauge rows without them, name as in ``touch.shapes``, and m.
        unit: of the session; None: the unit in the file, else N.
        force_scale: N per unit of the gauge, negative where pressing is; None: N.
        time_scale: s per unit of ``time``; None: s, and a rate that no bench has is refused.
        delay: s, added to the times of a gauge's own file to match the session's.
        places: how the positions of the presses are turned to be those of the sheet.
        channels: column of the session, from 0, of every sensor; None: the same order.
        broken: sensors, from 0, that count as dead.
        command: whose settings these are; errors name it.
    """

    indenter: str = "disc"
    radius: PositiveFloat = 0.01
    unit: Literal["N", "adc"] | None = None
    force_scale: PositiveFloat | NegativeFloat | None = None
    time_scale: PositiveFloat | None = None
    delay: float = 0.0
    places: Turn = "as_given"
    channels: Sequence[NonNegativeInt] | None = None
    broken: Sequence[NonNegativeInt] = ()
    command: str = "calibrate"

    @classmethod
    def of(cls, group: Mapping[str, Any], command: str) -> "BenchSettings":
        """Return these settings of the group of a command.

        Raises:
            InputError: a value is invalid.
        """
        return configured(
            cls,
            {name: group[name] for name in cls.__dataclass_fields__.keys() & group.keys()}
            | {"command": command},
            command,
        )

    def seconds(self, time: np.ndarray, where: str) -> np.ndarray:
        """Return times (N,) in s.

        Raises:
            InputError: they are fewer than two, do not increase, or their steps are those of another unit.
        """
        time = time * (self.time_scale or 1.0)
        if len(time) < 2:
            raise InputError(f"{where}: at least two rows are needed, got {len(time)}")
        steps = np.diff(time)
        if (back := np.flatnonzero(~(steps > 0))).size:
            raise InputError(
                f"{where}: time must grow from row to row, but after row {back[0]} it goes from "
                f"{time[back[0]]:.9g} to {time[back[0] + 1]:.9g} s: check the clock, such as micros() of a "
                "board, and record again"
            )
        if self.time_scale is None and not _SLOWEST <= (rate := 1 / np.median(steps)) <= _FASTEST:
            raise InputError(
                f"{where}: {rate:.4g} rows per second, and a bench has {_SLOWEST:g} to {_FASTEST:g}: "
                f"add {self.command}.time_scale=0.001 if times are in ms, 1e-6 if they are in "
                "microseconds, 60 if they are in minutes"
            )
        return time


def load_table(path: str | Path, what: str) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return a table and its metadata, which a Parquet file has as JSON in its schema, and a CSV lacks.

    Lines of a CSV that start with ``#`` are comments. The folder of a session of skin record becomes the
    table of its frames; damaged files are left out, with a warning.

    Raises:
        InputError: no such file, another ending, unreadable, or no rows.
    """
    path = Path(path).expanduser()
    path = path if path.is_dir() else tabular(path, f"a {what} is a folder of skin record that exists, or")
    try:
        if path.is_dir():
            metadata, table = _join(path)
        elif path.suffix == ".parquet":
            with pa.parquet.ParquetFile(path) as file:
                require_memory(
                    16.0 * file.metadata.num_rows * file.metadata.num_columns,
                    f"the {what} {path}",
                    "give fewer rows",
                )
                content = file.read()
            metadata = json.loads((content.schema.metadata or {}).get(_KEY, b"{}"))
            table = content.to_pandas()
        else:
            table = pd.read_csv(path, comment="#", index_col=False, encoding="utf-8-sig", low_memory=False)
            metadata = {}
        if not isinstance(metadata, dict) or table.empty:
            raise ValueError(f"it has no rows below its header, or its metadata {metadata!r} are no object")
    except (OSError, pa.ArrowException, ValueError, RecursionError) as error:
        raise InputError(f"cannot read the {what} {path}: {' '.join(str(error).split())}") from error
    return table.rename(columns=str.strip), metadata


def _join(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    """Return the metadata of a session of skin record, and the frames in all of its intact files."""
    metadata, parts = read_parts(folder)
    if damaged := [path.name for path, part in parts.items() if part is None]:
        _log.warning("%s: damaged files are left out: %s", folder, ", ".join(damaged))
    intact = [part for part in parts.values() if part is not None]
    if not intact:
        raise ValueError("it has no frames: record some")
    table = pa.concat_tables(intact).sort_by("time").to_pandas()
    # A channel without a value repeats its last one.
    return metadata, pd.DataFrame(
        {name: table[name] for name in table if name in _OTHER}
        | {
            name: table[name].mask(table[f"state_{name.removeprefix('raw_')}"] & 1 > 0)
            for name in table
            if name.startswith("raw_")
        }
        | {
            name.replace("state", "saturated"): table[name] // 2
            for name in table
            if name.startswith("state_") and (table[name] & 2).any()
        }
    )


def _numbers(table: pd.DataFrame, names: Sequence[str], where: str) -> np.ndarray:
    """Return columns as float64, (N, K); empty cells are NaN."""
    try:
        return table[[*names]].apply(pd.to_numeric).to_numpy(float)
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{where}: {', '.join(names)} must be columns of numbers, found {', '.join(table)}: {error}"
        ) from error


@dataclass(frozen=True)
class Gauge:
    """Rows of a force gauge, in order of time; one press after the other.

    Attributes:
        time: (N,), s, by the clock of the session.
        force: (N,), N.
        press: (N,): number of the press, from 0.
        presses: a row per press: ``indenter``, name as in ``touch.shapes``; ``x_m`` and ``y_m``, centre of
            the indenter, x right and y down from the upper left corner; ``radius_m``, half its larger
            extent; ``angle``, rotation from x towards y, rad.
    """

    time: np.ndarray
    force: np.ndarray
    press: np.ndarray
    presses: pd.DataFrame

    @classmethod
    def of(cls, table: pd.DataFrame, where: str, settings: BenchSettings) -> "Gauge":
        """Return a gauge from the rows of a table with ``time``, ``force``, ``x_m``, ``y_m`` and others.

        Raises:
            InputError: the rows are invalid.
        """
        table = pd.DataFrame(
            {"indenter": settings.indenter, "radius_m": settings.radius, "angle": 0.0, "press": 0.0},
            index=table.index,
        ).assign(**{str(name): column for name, column in table.items()})
        names = ["time", "force", "press", *_PRESS[1:]]
        values = _numbers(table, names, where)
        complete = np.isfinite(values).all(axis=1)
        if not complete.any():
            raise InputError(f"{where}: no row has a time, a force and a place")
        rows = pd.DataFrame(values[complete], columns=names)
        rows["indenter"] = table["indenter"].astype(str).to_numpy()[complete]
        time = settings.seconds(rows["time"].to_numpy(), where)
        force = rows["force"].to_numpy() * (settings.force_scale or 1.0)
        if -force.min() > 0.05 * force.max():
            raise InputError(
                f"{where}: force goes down to {force.min():g} N: zero the gauge, or if pressing is negative, "
                f"add {settings.command}.force_scale={-(settings.force_scale or 1):g}"
            )
        same = rows[["press", *_PRESS]]
        press = (
            (same != same.shift()).any(axis=1).to_numpy() | (np.diff(time, prepend=time[0]) > _PAUSE)
        ).cumsum() - 1
        return cls(time, np.maximum(force, 0), press, rows[_PRESS].groupby(press).first())

    def __len__(self) -> int:
        return len(self.presses)

    @property
    def position(self) -> np.ndarray:
        """The centre of the indenter in every press, (P, 2), m."""
        return self.presses[["x_m", "y_m"]].to_numpy()

    @cached_property
    def first(self) -> np.ndarray:
        """The first row of every press, (P,)."""
        return np.searchsorted(self.press, np.arange(len(self)))

    def outside(self, size: Sequence[float]) -> np.ndarray:
        """Return the positions that are outside a sheet of this size, x and y, m, (K, 2)."""
        return self.position[((self.position < 0) | (self.position > np.array(size))).any(axis=1)]

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return force, (T,), N, and number of the press, (T,), -1 outside of presses, at times (T,), s."""
        row = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1)
        after = np.minimum(row + 1, len(self.time) - 1)
        press = np.where(
            (self.press[row] == self.press[after]) | (time == self.time[row]), self.press[row], -1
        )
        press[(time < self.time[0]) | (time > self.time[-1])] = -1
        return np.where(press >= 0, np.interp(time, self.time, self.force), 0.0), press

    def turned(self, turn: Turn, size: Sequence[float]) -> "Gauge":
        """Return this gauge with its places and angles in the frame of the sheet.

        Args:
            turn: from the frame of the gauge to that of the sheet.
            size: of the sheet, x and y, m.
        """
        matrix, middle = TURNS[turn][0], np.array(size) / 2
        x, y = matrix @ (self.position - np.abs(matrix).T @ middle).T + middle[:, None]
        across, along = matrix @ np.stack([np.cos(self.presses["angle"]), np.sin(self.presses["angle"])])
        return replace(self, presses=self.presses.assign(x_m=x, y_m=y, angle=np.arctan2(along, across)))

    def contacts(self, time: np.ndarray, peaks: np.ndarray) -> np.ndarray:
        """Return the presses as contacts at times (T,), s, (T, 1, 5), NaN without force.

        Args:
            time: s.
            peaks: (P,), highest pressure of each press under 1 N, Pa (:func:`pressed_peaks`).

        Returns:
            The columns :data:`skin.touch.labels.CONTACT`.
        """
        force, press = self.at(time)
        values = np.column_stack(
            [self.presses[["x_m", "y_m", "radius_m"]].to_numpy()[press], force, force * peaks[press]]
        )
        return np.where((force > 0)[:, None], values, np.nan)[:, None]


@torch.no_grad()
def per_newton(simulator: AbstractSimulator, body: AbstractBody, gauge: Gauge) -> np.ndarray:
    """Return the true readings of every sensor per N of each press, (P, S).

    Simulators are positively homogeneous, so one frame of 1 N determines a press of any force.

    Raises:
        InputError: a position outside the sheet, a radius that is not above 0, or an unknown indenter.
    """
    if len(outside := gauge.outside(body.size)):
        raise InputError(
            f"a press at {outside[0].tolist()} m is outside the sheet of {list(body.size)} m: x_m and y_m "
            "are metres from its upper left corner"
        )
    if not (gauge.presses["radius_m"] > 0).all():
        raise InputError(f"radius_m must be above 0 m, got {gauge.presses['radius_m'].min():g}")
    return (
        torch.cat([simulator(image).readings for image in pressed_images(body, gauge.presses)])
        .double()
        .numpy()
    )


@checked("session")
@dataclass(frozen=True)
class BenchSession:
    """Raw readings of a skin, and the force gauge during the same time.

    Attributes:
        time: (T,), s since its first frame.
        raw: (T, S), in ``unit``; NaN where a frame was lost, or the device sent no value.
        unit: ``N``, or ``adc`` for counts of a converter.
        gauge: rows of the force gauge; None if there are none.
        bits: of the converter; None if unknown.
        channels: the device's channel of every column, where skin record has put them into the order of the
            layout; None: columns are in the device's order.
        saturated: (T, S), bool: the value is known to be at a limit; None: of none.

    Raises:
        InputError: another unit.
    """

    time: np.ndarray
    raw: np.ndarray
    unit: Literal["N", "adc"]
    gauge: Gauge | None = None
    bits: Annotated[int, Ge(1), Le(64)] | None = None
    channels: Sequence[int] | None = None
    saturated: np.ndarray | None = None

    @property
    def limited(self) -> np.ndarray:
        """Where a channel is at its limit, or has no value, (T, S), bool.

        Whole numbers are counts. Unknown bits of a converter, at least 8, are those of the largest number.
        """
        valid = np.isfinite(self.raw)
        bits = self.bits or int(np.max(self.raw, where=valid, initial=255)).bit_length()
        return (
            ~valid
            | (
                np.isin(self.raw, [0, 2.0**bits - 1])
                & (self.unit == "adc" or (self.raw[valid] % 1 == 0).all())
            )
            | (False if self.saturated is None else self.saturated)
        )


def read_bench_session(
    path: str | Path, settings: BenchSettings, presses: str | Path | None = None
) -> BenchSession:
    """Read a session.

    The file has a column ``time`` (s) or ``t_us`` (microseconds) and one per sensor in the layout's order, of
    any name; ``seq`` is ignored. ``saturated_`` and this name may be 1 where the sensor is at its limit.
    Columns of a gauge may stand beside them, empty outside the presses. Unit and bits may stand in the
    Parquet schema: ``{"unit": "adc", "bits": 10}``.

    Args:
        path: .csv or .parquet, or the folder of a session of skin record.
        settings: of the files.
        presses: .csv or .parquet with the rows of the gauge; None: they are in the session.

    Raises:
        InputError: a file is invalid.
    """
    table, metadata = load_table(path, "session")
    names = [name for name in table if name not in _OTHER and not name.startswith("saturated_")]
    limits = [f"saturated_{name.removeprefix('raw_')}" for name in names]
    if not names:
        raise InputError(f"{path}: no column of a sensor beside {', '.join(table)}")
    if "time" not in table and "t_us" in table:
        table = table.assign(time=1e-6 * _numbers(table, ["t_us"], str(path))[:, 0])
    time, raw = _numbers(table, ["time"], str(path))[:, 0], _numbers(table, names, str(path))
    gauge = Gauge.of(table, str(path), settings) if "force" in table and presses is None else None
    if presses is not None:
        gauge = Gauge.of(load_table(presses, "gauge file")[0], str(presses), settings)
    unit: Any = settings.unit or metadata.get("unit", "N")
    try:
        session = BenchSession(
            time,
            raw,
            unit,
            gauge,
            metadata.get("bits"),
            metadata.get("channels"),
            _numbers(table.filter(limits).reindex(columns=limits, fill_value=0), limits, str(path)) > 0,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    time = settings.seconds(time, str(path))
    # Offsets are those at the beginning: a clock may have run for hours.
    return replace(
        session,
        time=time - time[0],
        gauge=gauge and replace(gauge, time=gauge.time - time[0] + settings.delay * (presses is not None)),
    )


def write_bench_session(session: BenchSession, path: str | Path) -> Path:
    """Write a session with its gauge atomically, as :func:`load_table` reads it; single precision.

    A CSV has no unit: read it with that of the session.

    Raises:
        InputError: another ending than .csv or .parquet, or the file cannot be written.
    """
    path, columns = tabular(path, "a session"), enumerate(session.raw.T.astype(np.float32))
    table = pd.DataFrame({"time": session.time} | {f"raw_{n:03d}": values for n, values in columns})
    if session.gauge is not None:
        force, press = session.gauge.at(session.time)
        presses = session.gauge.presses.rename_axis("press").reset_index().reindex(press)
        table = table.join(presses.assign(force=np.where(press >= 0, force, np.nan)).reset_index(drop=True))
    metadata = json.dumps({"unit": session.unit, "bits": session.bits})
    with whole(path) as partial:
        if path.suffix == ".parquet":
            pa.parquet.write_table(
                pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata({_KEY: metadata}),
                partial,
            )
        else:
            table.to_csv(partial, index=False)
    return path


_LEAD, _TAIL = 0.2, 1.0  # s around a press that are not idle
_FEWEST = 50  # idle frames


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
        return self.applied[0][:, None] * self.each[self.applied[1]]

    @cached_property
    def applied(self) -> tuple[np.ndarray, np.ndarray]:
        """The gauge's force, (T,), N, and the number of the press, (T,), -1 outside."""
        return self.gauge.at(self.session.time)

    @cached_property
    def begun(self) -> np.ndarray:
        """Number of presses that have begun, (T,), a fifth of a second before their first row."""
        return np.searchsorted(self.gauge.time[self.gauge.first] - _LEAD, self.session.time, side="right")

    @cached_property
    def idle(self) -> np.ndarray:
        """Frames without a press, (T,), bool."""
        return (
            self.session.time
            > np.append(-np.inf, np.maximum.reduceat(self.gauge.time, self.gauge.first) + _TAIL)[self.begun]
        )

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


def build_bench_data(device: Simulated, session: BenchSession) -> BenchData:
    """Simulate the presses of a session on the skin as designed.

    Raises:
        InputError: no gauge, another number of sensors, or times of gauge and session that do not overlap.
    """
    gauge = session.gauge
    if gauge is None:
        raise InputError("no force in the session: add presses=gauge.csv with time, force, x_m and y_m")
    check_channels(device, session)
    bench = BenchData(
        session, gauge, per_newton(device.simulator(device.body, device.sensors), device.body, gauge)
    )
    if not bench.loading.any():
        spans = [np.ptp(values) for values in (session.time, gauge.time)]
        raise InputError(
            f"no frame of the session ({spans[0]:.4g} s long) falls into a press of the gauge "
            f"({spans[1]:.4g} s): check the clocks and their units, see calibrate.delay"
        )
    if bench.idle.sum() < _FEWEST:
        raise InputError(
            f"{bench.idle.sum()} idle frames, needed are {_FEWEST}: do not touch the skin for some seconds"
        )
    return bench


# Another thickness of the layers.


# Factors on the thickness: of the operators, between which interpolation errs by 0.5 % of the largest reading
# (skin/inference/watch.py); that are compared.
_FACTORS, _SEARCHED = (0.8, 1.0, 1.25), (0.6, 1.6)
# Errors: of a reading, 0.35 of gains and model (skin/calibration/known_loads.py) without 0.3 of gains; of the
# largest one.
_MODEL, _BESIDE = 0.18, 0.03
# Of the largest reading: under most loads of the default skin, a second sensor has less; gains change by 1 %.
_FELT = 0.05
# Part of the misfit, and standard deviations, that another thickness must explain. Of 120 emulated devices as
# described (30 mm, 3 x 3 and 6 x 6 sensors, off by 2 mm, one of them dead, gain spread 30 %, cross-talk up to
# 2 %), it explains at most 0.05; of 40 that are 24 mm thick, at least 0.24.
_EXPLAINED, _SURE = 0.1, 3.0


@torch.no_grad()
def warn_of_thickness(
    device: Simulated,
    described: np.ndarray,
    readings: np.ndarray,
    noise: np.ndarray,
    simulate: Callable[[AbstractBody, Sensors], np.ndarray],
) -> dict[str, float]:
    """Warn where readings fit another thickness of all layers than the described one; return it, m, by name.

    How far a load is felt tells the thickness, whatever the gain of each sensor is. Residuals between three
    thicknesses are interpolated quadratically in the logarithm (:class:`skin.inference.watch.Thickness`).
    Nothing is said of an arm, of a simulator without depth, or where one sensor alone feels a load.

    Args:
        device: with the skin as designed.
        described: its true readings under loads, (P, S), N.
        readings: measured ones, (P, S), N, by the fitted gains; NaN: without a gain.
        noise: of these readings, (S,), N.
        simulate: ``simulate(body, sensors)``: those of another skin.
    """
    known, residuals = np.isfinite(readings).all(axis=0), list[np.ndarray]()
    sizes = np.abs([described, readings])[..., known]
    felt = (sizes > _FELT * sizes.max(axis=2, keepdims=True, initial=0.0)).sum(axis=2)
    if not (device.body.flat and device.model.feels_shear and np.median(felt, axis=1).max() > 1):
        return {}
    error = np.hypot(np.hypot(_MODEL * described, noise), _BESIDE * described.max())
    for factor in _FACTORS:
        expected = simulate(*thicken(device.body, device.sensors, factor)) / error
        gains = (readings / error * expected).sum(axis=0) / (expected**2).sum(axis=0)
        residuals.append((readings / error / gains - expected)[:, known].ravel())
    fine = np.log(np.linspace(*_SEARCHED, 201))
    misfits = ((np.vander(fine, 3) @ np.polyfit(np.log(_FACTORS), residuals, 2)) ** 2).sum(axis=1)
    misfit = float((residuals[1] ** 2).sum())
    if misfit - misfits.min() < max(_EXPLAINED * misfit, _SURE**2):
        return {}
    fitted = float(np.exp(fine[misfits.argmin()])) * device.body.thickness
    warnings.warn(
        f"readings fit layers of {1e3 * fitted:.2g} mm in all better than the described "
        f"{1e3 * device.body.thickness:.3g} mm: a wrong thickness or width of the load makes gains wrong; "
        "measure both, correct the one that is wrong, and calibrate again (live.thickness takes a range, but "
        "leaves the gains as they are)",
        UserWarning,
        stacklevel=3,
    )
    return {"thickness that fits": float(f"{fitted:.2g}")}
