"""Formats of foreign recordings: a mapping says what plain tables hold, and the tables themselves.

A mapping is YAML with the settings of :class:`ForeignFormat`, and pandas reads the tables. Columns are named
by the header or, with ``table: {header: null}``, numbered from 0; the named groups of the regular expression
``fields`` become columns, too.
"""

import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from annotated_types import Ge, Gt, MinLen

from skin.core.files import CONF
from skin.core.safe_loading import TEXT, parse_yaml, read_file
from skin.core.settings import check_settings
from skin.errors import InputError

Column = str | int

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_G = 9.80665  # m/s^2, standard gravity
FORCES = {
    "N": 1.0, "mN": 1e-3, "kN": 1e3, "g": 1e-3 * _G, "gf": 1e-3 * _G, "kg": _G, "kgf": _G, "lbf": 4.4482216
}  # fmt: skip
TARGETS = {"x": LENGTHS, "y": LENGTHS, "force": FORCES, "force_x": FORCES, "force_y": FORCES}
"""What a touch can be measured by -> its units."""
TIME = " time"
"""Column of the time, s; no header has a name that begins with a blank."""


@dataclass(frozen=True)
class TimeColumn:
    """Column of the time: numbers in a unit, or dates, which ``table: {parse_dates: [NAME]}`` reads."""

    column: Column
    unit: Literal["s", "ms", "us", "ns", "min"] = "s"


@dataclass(frozen=True)
class ChannelColumns:
    """The readings.

    Attributes:
        columns: in the order of the sensors; or a pattern such as ``ch*``.
        unit: a force (N, mN, kN, g, gf, kg, kgf, lbf), or any other with ``scale``.
        scale: N per unit, one or one per column; negative where values fall with force. A nominal one makes
            readings nominal.
    """

    columns: Annotated[Sequence[Column], MinLen(1)] | str
    unit: str
    scale: float | Sequence[float] | None = None


@dataclass(frozen=True)
class SegmentRule:
    """What a touch is.

    Attributes:
        by: a ``row``, a ``file``, equal ``windows`` of it, or a ``contact`` with the frames around it.
        frames: frames of each touch; shorter ones are padded with 0, longer ones cut.
        before: idle frames before a row, or frames before a contact.
        step: frames from one window to the next; None: ``frames``.
        threshold: N, of a contact: above it any reading is, up or down.
        gap: frames below the threshold that do not end a contact.
    """

    by: Literal["row", "file", "windows", "contact"]
    frames: Annotated[int, Ge(1)] = 30
    before: Annotated[int, Ge(0)] = 2
    step: Annotated[int, Ge(1)] | None = None
    threshold: Annotated[float, Gt(0)] | None = None
    gap: Annotated[int, Ge(0)] = 3


@dataclass(frozen=True)
class LabelRule:
    """Where a label is 0, 1 or unknown: by the values of a column, or by a target.

    Attributes:
        column: of the file or of its path; values of several columns are joined by a blank.
        values: value -> 0 or 1; others, and none, are unknown.
        target: whose value decides.
        above: the label is 1 above it, N or m, else 0.
    """

    column: Column | Sequence[Column] | None = None
    values: dict[str | int, int] | None = None
    target: str | None = None
    above: float | None = None


@dataclass(frozen=True)
class ClassRule:
    """Exclusive classes by the values of columns; ``names`` lists them in their order."""

    column: Column | Sequence[Column]
    names: list[str | int] | None = None


@dataclass(frozen=True)
class TargetColumn:
    """A measured quantity of each touch.

    Attributes:
        column: of the file.
        unit: of lengths m, cm, mm, um or in; of forces as in :class:`ChannelColumns`.
    """

    column: Column
    unit: str


@dataclass(frozen=True)
class ForeignFormat:
    """A mapping from foreign files to a recording.

    Attributes:
        files: pattern of paths below the folder, such as ``*/*.csv``.
        channels: the readings.
        segments: what a touch is.
        about: origin and licence, in words.
        fields: regular expression that the path of each file contains; its named groups become columns.
        table: how files are written: options of ``pandas.read_csv``, such as ``sep``, ``skiprows`` or
            ``na_values``, or, for a spreadsheet, of ``pandas.read_excel``.
        time: column of the time; None: there is none, or it means nothing.
        rate: Hz, to which rows are resampled where there is a time; otherwise their rate. A frame holds the
            largest reading of faster rows; slower ones are interpolated, except over a pause. None: the
            median rate of the rows.
        baseline: what is subtracted from readings: the mean of so many first rows of a file; its median,
            if it is ``idle`` most of the time; None: nothing.
        labels: name -> rule of a binary label.
        classes: exclusive classes; beside labels, ``task=classes`` chooses them.
        targets: x, y, force, force_x or force_y -> measured quantity.
        groups: columns such as a session or a person, or name -> columns that make it together; the touches
            of a group stay together in splits.
        positions: ``unknown``, ``layout`` for the one of the configuration, or a position per sensor, m.
        size: extent (x, y) of the sheet, m, unless of the configuration.
        footprint: extent (x, y) of a sensor, m, unless of the configuration.
    """

    files: str
    channels: ChannelColumns
    segments: SegmentRule
    about: str = ""
    fields: str | None = None
    table: Mapping[str, Any] = field(default_factory=dict)
    time: TimeColumn | None = None
    rate: Annotated[float, Gt(0)] | None = None
    baseline: Annotated[int, Ge(1)] | Literal["idle"] | None = None
    labels: Mapping[str, LabelRule] | None = None
    classes: ClassRule | None = None
    targets: Mapping[str, TargetColumn] | None = None
    groups: Sequence[Column] | Mapping[str, Sequence[Column]] = ()
    positions: Literal["unknown", "layout"] | Sequence[tuple[float, float] | tuple[float, float, float]] = (
        "unknown"
    )
    size: tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)]] | None = None
    footprint: tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)]] = (0.01, 0.01)


# Read a mapping.


_PARTS: dict[str, type] = {
    "time": TimeColumn,
    "channels": ChannelColumns,
    "segments": SegmentRule,
    "classes": ClassRule,
}
_NAMED: dict[str, type] = {"labels": LabelRule, "targets": TargetColumn}


def read_format(name: str) -> ForeignFormat:
    """Return a mapping.

    Args:
        name: path of a YAML file, or the name of a file in ``conf/mapping``.

    Raises:
        InputError: no such file, or invalid settings; the message names the file and the setting.
    """
    shipped = {path.stem: path for path in sorted((CONF / "mapping").glob("*.yaml"))}
    path = Path(name).expanduser() if name.endswith((".yaml", ".yml")) else shipped.get(name)
    if path is None:
        raise InputError(f"from={name} is no format: give map.yaml, or one of {', '.join(shipped)}")
    try:
        content = parse_yaml(read_file(path, TEXT).decode("utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the mapping {path}: {' '.join(str(error).split())}") from error
    mapping = _build(ForeignFormat, content, path.name)
    _check(mapping, path.name)
    return mapping


def _build(kind: Any, content: Any, name: str) -> Any:
    """Return a dataclass of settings with those that it holds."""
    check_settings(kind, content, name, whole=True)
    values = {key: value for key, value in content.items() if value is not None}
    for key, value in values.items():
        if key in _PARTS:
            values[key] = _build(_PARTS[key], value, f"{name}: {key}")
        elif key in _NAMED and not isinstance(value, dict):
            raise InputError(f"{name}: {key} must be settings by name, got {value!r}")
        elif key in _NAMED:
            values[key] = {
                str(part): _build(_NAMED[key], its, f"{name}: {key}.{part}") for part, its in value.items()
            }
    return kind(**values)


def _check(mapping: ForeignFormat, name: str) -> None:
    """Refuse settings that contradict each other."""
    channels, targets = mapping.channels, mapping.targets or {}
    if channels.unit not in FORCES and channels.scale is None:
        raise InputError(
            f"{name}: channels.unit={channels.unit} is no force ({', '.join(FORCES)}): add channels.scale, N "
            "per unit; a nominal one, such as 1, makes readings nominal"
        )
    if mapping.segments.by == "contact" and mapping.segments.threshold is None:
        raise InputError(f"{name}: segments.by: contact needs segments.threshold, N")
    if mapping.time is None and mapping.rate is None and mapping.segments.by != "row":
        raise InputError(f"{name}: add time, as in time: {{column: 1, unit: s}}, or rate, Hz")
    for target, column in targets.items():
        if target not in TARGETS or column.unit not in TARGETS[target]:
            units = ", ".join(TARGETS.get(target, ())) or f"none, there are {', '.join(TARGETS)}"
            raise InputError(f"{name}: targets.{target} with unit {column.unit}: its units are {units}")
    for label, rule in (mapping.labels or {}).items():
        by_column = rule.column is not None and rule.values is not None
        if by_column == (rule.target in targets and rule.above is not None):
            raise InputError(
                f"{name}: labels.{label} needs column and values, as in {{column: label, values: {{press: 1, "
                "tap: 0}}, or target and above, as in {target: force, above: 4.0}, N"
            )
        if any(isinstance(key, bool) or value not in (0, 1) for key, value in (rule.values or {}).items()):
            raise InputError(
                f"{name}: labels.{label}.values must be 0 or 1 by text, got {rule.values}: quote what YAML "
                "reads as true or false, as in {'on': 1, 'off': 0}"
            )
    try:
        re.compile(mapping.fields or "")
    except re.error as error:
        raise InputError(f"{name}: fields is no regular expression: {error}") from error


# Read the tables of a mapping.


def read_table(mapping: ForeignFormat, path: Path, folder: Path) -> pd.DataFrame:
    """Return the rows of a file with its time and the fields of its path."""
    table = _read(path, mapping.table)
    if mapping.time is not None:
        table[TIME] = _times(table, mapping.time, path)
    if mapping.fields is None:
        return table
    text = path.relative_to(folder).as_posix() if folder.is_dir() else path.as_posix()
    match = re.search(mapping.fields, text)
    if match is None:
        raise InputError(f"{text} does not fit the regular expression fields: {mapping.fields}")
    return table.assign(**{name: value for name, value in match.groupdict().items() if value is not None})


def _read(path: Path, options: Mapping[str, Any]) -> pd.DataFrame:
    """Return a file's rows, with texts as names of columns."""
    try:
        if path.suffix.lower() in (".xlsx", ".xlsm", ".xls", ".ods"):
            table = pd.read_excel(path, **options)
        else:
            usual = {"encoding": "utf-8-sig", "skipinitialspace": True} | (
                {"low_memory": False}
                if {"engine", "skipfooter"}.isdisjoint(options) and len(options.get("sep", ",") or "any") == 1
                else {"engine": "python"}  # the other parser knows neither patterns nor a footer
            )
            table = pd.read_csv(path, **usual | dict(options))
    except ImportError as error:
        raise InputError(f"{path}: spreadsheets need openpyxl: pip install 'tactile-skin[data]'") from error
    except (OSError, ValueError, TypeError, LookupError, AttributeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"cannot read {path}: {' '.join(str(error).split())}; table has options of pandas, such as "
            "skiprows, the lines above it, sep: '\\s+' for blanks, or header: null, with columns from 0"
        ) from error
    table.columns = pd.Index([str(name).strip() for name in table.columns])
    if table.columns.has_duplicates:
        raise InputError(f"{path}: several columns are called {table.columns[table.columns.duplicated()][0]}")
    if table.empty:
        raise InputError(f"{path} has no rows")
    return table


def _times(table: pd.DataFrame, its: TimeColumn, path: Path) -> np.ndarray:
    """Return the time of each row, (R,), s."""
    require_columns(table, [its.column], path, "time")
    column = table[str(its.column)]
    if pd.api.types.is_datetime64_any_dtype(column):
        times = (column - column.iloc[0]).dt.total_seconds().to_numpy()
    else:
        times = parse_numbers(table, its.column, path, "time") * TIMES[its.unit]
    if (back := np.flatnonzero(~(np.diff(times) >= 0))).size:
        raise InputError(
            f"{path}: time goes backwards at row {back[0] + 2}, from {times[back[0]]:.6f} to "
            f"{times[back[0] + 1]:.6f} s: split the file there, or correct time.column"
        )
    return times


def require_columns(
    table: pd.DataFrame, names: Sequence[Column], path: Path, what: str, few: int = 12
) -> None:
    """Raise InputError where a table lacks a column; ``what`` is the setting that names it."""
    if missing := [str(name) for name in names if str(name) not in table.columns]:
        columns = [name for name in table.columns if name != TIME]
        shown = ", ".join(columns[:few]) + (f" ... {columns[-1]}" if len(columns) > few else "")
        raise InputError(f"{path} has no column {missing[0]}, which {what} names: it has {shown}")


def parse_numbers(table: pd.DataFrame, name: Column, path: Path, what: str) -> np.ndarray:
    """Return a column that the setting ``what`` names as numbers, (R,), float64, NaN where there is none.

    Raises:
        InputError: there is no such column, or a cell has a text.
    """
    require_columns(table, [name], path, what)
    column = table[str(name)]
    values = pd.to_numeric(column, errors="coerce")
    if (wrong := np.flatnonzero((values.isna() & column.notna()) | (values.abs() == np.inf))).size:
        text = str(column.iloc[wrong[0]])[:40]
        raise InputError(
            f"{path}: column {name} has {text!r} in row {wrong[0] + 1}, no number: list it in "
            "table.na_values unless it stands for a value over the range, or correct table.decimal, "
            "table.skiprows or, for dates, table.parse_dates and date_format"
        )
    return values.to_numpy(dtype=float, na_value=np.nan)
