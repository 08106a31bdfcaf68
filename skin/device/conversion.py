"""Make a recording of foreign files, as a mapping of :mod:`skin.device.formats` says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from skin.body.base import Sensors, require_memory
from skin.device.formats import (
    FORCES,
    TARGETS,
    TIME,
    Column,
    ForeignFormat,
    LabelRule,
    find_files,
    parse_numbers,
    read_table,
    require_columns,
)
from skin.device.touches import CLASS, GROUP, Recording, Touches, one_hot
from skin.errors import InputError
from skin.touch.labels import TOUCH, Task

_NOMINAL_RATE = 10.0  # Hz, of presses without a time
_NOMINAL_PITCH = 0.01  # m, between sensors whose places nobody knows


@dataclass
class _Content:
    """The touches of files, one entry each."""

    readings: list[np.ndarray] = field(default_factory=list)
    labels: list[list[Any]] = field(default_factory=list)
    targets: list[list[float]] = field(default_factory=list)
    groups: list[list[str]] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)


def convert_files(
    mapping: ForeignFormat,
    folder: Path,
    sensors: Sensors | None = None,
    size: tuple[float, float] | None = None,
) -> Recording:
    """Return the recording of foreign files.

    Targets and groups are its parameters, (B,): ``x`` and ``y`` (m), ``force``, ``force_x`` and ``force_y``
    (N), NaN where unknown, and ``group_<name>``, a number of the list in the metadata ``groups``; beside
    labels also ``class``, a number of the list in the metadata ``classes``. Unknown labels are NaN.

    Args:
        mapping: says what the files hold.
        folder: of the files; or a file.
        sensors: of the configuration, for ``positions: layout``.
        size: of the configuration's sheet, m, for ``positions: layout``.

    Raises:
        InputError: a file, a column, a label or a group is not as the mapping says; one sentence.
    """
    content = _Content()
    for path in find_files(mapping, folder):
        _add(content, mapping, read_table(mapping, path, folder), path)
    if not content.readings:
        raise InputError(f"{folder} has no touch: lower segments.threshold, or segments.frames")
    readings = np.stack(content.readings)
    parameters, groups = _parameters(mapping, content)
    about = {"about": mapping.about, "positions": _positions_word(mapping), "groups": groups}
    task, labels = _labels(mapping, content.labels)
    if mapping.classes is not None:
        names, numbers = _classes(mapping, [row[-1] for row in content.labels])
        if mapping.labels:
            parameters[CLASS], about["classes"] = numbers, names
        else:
            task, labels = Task(tuple(names), "exclusive"), one_hot(numbers, len(names))
    placed, extent = _place(mapping, readings.shape[2], sensors, size)
    touches = Touches(
        torch.from_numpy(np.nan_to_num(readings)),
        torch.from_numpy(~np.isnan(readings)),
        torch.from_numpy(placed.positions).float(),
        labels,
        float(np.median(content.rates)),
    )
    return Recording(touches, task, extent, placed.footprint, parameters=parameters, metadata=about)


def _positions_word(mapping: ForeignFormat) -> str:
    return mapping.positions if isinstance(mapping.positions, str) else "stated"


def _add(content: _Content, mapping: ForeignFormat, table: pd.DataFrame, path: Path) -> None:
    """Add the touches of a file."""
    values = _readings(mapping, table, path)
    rate, grid = _rate(mapping, table, path)
    if grid is not None:
        times = table[TIME].to_numpy()
        values = np.stack([np.interp(grid, times, column) for column in values.T], axis=1).astype(np.float32)
        after = np.searchsorted(times, grid).clip(1, len(times) - 1)
        table = table.iloc[np.where(grid - times[after - 1] < times[after] - grid, after - 1, after)]
    if mapping.baseline.kind == "idle":
        values = values - np.nanmedian(values, axis=0)
    elif mapping.baseline.kind == "first":
        values = values - _mean(values[: mapping.baseline.rows])
    targets = [_target(mapping, name, table, path) for name in mapping.targets or ()]
    sources = [_source(rule, table, path, name) for name, rule in _rules(mapping).items()]
    groups = [_joined(columns, table, path, "groups") for columns in mapping.grouping.values()]
    for rows in _segments(mapping, table, values, path):
        content.readings.append(_frames(mapping, values[rows]))
        measured = [
            _reduce(name, column[rows]) for name, column in zip(mapping.targets or (), targets, strict=True)
        ]
        content.targets.append(measured)
        drawn = dict(zip(mapping.targets or (), measured, strict=True))
        content.labels.append(
            [
                _label(rule, drawn, source, rows, mapping, f"{path}: label {name}")
                for (name, rule), source in zip(_rules(mapping).items(), sources, strict=True)
            ]
        )
        content.groups.append([_single(column[rows], f"{path}: groups") for column in groups])
        stretch = (mapping.segments.frames - 1) / max(1, rows.stop - rows.start - 1)
        content.rates.append(rate * (stretch if mapping.segments.fit == "stretch" else 1))


def _readings(mapping: ForeignFormat, table: pd.DataFrame, path: Path) -> np.ndarray:
    """Return the readings of a file, (R, S), or (R, S times frames) where rows hold several, float32, N."""
    its = mapping.channels
    if isinstance(its.columns, str):
        names: Sequence[Column] = [name for name in table.columns if fnmatch(name, its.columns)]
        if not names:
            require_columns(table, [its.columns], path, "channels.columns")
    else:
        names = its.columns
        require_columns(table, names, path, "channels.columns")
    require_memory(
        8.0 * len(table) * len(names), f"{path}, {len(table)} rows,", "convert fewer files at a time"
    )
    factor = np.asarray(its.scale if its.scale is not None else FORCES[its.unit], dtype=float)
    if factor.ndim and len(factor) != len(names):
        raise InputError(f"channels.scale has {len(factor)} numbers, {path} has {len(names)} channels")
    values = np.empty((len(table), len(names)), dtype=np.float32)
    for number, (name, scale) in enumerate(zip(names, np.broadcast_to(factor, len(names)), strict=True)):
        values[:, number] = scale * parse_numbers(table, name, path)
    if len(names) % (its.per_sensor * its.frames):
        raise InputError(
            f"{path} has {len(names)} channels, not {its.frames} frames of sensors with {its.per_sensor} each"
        )
    if its.combine != "plain":
        axes = values.reshape(len(values), -1, 3)
        values = axes[..., 2] if its.combine == "normal" else np.linalg.norm(axes, axis=2)
    return values


def _rate(mapping: ForeignFormat, table: pd.DataFrame, path: Path) -> tuple[float, np.ndarray | None]:
    """Return the rate of frames, Hz, and the times to which rows are resampled, s, or None."""
    if mapping.time is None or (mapping.segments.by == "row" and mapping.channels.frames > 1):
        return mapping.rate or _NOMINAL_RATE, None
    times = table[TIME].to_numpy()
    if mapping.segments.by == "row":
        return mapping.rate or _NOMINAL_RATE, None
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if not step > 0:
        raise InputError(
            f"{path}: its times do not differ: correct time.column, or give rate, Hz, instead of time"
        )
    if mapping.rate is None:
        return 1 / step, None
    return mapping.rate, np.arange(times[0], times[-1] + 0.5 / mapping.rate, 1 / mapping.rate)


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of rows, (S,); 0 where there is no value."""
    present = ~np.isnan(values)
    return np.where(present, values, 0).sum(axis=0) / present.sum(axis=0).clip(1)


# Segments.


def _segments(mapping: ForeignFormat, table: pd.DataFrame, values: np.ndarray, path: Path) -> list[slice]:
    """Return the rows of each touch."""
    its, count = mapping.segments, len(values)
    if its.by == "row":
        return [slice(row, row + 1) for row in range(count)]
    if its.by == "file":
        return [slice(0, count)]
    if its.by == "windows":
        return [
            slice(first, first + its.frames)
            for first in range(0, count - its.frames + 1, its.step or its.frames)
        ]
    if its.by == "contact":
        return _contacts(mapping, values)
    counter = () if its.counter is None else (its.counter,)
    require_columns(table, (*its.columns, *counter), path, "segments")
    begins = np.zeros(count, dtype=bool)
    begins[0] = True
    for name in its.columns:
        begins[1:] |= np.diff(pd.factorize(table[str(name)])[0]) != 0
    for name in counter:
        begins[1:] |= np.diff(parse_numbers(table, name, path)) <= 0
    edges = [*np.flatnonzero(begins), count]
    return [slice(first, last) for first, last in pairwise(edges)]


def _contacts(mapping: ForeignFormat, values: np.ndarray) -> list[slice]:
    """Return the rows of windows that begin shortly before a contact."""
    its = mapping.segments
    assert its.threshold is not None
    rows = np.flatnonzero((np.abs(np.nan_to_num(values)) > its.threshold).any(axis=1))
    if not len(rows):
        return []
    starts = rows[np.concatenate([[True], np.diff(rows) > its.gap + 1])]
    return [slice(max(0, row - its.before), max(0, row - its.before) + its.frames) for row in starts]


def _frames(mapping: ForeignFormat, values: np.ndarray) -> np.ndarray:
    """Return the frames of a touch, (T, S), from its rows."""
    its, channels = mapping.segments, mapping.channels
    if channels.frames > 1:
        shape = (channels.frames, -1) if channels.order == "frame" else (-1, channels.frames)
        values = values.reshape(shape)
        values = values if channels.order == "frame" else values.T
    if mapping.baseline.kind == "segment":
        values = values - _mean(values[: mapping.baseline.rows])
    if its.fit == "stretch" and its.by != "row":
        times = np.linspace(0, len(values) - 1, its.frames)
        before = np.minimum(times.astype(int), max(len(values) - 2, 0))
        share = (times - before)[:, None].astype(np.float32)
        return values[before] * (1 - share) + values[np.minimum(before + 1, len(values) - 1)] * share
    idle = its.before if its.by == "row" and channels.frames == 1 else 0
    frames = np.zeros((its.frames, values.shape[1]), dtype=np.float32)
    part = values[: its.frames - idle]
    frames[idle : idle + len(part)] = part
    return frames


# Targets, labels and groups.


def _texts(column: pd.Series) -> np.ndarray:
    """Return a column as texts, (R,), None where there is no value; whole numbers have no decimals."""
    codes, values = pd.factorize(column)  # -1 where there is no value
    texts = [f"{value:.12g}" if isinstance(value, float) else str(value).strip() for value in values]
    return np.array([*texts, None], dtype=object)[codes]


def _target(mapping: ForeignFormat, name: str, table: pd.DataFrame, path: Path) -> np.ndarray:
    """Return a measured quantity of each row, (R,), m or N, NaN where unknown."""
    its = (mapping.targets or {})[name]
    require_columns(table, [its.column], path, f"targets.{name}")
    values = parse_numbers(table, its.column, path)
    if its.missing is not None:
        values = np.where(values == its.missing, np.nan, values)
    return (values - its.offset) * TARGETS[name][its.unit]


def _reduce(name: str, values: np.ndarray) -> float:
    """Return the quantity of a touch: the mean place, the strongest force; NaN where unknown."""
    present = values[~np.isnan(values)]
    if not len(present):
        return np.nan
    return float(present[np.abs(present).argmax()] if name.startswith("force") else present.mean())


def _rules(mapping: ForeignFormat) -> Mapping[str, LabelRule]:
    """Return the rules of labels; that of classes is the last."""
    classes = {} if mapping.classes is None else {"classes": LabelRule(column=mapping.classes.column)}
    return {**(mapping.labels or {}), **classes}


def _source(rule: LabelRule, table: pd.DataFrame, path: Path, name: str) -> np.ndarray | None:
    """Return the texts of the column of a label, (R,)."""
    if rule.column is None:
        return None
    columns = (rule.column,) if isinstance(rule.column, str | int) else rule.column
    return _joined(columns, table, path, name if name == "classes" else f"labels.{name}")


def _label(
    rule: LabelRule,
    targets: Mapping[str, float],
    source: np.ndarray | None,
    rows: slice,
    mapping: ForeignFormat,
    where: str,
) -> Any:
    """Return 0, 1, or the text of a class; None where it is unknown."""
    if source is None:
        assert rule.target is not None
        assert rule.above is not None
        measured = targets[rule.target]
        strength = abs(measured) if rule.target.startswith("force") else measured
        return None if np.isnan(measured) else int(strength > rule.above)
    texts = [text for text in dict.fromkeys(source[rows]) if text is not None]
    values: list[Any] = [*texts]
    if rule.values is not None:
        values = [value for text in texts if (value := _lookup(rule.values, text)) is not None]
    if len(set(values)) < 2:
        return values[0] if values else None
    if mapping.segments.by in ("windows", "contact"):  # its label changes within it
        return None
    raise InputError(
        f"{where} contradicts itself in rows {rows.start + 1} to {rows.stop}, with "
        f"{' and '.join(texts[:3])}: correct the rows, or divide them by segments"
    )


def _lookup(values: Mapping[Any, int], text: str) -> int | None:
    return next((value for key, value in values.items() if str(key) == text), None)


def _joined(columns: Sequence[Column], table: pd.DataFrame, path: Path, what: str) -> np.ndarray:
    """Return the texts of columns, joined by a blank, of each row, (R,); None where one has no value."""
    require_columns(table, columns, path, what)
    texts = [_texts(table[str(name)]) for name in columns]
    if len(texts) == 1:
        return texts[0]
    rows = zip(*texts, strict=True)
    return np.array([None if None in row else " ".join(row) for row in rows], dtype=object)


def _single(texts: np.ndarray, where: str) -> str:
    """Return the group of a touch."""
    values = list(dict.fromkeys(texts))
    if len(values) == 1 and values[0] is not None:
        return values[0]
    raise InputError(f"{where}: each touch needs one group, got {' and '.join(map(str, values[:3]))} in one")


def _labels(mapping: ForeignFormat, rows: Sequence[Sequence[Any]]) -> tuple[Task, torch.Tensor | None]:
    """Return the task and the binary labels (B, L), NaN where unknown; None without any."""
    if not mapping.labels:
        return TOUCH, None
    columns = list(zip(*rows, strict=True))[: len(mapping.labels)]
    labels = torch.tensor([[np.nan if value is None else value for value in column] for column in columns])
    for name, column in zip(mapping.labels, labels, strict=True):
        if column.isnan().all():
            raise InputError(f"labels.{name} is unknown in all touches: correct its values, or leave it out")
    return Task(tuple(mapping.labels)), labels.T.float().contiguous()


def _classes(mapping: ForeignFormat, texts: Sequence[str | None]) -> tuple[list[str], torch.Tensor]:
    """Return the names of the classes, and the number of that of each touch, (B,), NaN where unknown."""
    its = mapping.classes
    assert its is not None
    names = {str(key): str(name) for key, name in its.names.items()} if its.names else {}
    assigned = [names.get(text) if names and text is not None else text for text in texts]
    order = list(names.values()) or sorted({text for text in assigned if text is not None})
    present = [name for name in order if name in assigned]
    if len(present) < 2:
        raise InputError(
            f"classes: column {its.column} has fewer than two of the classes {', '.join(order) or '-'}"
        )
    numbers = [np.nan if name is None else float(present.index(name)) for name in assigned]
    return present, torch.tensor(numbers, dtype=torch.float32)


def _parameters(
    mapping: ForeignFormat, content: _Content
) -> tuple[dict[str, torch.Tensor], dict[str, list[str]]]:
    """Return targets and groups as parameters, and the values of the groups."""
    parameters, groups = dict[str, torch.Tensor](), dict[str, list[str]]()
    for name, values in zip(mapping.targets or (), zip(*content.targets, strict=True), strict=True):
        parameters[name] = torch.tensor(values, dtype=torch.float32)
    for name, texts in zip(mapping.grouping, zip(*content.groups, strict=True), strict=True):
        groups[name] = sorted(set(texts))
        numbered = {text: number for number, text in enumerate(groups[name])}
        parameters[GROUP + name] = torch.tensor([numbered[text] for text in texts], dtype=torch.float32)
    return parameters, groups


def summarise_conversion(recording: Recording) -> str:
    """Return a line with the numbers of touches, readings, labels that are known, targets and groups."""
    batch, time, sensors = recording.touches.readings.shape
    parts = [f"{batch} touches of {time} frames at {recording.touches.rate:.4g} Hz, {sensors} readings"]
    labels = recording.touches.labels
    if labels is None:
        parts.append("no labels")
    else:
        shares = zip(recording.task.names, labels.T, strict=True)
        parts += [
            f"{name} in {int(column.nansum())} of {int((~column.isnan()).sum())}" for name, column in shares
        ]
    if "classes" in recording.metadata:
        parts.append(f"classes {', '.join(recording.metadata['classes'])}")
    for name, values in recording.parameters.items():
        if name != CLASS and not name.startswith(GROUP):
            parts.append(f"{name} of {int((~values.isnan()).sum())}")
    parts += [f"{len(values)} of {name}" for name, values in recording.metadata["groups"].items()]
    return ", ".join([*parts, f"positions {recording.metadata['positions']}"])


# Positions.


def _place(
    mapping: ForeignFormat, count: int, sensors: Sensors | None, size: tuple[float, float] | None
) -> tuple[Sensors, tuple[float, float]]:
    """Return the sensors of S readings, in a row where places are unknown, and the sheet's extent, m."""
    extent = size if mapping.size is None else (mapping.size[0], mapping.size[1])
    its = mapping.channels
    channels = its.per_sensor if its.combine == "plain" else 1
    if mapping.positions == "unknown":
        number = count // channels
        width, height = extent or (number * _NOMINAL_PITCH, _NOMINAL_PITCH)
        places = np.zeros((number, 3))
        places[:, 0] = width * (np.arange(number) + 0.5) / number
        places[:, 1] = 0.5 * height
    elif mapping.positions == "layout":
        if sensors is None:
            raise InputError("positions: layout needs a skin: give layout=file layout.path=FILE.csv")
        places = sensors.positions
    else:
        if extent is None:
            raise InputError("positions need size, the extent [x, y] of the sheet, m")
        places = np.array([[*place, 0.0][:3] for place in mapping.positions])
    if len(places) * channels != count:
        raise InputError(
            f"the files have {count} readings of {channels} per sensor, positions are {len(places)}: correct "
            "channels.columns, or positions"
        )
    footprint = (mapping.footprint[0], mapping.footprint[1]) if sensors is None else sensors.footprint
    extent = extent or (len(places) * _NOMINAL_PITCH, _NOMINAL_PITCH)
    return Sensors(np.repeat(places, channels, axis=0), footprint), extent
