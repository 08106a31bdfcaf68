"""Formats of foreign recordings: a mapping file that says what tables hold, and the tables themselves.

A mapping is YAML with the settings of :class:`ForeignFormat`. Columns are named by the header or, without
one, numbered from 1; the named groups of the regular expression ``fields`` become columns, too.
"""

import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
Place = tuple[float, float] | tuple[float, float, float]

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_G = 9.80665  # m/s^2, standard gravity
FORCES = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "g": 1e-3 * _G,
    "gf": 1e-3 * _G,
    "kg": _G,
    "kgf": _G,
    "lbf": 4.4482216,
}
TARGETS = {"x": LENGTHS, "y": LENGTHS, "force": FORCES, "force_x": FORCES, "force_y": FORCES}
"""What a touch can be measured by -> its units."""
_SPREADSHEETS = (".xlsx", ".xlsm", ".xls", ".ods")


@dataclass(frozen=True)
class TableFormat:
    """How a file is written: text with a delimiter, or a spreadsheet.

    Attributes:
        delimiter: between columns; ``whitespace`` takes any number of blanks and tabs.
        header: whether the first line names the columns.
        names: of the columns, instead of a header.
        encoding: of the text.
        decimal: sign before the decimals.
        comment: sign that begins a comment.
        sheet: name or number, from 0, of a spreadsheet's sheet.
        missing: text or numbers that stand for no value, besides empty, ``nan`` and the like.
        lines: lines that make a frame, as the rows of a mat do; their columns are numbered on.
    """

    delimiter: str = ","
    header: bool = True
    names: Sequence[str] = ()
    encoding: str = "utf-8-sig"
    decimal: str = "."
    comment: str | None = None
    sheet: int | str = 0
    missing: Sequence[str | float] = ()
    lines: Annotated[int, Ge(1)] = 1


@dataclass(frozen=True)
class JoinedFile:
    """A second file for each file.

    Attributes:
        file: its path from the folder of the first; ``{name}`` stands for a field of the first one's path.
        by: ``row``, as many rows in the same order, or ``time``, the row nearest in time.
        clock: its column of time, in the unit of the first one's.
        tolerance: s, largest distance of rows that belong together; farther ones have no values.
        table: how it is written. Columns that the first file has, too, need other ``names``.
    """

    file: str
    by: Literal["row", "time"] = "row"
    clock: Column | None = None
    tolerance: Annotated[float, Gt(0)] = 0.01
    table: TableFormat = TableFormat()


@dataclass(frozen=True)
class TimeColumn:
    """Column of the time and its unit: s, ms, us or min."""

    column: Column
    unit: Literal["s", "ms", "us", "min"]


@dataclass(frozen=True)
class ChannelColumns:
    """The readings.

    Attributes:
        columns: in the order of the sensors; or a pattern such as ``ch*``.
        unit: a force (N, mN, kN, g, gf, kg, kgf, lbf), or any other with ``scale``.
        scale: N per unit, one or one per column. A nominal one makes readings nominal.
        per_sensor: 3 where x, y and z of a sensor follow each other.
        combine: of three channels: ``plain`` (three readings at one place), ``normal`` (the third) or
            ``magnitude``.
        frames: number of frames that a row holds.
        order: where a row holds several frames, whether all columns of a ``frame`` or of a ``sensor`` follow
            each other.
    """

    columns: Annotated[Sequence[Column], MinLen(1)] | str
    unit: str
    scale: float | Sequence[float] | None = None
    per_sensor: Literal[1, 3] = 1
    combine: Literal["plain", "normal", "magnitude"] = "plain"
    frames: Annotated[int, Ge(1)] = 1
    order: Literal["frame", "sensor"] = "frame"


@dataclass(frozen=True)
class BaselineRule:
    """What is subtracted from the readings.

    Attributes:
        kind: ``none``; the mean of the ``first`` rows of a file; its median, where it is ``idle`` most of the
            time; or the mean of the first rows of each ``segment``.
        rows: number of first rows.
    """

    kind: Literal["none", "first", "idle", "segment"] = "none"
    rows: Annotated[int, Ge(1)] = 20


@dataclass(frozen=True)
class SegmentRule:
    """What a touch is.

    Attributes:
        by: ``row``, ``file``, ``columns`` (rows with the same values), ``windows`` or ``contact``.
        frames: frames of each touch.
        before: idle frames before a row, or frames before a contact.
        fit: of a file or rows that are shorter or longer: ``pad`` with idle frames and cut, or ``stretch``
            over all frames, which loses the duration.
        columns: whose change begins a touch.
        counter: column whose fall begins a touch, such as a frame number.
        step: frames from one window to the next; None: ``frames``.
        threshold: N, of a contact: above it any reading is, up or down.
        gap: frames below the threshold that do not end a contact.
    """

    by: Literal["row", "file", "columns", "windows", "contact"]
    frames: Annotated[int, Ge(1)] = 30
    before: Annotated[int, Ge(0)] = 2
    fit: Literal["pad", "stretch"] = "pad"
    columns: Sequence[Column] = ()
    counter: Column | None = None
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
    values: dict[str | int | bool, int] | None = None
    target: str | None = None
    above: float | None = None


@dataclass(frozen=True)
class ClassRule:
    """Exclusive classes by the values of columns; ``names`` maps them to names, and others are unknown."""

    column: Column | Sequence[Column]
    names: dict[str | int, str] | None = None


@dataclass(frozen=True)
class TargetColumn:
    """A measured quantity of each touch.

    Attributes:
        column: of the file.
        unit: of lengths m, cm, mm, um or in; of forces as in :class:`ChannelColumns`.
        missing: value that stands for none.
        offset: value that stands for 0, in the unit.
    """

    column: Column
    unit: str
    missing: float | None = None
    offset: float = 0.0


@dataclass(frozen=True)
class ForeignFormat:
    """A mapping from foreign files to a recording.

    Attributes:
        files: pattern of paths below the folder, such as ``*/*.csv``.
        channels: the readings.
        segments: what a touch is.
        about: origin and licence, in words.
        fields: regular expression that the path of each file contains; its named groups become columns.
        table: how files are written.
        join: a second file; None: there is none.
        time: column of the time; None: there is none, or it means nothing.
        rate: Hz, to which rows are resampled where there is a time; otherwise their rate. None: the median
            rate of the rows.
        baseline: what is subtracted.
        labels: name -> rule of a binary label.
        classes: exclusive classes; beside labels, ``task=classes`` chooses them.
        targets: x, y, force, force_x or force_y -> measured quantity.
        groups: columns such as a session or a person, or name -> columns that make it together; the touches
            of a group stay together in splits.
        positions: ``unknown``, ``layout`` for that of the configuration, or a place per sensor, m.
        size: extent (x, y) of the sheet, m, unless of the configuration.
        footprint: extent (x, y) of a sensor, m, unless of the configuration.
    """

    files: str
    channels: ChannelColumns
    segments: SegmentRule
    about: str = ""
    fields: str | None = None
    table: TableFormat = TableFormat()
    join: JoinedFile | None = None
    time: TimeColumn | None = None
    rate: Annotated[float, Gt(0)] | None = None
    baseline: BaselineRule = BaselineRule()
    labels: Mapping[str, LabelRule] | None = None
    classes: ClassRule | None = None
    targets: Mapping[str, TargetColumn] | None = None
    groups: Sequence[Column] | Mapping[str, Sequence[Column]] = ()
    positions: Literal["unknown", "layout"] | Sequence[Place] = "unknown"
    size: tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)]] | None = None
    footprint: tuple[Annotated[float, Gt(0)], Annotated[float, Gt(0)]] = (0.01, 0.01)

    @property
    def grouping(self) -> dict[str, Sequence[Column]]:
        """The columns of each group by its name."""
        if isinstance(self.groups, Mapping):
            return {str(name): columns for name, columns in self.groups.items()}
        return {str(name): (name,) for name in self.groups}


# Read a mapping.


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
        content = parse_yaml(read_file(path, TEXT).decode("utf-8"))
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


_PARTS: dict[str, type] = {
    "table": TableFormat,
    "join": JoinedFile,
    "time": TimeColumn,
    "channels": ChannelColumns,
    "baseline": BaselineRule,
    "segments": SegmentRule,
    "classes": ClassRule,
}
_NAMED: dict[str, type] = {"labels": LabelRule, "targets": TargetColumn}


def _check(mapping: ForeignFormat, name: str) -> None:
    """Refuse settings that contradict each other."""
    channels, segments = mapping.channels, mapping.segments
    count = len(channels.columns) if not isinstance(channels.columns, str) else None
    if channels.unit not in FORCES and channels.scale is None:
        raise InputError(
            f"{name}: channels.unit={channels.unit} is no force ({', '.join(FORCES)}): add channels.scale, N "
            "per unit; a nominal one, such as 1, makes readings nominal"
        )
    if isinstance(channels.scale, Sequence) and count is not None and len(channels.scale) != count:
        raise InputError(f"{name}: channels.scale has {len(channels.scale)} numbers for {count} columns")
    if count is not None and count % (channels.per_sensor * channels.frames):
        raise InputError(
            f"{name}: {count} columns of channels are not {channels.frames} frames of sensors with "
            f"{channels.per_sensor} channels each"
        )
    if channels.combine != "plain" and channels.per_sensor == 1:
        raise InputError(f"{name}: channels.combine={channels.combine} needs channels.per_sensor: 3")
    if channels.frames > 1 and segments.by != "row":
        raise InputError(f"{name}: rows of {channels.frames} frames need segments.by: row")
    if segments.by == "contact" and segments.threshold is None:
        raise InputError(f"{name}: segments.by: contact needs segments.threshold, N")
    if segments.by == "columns" and not segments.columns and segments.counter is None:
        raise InputError(f"{name}: segments.by: columns needs segments.columns or segments.counter")
    if mapping.time is None and mapping.rate is None and (segments.by != "row" or channels.frames > 1):
        raise InputError(f"{name}: add time, as in time: {{column: 1, unit: s}}, or rate, Hz")
    if mapping.join is not None and mapping.join.by == "time" and None in (mapping.join.clock, mapping.time):
        raise InputError(f"{name}: join.by: time needs join.clock and time, the columns of both times")
    if mapping.table.lines > 1 and mapping.table.header:
        raise InputError(f"{name}: table.lines={mapping.table.lines} needs table.header: false")
    _check_labels(mapping, name)


def _check_labels(mapping: ForeignFormat, name: str) -> None:
    targets = mapping.targets or {}
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
        if rule.values is not None and not set(rule.values.values()) <= {0, 1}:
            raise InputError(
                f"{name}: labels.{label}.values must be 0 or 1, got {list(rule.values.values())}"
            )
    if mapping.fields is not None:
        try:
            re.compile(mapping.fields)
        except re.error as error:
            raise InputError(f"{name}: fields is no regular expression: {error}") from error


# Read the tables of a mapping.


def find_files(mapping: ForeignFormat, folder: Path) -> list[Path]:
    """Return the files of a mapping, in the order of their paths.

    Args:
        mapping: whose pattern they match.
        folder: where; or a file.

    Raises:
        InputError: there is none.
    """
    if folder.is_file():
        return [folder]
    paths = sorted(path for path in folder.glob(mapping.files) if path.is_file())
    if not paths:
        raise InputError(
            f"{folder} has no file {mapping.files}: give the folder of the recordings, path=FOLDER"
        )
    return paths


def read_table(mapping: ForeignFormat, path: Path, folder: Path) -> pd.DataFrame:
    """Return the rows of a file with the fields of its path and the columns of its second file.

    Args:
        mapping: says how it is written.
        path: of the file.
        folder: from which ``fields`` sees the path.

    Raises:
        InputError: a file cannot be read, or lacks a column, or rows or times disagree.
    """
    table, named = _read(path, mapping.table), _fields(mapping, path, folder)
    if mapping.time is not None:
        require_columns(table, [mapping.time.column], path, "time")
        times = parse_numbers(table, mapping.time.column, path) * TIMES[mapping.time.unit]
        if (back := np.flatnonzero(~(np.diff(times) >= 0))).size:
            raise InputError(
                f"{path}: time goes backwards at row {back[0] + 2}, from {times[back[0]]:.6f} to "
                f"{times[back[0] + 1]:.6f} s: split the file there, or correct time.column"
            )
        table[TIME] = times
    if mapping.join is not None:
        table = _join(mapping, table, path, named)
    return table.assign(**named)


TIME = " time"
"""Column of the time, s; no header has a name that begins with a blank."""


def _read(path: Path, its: TableFormat) -> pd.DataFrame:
    """Return a file's rows, with texts as names of columns."""
    settings: dict[str, Any] = {"header": 0 if its.header else None, "na_values": list(its.missing)}
    try:
        if path.suffix.lower() in _SPREADSHEETS:
            table = pd.read_excel(path, sheet_name=its.sheet, **settings)
        else:
            delimiter = r"\s+" if its.delimiter == "whitespace" else its.delimiter
            text = {"encoding": its.encoding, "decimal": its.decimal, "comment": its.comment}
            table = pd.read_csv(
                path, sep=delimiter, skipinitialspace=True, low_memory=False, **text, **settings
            )
    except ImportError as error:
        raise InputError(f"{path}: spreadsheets need openpyxl: pip install 'tactile-skin[data]'") from error
    except (
        OSError,
        ValueError,
        LookupError,
        zipfile.BadZipFile,
    ) as error:  # of pandas, openpyxl and encodings
        raise InputError(f"cannot read {path}: {' '.join(str(error).split())}") from error
    if its.lines > 1:
        if len(table) % its.lines:
            raise InputError(f"{path} has {len(table)} rows, not a multiple of table.lines={its.lines}")
        table = pd.DataFrame(table.to_numpy().reshape(len(table) // its.lines, -1))
    if its.names and len(its.names) != table.shape[1]:
        raise InputError(f"{path} has {table.shape[1]} columns, names are {len(its.names)}")
    names = its.names or (table.columns if its.header else range(1, table.shape[1] + 1))
    table.columns = pd.Index([str(name).strip() for name in names])
    if table.columns.has_duplicates:
        raise InputError(f"{path}: several columns are called {table.columns[table.columns.duplicated()][0]}")
    if table.empty:
        raise InputError(f"{path} has no rows")
    return table


def _fields(mapping: ForeignFormat, path: Path, folder: Path) -> dict[str, str]:
    """Return the named groups of a file's path."""
    if mapping.fields is None:
        return {}
    text = path.relative_to(folder).as_posix() if folder.is_dir() else path.as_posix()
    match = re.search(mapping.fields, text)
    if match is None:
        raise InputError(f"{text} does not fit the regular expression fields: {mapping.fields}")
    return {name: value for name, value in match.groupdict().items() if value is not None}


def _join(mapping: ForeignFormat, table: pd.DataFrame, path: Path, named: Mapping[str, str]) -> pd.DataFrame:
    """Return the rows of a file with those of its second file."""
    join = mapping.join
    assert join is not None
    try:
        beside = path.parent / join.file.format(**named)
    except (LookupError, ValueError) as error:
        raise InputError(f"join.file={join.file}: fields gives {', '.join(named) or 'no names'}") from error
    second = _read(beside, join.table)
    if shared := [name for name in second.columns if name in table.columns]:
        raise InputError(f"{path.name} and {beside} both have a column {shared[0]}: give join.table.names")
    if join.by == "row":
        if len(second) != len(table):
            raise InputError(f"{path} has {len(table)} rows, {beside} has {len(second)}: join them by time")
        return pd.concat([table, second], axis=1)
    assert join.clock is not None
    assert mapping.time is not None
    require_columns(second, [join.clock], beside, "join.clock")
    second[TIME] = parse_numbers(second, join.clock, beside) * TIMES[mapping.time.unit]
    if not second[TIME].is_monotonic_increasing:
        raise InputError(f"{beside}: time goes backwards: correct join.clock")
    joined = pd.merge_asof(table, second, on=TIME, direction="nearest", tolerance=join.tolerance)
    if joined[str(join.clock)].isna().all():
        raise InputError(f"{beside} has no row within join.tolerance={join.tolerance:g} s of {path.name}")
    return joined


def require_columns(table: pd.DataFrame, names: Sequence[Column], path: Path, what: str) -> None:
    """Raise InputError where a table lacks a column; ``what`` is the setting that names it."""
    if missing := [str(name) for name in names if str(name) not in table.columns]:
        columns = [name for name in table.columns if name != TIME]
        named = ", ".join(columns[:_FEW]) + (f" ... {columns[-1]}" if len(columns) > _FEW else "")
        raise InputError(f"{path} has no column {missing[0]}, which {what} names: it has {named}")


_FEW = 12


def parse_numbers(table: pd.DataFrame, name: Column, path: Path) -> np.ndarray:
    """Return a column as numbers, (R,), float64, NaN where there is none.

    Raises:
        InputError: a cell has a text.
    """
    column = table[str(name)]
    values = pd.to_numeric(column, errors="coerce")
    if (wrong := np.flatnonzero(values.isna() & column.notna())).size:
        text = str(column.iloc[wrong[0]])[:40]
        raise InputError(
            f"{path}: column {name} has {text!r} in row {wrong[0] + 1}, no number: list it in table.missing, "
            "or correct table.decimal"
        )
    array = values.to_numpy(dtype=float, na_value=np.nan)
    return np.where(np.isfinite(array), array, np.nan)
