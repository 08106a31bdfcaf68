"""Recordings of foreign files: touches cut from the tables of a mapping, or given by a Python function.

What is not a plain table is read by a function ``reader(path) -> Recording``, which may call
:func:`build_recording`, as :func:`eflesh` does; only the command line names it (``skin convert
reader=package.function``), never a file.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from pydantic import PositiveFloat

from skin.body.base import Sensors, require_memory
from skin.core.settings import check_settings, import_target
from skin.device.formats import (
    FORCES,
    TARGETS,
    TIME,
    TIMES,
    Column,
    ForeignFormat,
    LabelRule,
    parse_numbers,
    read_table,
    require_columns,
)
from skin.device.touches import CLASS, GROUP, Recording, Touches, one_hot
from skin.errors import InputError
from skin.touch.labels import TOUCH, Task

_Touch = dict[str, Any]  # frames (T, S), N, rate, Hz; targets, labels and groups by name, and kind, its class


def convert_files(
    mapping: ForeignFormat,
    folder: Path,
    sensors: Sensors | None = None,
    size: tuple[float, float] | None = None,
    differ: float = 1.1,
) -> Recording:
    """Return the recording of foreign files, as :func:`build_recording` does.

    Args:
        mapping: says what the files hold.
        folder: of the files; or a file.
        sensors: of the configuration, for ``positions: layout``.
        size: of the configuration's sheet, m, for ``positions: layout``.
        differ: largest ratio of the rates of files that are not resampled; clocks are not exact.

    Raises:
        InputError: a file, a column, a label or a group is not as the mapping says, or files without a
            common rate; one sentence.
    """
    paths = [folder] if folder.is_file() else sorted(p for p in folder.glob(mapping.files) if p.is_file())
    if not paths:
        raise InputError(
            f"{folder} has no file {mapping.files}: give the folder of the recordings, path=FOLDER"
        )
    touches = [touch for path in paths for touch in _read_touches(mapping, path, folder)]
    if not touches:
        raise InputError(f"{folder} has no touch: lower segments.threshold, or segments.frames")
    rates = [touch["rate"] for touch in touches]
    if max(rates) > differ * min(rates):
        raise InputError(
            f"{folder} has files of {min(rates):.3g} to {max(rates):.3g} Hz: give rate, Hz, to which all of "
            "them are resampled"
        )
    parts: dict[str, Any] = {
        part: {name: [touch[part][name] for touch in touches] for name in touches[0][part]}
        for part in ("targets", "labels", "groups")
    }
    return build_recording(
        np.stack([touch["frames"] for touch in touches]),
        float(np.median(rates)),
        **parts,
        kinds=[touch["kind"] for touch in touches] if mapping.classes else None,
        names=[*map(str, mapping.classes.names)] if mapping.classes and mapping.classes.names else None,
        about=mapping.about,
        positions=sensors if mapping.positions == "layout" else mapping.positions,
        size=size if mapping.size is None else mapping.size,
        footprint=mapping.footprint,
    )


def _read_touches(mapping: ForeignFormat, path: Path, folder: Path) -> list[_Touch]:
    """Return the touches of a file."""
    table = read_table(mapping, path, folder)
    labels, groups = mapping.labels or {}, mapping.groups
    named = groups if isinstance(groups, Mapping) else {str(name): (name,) for name in groups}
    sources = {
        **{f"labels.{name}": rule.column for name, rule in labels.items() if rule.column is not None},
        **({"classes": mapping.classes.column} if mapping.classes else {}),
        **{f"groups.{name}": columns for name, columns in named.items()},
    }
    texts = {what: _joined(columns, table, path, what) for what, columns in sources.items()}
    # A pattern of channels leaves out the columns of labels and groups.
    values = _readings(mapping, table, path, pd.Series([*sources.values()], dtype=object).explode())
    rate, step = _rate(mapping, table, path)
    spans = np.arange(len(table))[:, None] + [0, 1]
    if step is not None:
        values, spans = _resample(values, table[TIME].to_numpy(), rate, step)
    if mapping.baseline == "idle":
        values = values - np.nanmedian(values, axis=0)
    elif mapping.baseline is not None:
        first = values[: max(1, int((spans[:, 1] <= mapping.baseline).sum()))]  # frames of these rows
        values = values - np.nan_to_num(first).sum(axis=0) / (~np.isnan(first)).sum(axis=0).clip(1)
    targets = {
        name: TARGETS[name][its.unit] * parse_numbers(table, its.column, path, f"targets.{name}")
        for name, its in (mapping.targets or {}).items()
    }
    touches = []
    for rows in _segments(mapping, values):
        frames = np.zeros((mapping.segments.frames, values.shape[1]), dtype=np.float32)
        begin = mapping.segments.before if mapping.segments.by == "row" else 0
        part = values[rows][: len(frames) - begin]
        frames[begin : begin + len(part)] = part
        lines = slice(*spans[rows].ravel()[[0, -1]])  # rows of the file
        where = f"{path}: rows {lines.start + 1} to {lines.stop}"
        found = {what: [*dict.fromkeys(column[lines])] for what, column in texts.items()}
        for name in named:
            if len(one := found[f"groups.{name}"]) != 1 or one[0] is None:
                raise InputError(
                    f"{where}: groups: each touch needs one {name}, got {' and '.join(map(str, one[:3]))}"
                )
        shown = slice(lines.start, int(spans[rows][len(part) - 1, 1]))  # of a touch that is cut
        measured = {name: _reduce(name, column[shown]) for name, column in targets.items()}
        touches.append(
            {
                "frames": frames,
                "rate": rate,
                "targets": measured,
                "labels": {
                    name: _above(rule, measured)
                    if rule.values is None
                    else _single(found[f"labels.{name}"], mapping, f"{where}: label {name}", rule.values)
                    for name, rule in labels.items()
                },
                "groups": {name: found[f"groups.{name}"][0] for name in named},
                "kind": _single(found["classes"], mapping, f"{where}: classes") if mapping.classes else None,
            }
        )
    return touches


def _readings(
    mapping: ForeignFormat, table: pd.DataFrame, path: Path, others: Iterable[Column]
) -> np.ndarray:
    """Return the readings of a file, (R, S), float32, N; a pattern leaves out fields and other columns."""
    its, apart = mapping.channels, {*re.compile(mapping.fields or "").groupindex, *map(str, others)}
    names: Sequence[Column] = (
        [name for name in table.columns if fnmatch(name, its.columns) and name not in apart] or [its.columns]
        if isinstance(its.columns, str)
        else its.columns
    )
    require_memory(
        8.0 * len(table) * len(names), f"{path}, {len(table)} rows,", "convert fewer files at a time"
    )
    factor = np.asarray(its.scale if its.scale is not None else FORCES[its.unit], dtype=float)
    if factor.ndim and len(factor) != len(names):
        raise InputError(f"channels.scale has {len(factor)} numbers, {path} has {len(names)} channels")
    values = np.empty((len(table), len(names)), dtype=np.float32)
    for number, (name, scale) in enumerate(zip(names, np.broadcast_to(factor, len(names)), strict=True)):
        values[:, number] = scale * parse_numbers(table, name, path, "channels.columns")
        _check_missing(values[:, number], name, path)
    return values


def _check_missing(values: np.ndarray, name: Column, path: Path, peak: float = 0.5, pieces: int = 3) -> None:
    """Refuse readings (R,) that are missing where they are largest: presses over the range would vanish.

    Args:
        values: NaN where there is none.
        name: of their column.
        path: of the file.
        peak: fraction of the range that the readings around missing ones exceed, on average.
        pieces: least number of gaps; fewer may be chance.
    """
    size = np.abs(values - np.nanmedian(values)) if not np.isnan(values).all() else values
    gaps = np.flatnonzero(np.diff(np.isnan(values).astype(int)) == 1)
    usual = np.nanquantile(size, 0.9) if (largest := np.nanmax(size, initial=0.0)) else 0.0
    if len(gaps) >= pieces and np.mean(size[gaps]) > max(peak * largest, usual):
        raise InputError(
            f"{path}: column {name} has no value {len(gaps)} times right after its largest ones: is that a "
            "press over the range, which would vanish? Write the largest value in its place, or read the "
            "files by a function, reader=package.function"
        )


def _rate(
    mapping: ForeignFormat, table: pd.DataFrame, path: Path, slower: float = 20.0, faster: float = 2000.0
) -> tuple[float, float | None]:
    """Return the rate of frames, Hz, and the time between rows that are resampled, s; None: rows are frames.

    Rows that are ``slower`` or ``faster`` than ``rate`` by these factors have another unit of time.
    """
    rate = mapping.rate
    if mapping.time is None or mapping.segments.by == "row":
        return rate or 10.0, None  # nominal, of presses without a time
    times = table[TIME].to_numpy()
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if not step > 0:
        raise InputError(
            f"{path}: its times do not differ: correct time.column, or give rate, Hz, instead of time"
        )
    if rate is None:
        return 1 / step, None
    if not 1 / faster < step * rate < slower:
        factors = {unit: step * rate * TIMES[unit] / TIMES[mapping.time.unit] for unit in TIMES}
        unit = min(factors, key=lambda name: abs(np.log(factors[name])))
        raise InputError(
            f"{path}: its rows are {step:g} s apart ({1 / step:.3g} Hz), rate is {rate:g} Hz: is the time in "
            f"{unit}? Give time.unit: {unit}, or a rate near the one of the rows"
        )
    return rate, step


def _resample(
    values: np.ndarray, times: np.ndarray, rate: float, step: float, pause: tuple[float, float] = (5, 10)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings of frames (T, S), N, and the rows of each, from and to before, (T, 2).

    A frame of faster rows holds the largest reading of its interval, as on a device
    (:func:`skin.device.resampling.resample`), so that no short press is lost; missing ones do not count.
    Slower rows are interpolated; a frame without a row has the nearest one.

    Args:
        values: of rows, (R, S), N, NaN where there is none.
        times: (R,), s, rising.
        rate: of frames, Hz.
        step: between two rows, s.
        pause: frames and steps; where rows are further apart than both, frames between them have no value.
    """
    half = 0.5 * min(step, 1 / rate)  # edges of frames are between rows
    grid = np.arange(times[0], times[-1] + half, 1 / rate)
    begins = np.searchsorted(times[:-1], grid - half)  # the last frame has the last row at least
    some = np.diff(begins, append=len(times)) > 0
    frames = np.stack([np.interp(grid, times, column) for column in values.T], axis=1).astype(np.float32)
    frames[~some & (times[begins] - times[begins - 1] > max(pause[0] / rate, pause[1] * step))] = np.nan
    if step * rate < 1:
        frames[some] = np.fmax.reduceat(values, begins[some], axis=0)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, grid)
    rows = np.stack([begins, np.append(begins[1:], len(times))], axis=1)
    return frames, np.where(some[:, None], rows, nearest[:, None] + [0, 1])


def _segments(mapping: ForeignFormat, values: np.ndarray) -> list[slice]:
    """Return the rows of each touch."""
    its, count = mapping.segments, len(values)
    if its.by == "row":
        return [slice(row, row + 1) for row in range(count)]
    if its.by == "file":
        return [slice(0, count)]
    if its.by == "windows":
        begins = np.arange(0, count - its.frames + 1, its.step or its.frames)
    else:
        rows = np.flatnonzero((np.abs(np.nan_to_num(values)) > its.threshold).any(axis=1))
        first = np.diff(rows, prepend=-its.gap - 2) > its.gap + 1
        begins = np.maximum(0, rows[first] - its.before)
    # A window within a pause shows nothing.
    return [
        slice(begin, begin + its.frames)
        for begin in begins.tolist()
        if not np.isnan(values[begin : begin + its.frames]).all()
    ]


def _reduce(name: str, values: np.ndarray) -> float:
    """Return the quantity of a touch: the mean position, the strongest force; NaN where unknown."""
    present = values[~np.isnan(values)]
    meant = present[np.abs(present).argsort()[-1:]] if name.startswith("force") else present
    return float(meant.mean()) if len(meant) else np.nan


def _joined(columns: Column | Sequence[Column], table: pd.DataFrame, path: Path, what: str) -> np.ndarray:
    """Return the texts of columns, joined by a blank, of each row, (R,); None where one has no value."""
    names = [str(name) for name in ([columns] if isinstance(columns, str | int) else columns)]
    require_columns(table, names, path, what)
    words = [table[name].map(_text, na_action="ignore").astype("string") for name in names]
    joined = words[0].str.cat(words[1:], sep=" ").astype(object)
    return joined.where(joined.notna(), None).to_numpy()


def _text(value: Any) -> str:
    """Return a value as text; whole numbers have no decimals."""
    return f"{value:.12g}" if isinstance(value, float) else str(value).strip()


def _single(
    texts: Sequence[str | None], mapping: ForeignFormat, where: str, values: Mapping[Any, Any] | None = None
) -> Any:
    """Return the text of a touch, or its value among ``values``; None where it is unknown."""
    known = [text for text in texts if text is not None]
    named = None if values is None else {str(key): value for key, value in values.items()}
    found = {text if named is None else named.get(text) for text in known} - {None}
    if len(found) < 2:
        return next(iter(found), None)
    if mapping.segments.by in ("windows", "contact"):  # its label changes within it
        return None
    raise InputError(
        f"{where} contradicts itself, with {' and '.join(known[:3])}: correct the rows, or divide them by "
        "segments"
    )


def _above(rule: LabelRule, targets: Mapping[str, float]) -> int | None:
    """Return whether a target is above the limit of a label, 0 or 1; None where it is unknown."""
    measured = targets[str(rule.target)]
    strength = abs(measured) if str(rule.target).startswith("force") else measured
    return None if np.isnan(measured) else int(strength > (rule.above or 0.0))


# Build a recording.


Positions = Sensors | Sequence[Sequence[float]] | str | None
"""Sensors of a configuration, a position (x, y) or (x, y, depth) of each sensor, m, or ``unknown``."""


def build_recording(
    readings: np.ndarray,
    rate: float,
    *,
    targets: Mapping[str, Sequence[float]] | None = None,
    labels: Mapping[str, Sequence[int | None]] | None = None,
    groups: Mapping[str, Sequence[str]] | None = None,
    kinds: Sequence[str | None] | None = None,
    names: Sequence[str] | None = None,
    about: str = "",
    positions: Positions = "unknown",
    per_sensor: int = 1,
    size: Sequence[float] | None = None,
    footprint: Sequence[float] = (0.01, 0.01),
) -> Recording:
    """Return the recording of touches of another program.

    Targets and groups are its parameters, (B,): ``x`` and ``y`` (m), ``force``, ``force_x`` and ``force_y``
    (N), NaN where unknown, and ``group_<name>``, a number of the list in the metadata ``groups``; beside
    labels also ``class``, a number of the list in the metadata ``classes``.

    Args:
        readings: (B, T, S), N, NaN where there is none.
        rate: of the frames, Hz.
        targets, labels, groups: by name, of each touch: a quantity; 0, 1 or None; the group.
        kinds: exclusive class of each touch; None: unknown.
        names: of the classes, in their order; None: alphabetically.
        about: origin and licence.
        positions: of the sensors; unknown ones are in a row.
        per_sensor: readings per sensor.
        size, footprint: extent (x, y) of the sheet and of a sensor, m; footprints of Sensors are their own.

    Raises:
        InputError: labels without a value, fewer than two classes, or positions of another number of sensors.
    """
    parameters = {name: torch.tensor(values, dtype=torch.float32) for name, values in (targets or {}).items()}
    lists = {name: sorted(set(values)) for name, values in (groups or {}).items()}
    for name, values in (groups or {}).items():
        parameters[GROUP + name] = torch.tensor([float(lists[name].index(text)) for text in values])
    placed: dict[str, Any] = {"positions": positions if isinstance(positions, str) else "stated"}
    if isinstance(positions, Sensors):
        placed = {"positions": "layout", "directions": positions.normals.tolist()}
    metadata = {"about": about, **placed, "groups": lists}
    task, known = _binary(labels) if labels else (TOUCH, None)
    if kinds is not None:
        present, numbers_of_kinds = _number(kinds, names)
        if labels:
            parameters[CLASS], metadata["classes"] = numbers_of_kinds, present
        else:
            task, known = Task(tuple(present), "exclusive"), one_hot(numbers_of_kinds, len(present))
    sensors, extent = _position(positions, readings.shape[2] // per_sensor, size, footprint)
    touches = Touches(
        torch.from_numpy(np.nan_to_num(readings)),
        torch.from_numpy(~np.isnan(readings)),
        torch.from_numpy(np.repeat(sensors.positions, per_sensor, axis=0)).float(),
        known,
        rate,
    )
    return Recording(touches, task, extent, sensors.footprint, parameters=parameters, metadata=metadata)


def _binary(labels: Mapping[str, Sequence[int | None]]) -> tuple[Task, torch.Tensor]:
    """Return the task and the labels (B, L), NaN where unknown."""
    columns = [[np.nan if value is None else value for value in column] for column in labels.values()]
    known = torch.tensor(columns).float()
    for name, column in zip(labels, known, strict=True):
        if column.isnan().all():
            raise InputError(f"labels.{name} is unknown in all touches: correct its values, or leave it out")
    return Task(tuple(labels)), known.T.contiguous()


def _number(kinds: Sequence[str | None], names: Sequence[str] | None) -> tuple[list[str], torch.Tensor]:
    """Return the classes that occur, and the number of the class of each touch, (B,), NaN where unknown."""
    order = list(names or sorted({kind for kind in kinds if kind is not None}))
    present = [name for name in order if name in kinds]
    if len(present) < 2:
        raise InputError(f"the touches have fewer than two of the classes {', '.join(order) or '-'}")
    numbers = [float(present.index(kind)) if kind in present else np.nan for kind in kinds]
    return present, torch.tensor(numbers, dtype=torch.float32)


def _position(
    positions: Positions,
    count: int,
    size: Sequence[float] | None,
    footprint: Sequence[float],
    pitch: float = 0.01,
) -> tuple[Sensors, tuple[float, float]]:
    """Return S sensors, in a row where positions are unknown, and the sheet's extent, m.

    Args:
        positions, size, footprint: as in :func:`build_recording`.
        count: S.
        pitch: between sensors of unknown positions, m.
    """
    width, height = size or (count * pitch, pitch)
    if isinstance(positions, Sensors):
        sensors = positions
    elif positions == "unknown":
        middles = width * (np.arange(count) + 0.5) / count
        row = np.column_stack([middles, np.full(count, 0.5 * height), np.zeros(count)])
        sensors = Sensors(row, (footprint[0], footprint[1]))
    elif positions is None:
        raise InputError("positions: layout needs a skin: give layout=file layout.path=FILE.csv")
    elif size is None:
        raise InputError("positions need size, the extent [x, y] of the sheet, m")
    else:
        sensors = Sensors(
            np.array([[*point, 0.0][:3] for point in positions], dtype=float), (footprint[0], footprint[1])
        )
    if len(sensors) != count:
        raise InputError(
            f"the files have readings of {count} sensors, positions are {len(sensors)}: correct "
            "channels.columns, or positions"
        )
    return sensors, (width, height)


def read_by_function(reader: str, path: Path, options: Mapping[str, Any], *skin: Any) -> Recording:
    """Return the recording that a function makes of files.

    Args:
        reader: its name, ``package.function``, given by the person at the command line.
        path: of the files.
        options: further arguments.
        skin: sensors, and extent of the skin, m, where the configuration gives them.

    Raises:
        InputError: no such function, options that it does not take, or another result than a recording.
    """
    function = import_target(reader, "reader")
    check_settings(function, options, "options")
    recording = function(path, *skin, **options)
    if not isinstance(recording, Recording):
        raise InputError(f"reader={reader} must return a Recording, got {type(recording).__name__}")
    return recording


def summarise_conversion(recording: Recording) -> str:
    """Return a line with the numbers of touches, readings, labels that are known, parameters and groups."""
    touches, metadata = recording.touches, recording.metadata
    (batch, time, sensors), labels = touches.readings.shape, touches.labels
    parts = (
        ["no labels"]
        if labels is None
        else [
            f"{name} in {int(column.nansum())} of {int((~column.isnan()).sum())}"
            for name, column in zip(recording.task.names, labels.T, strict=True)
        ]
    )
    parts += [f"classes {', '.join(metadata['classes'])}"] if "classes" in metadata else []
    names = [name for name in recording.parameters if name != CLASS and not name.startswith(GROUP)]
    parts += [f"{len(names)} parameters, as {', '.join(names[:3])}"] if names else []
    parts += [f"{len(values)} of {name}" for name, values in metadata.get("groups", {}).items()]
    return ", ".join(
        [
            f"{batch} touches of {time} frames at {touches.rate:.4g} Hz, {sensors} readings",
            *parts,
            f"positions {metadata.get('positions', 'of the recording')}",
        ]
    )


# Readers of public data sets, as examples of a function of one's own.


_EPI = ("hold", "rub", "pat", "pick", "poke", "press", "scratch", "slap", "stroke", "tap", "tickle")
# Labels of the report by the names of the gestures; others are unknown: no force, and pat and pick repeat.
_EPI_LABELS = {
    "big": {0: 1, 1: 1, 2: 1, 7: 1, 8: 1, 3: 0, 4: 0, 5: 0, 6: 0, 9: 0, 10: 0},  # with the hand
    "dynamic": {1: 1, 6: 1, 8: 1, 10: 1, 0: 0, 2: 0, 4: 0, 5: 0, 7: 0, 9: 0},
    "press": {0: 1, 1: 1, 5: 1, 6: 1, 8: 1, 10: 1, 4: 0, 7: 0, 9: 0},
}


def epi(path: Path, frames: int = 100, duration: PositiveFloat = 3.5) -> Recording:
    """Read the touches of the head of the robot Epi: 11 gestures on 12 electrodes, without a stated licence.

    Each row holds all frames of the first electrode, then of the second, and so on.

    Args:
        path: folder of ``training_data_x.csv`` and ``training_data_y.csv``, of
            github.com/axelholmqvist/humanoid-touch-classification.
        frames: per touch.
        duration: of a touch, s.

    Raises:
        InputError: no such files, or a row of another length.
    """
    try:
        values, kinds = (
            pd.read_csv(path.expanduser() / f"training_data_{name}.csv", header=None) for name in "xy"
        )
        readings = (0.1 * values.to_numpy(dtype=float)).astype(np.float32)
        numbers = kinds.to_numpy(dtype=int).ravel()
        touches = readings.reshape(len(numbers), -1, frames).swapaxes(1, 2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} has no touches of Epi: {' '.join(str(error).split())}") from error
    return build_recording(
        np.ascontiguousarray(touches),
        round(frames / duration, 2),
        labels={name: [its.get(number) for number in numbers] for name, its in _EPI_LABELS.items()},
        kinds=[_EPI[number] for number in numbers],
        names=_EPI,
        about="Epi, A. Holmqvist, M. Karlsson and M. Mirstroem, "
        "github.com/axelholmqvist/humanoid-touch-classification, no licence stated",
    )


def eflesh(path: Path) -> Recording:
    """Read presses of eFlesh, magnetometers under a printed lattice; each row is a touch of five frames.

    Targets are the force of the gauge, where there is one, with the label ``dangerous`` above 10 N, an
    example; or the position of the probe, with the labels ``right`` and ``low``. The group is the session.

    Args:
        path: a folder of characterization/datasets of github.com/notvenky/eFlesh.

    Raises:
        InputError: no such files, or files of different lengths.
    """
    files = sorted(path.expanduser().glob("*/sensor_post_baselines.csv"))
    if not files:
        raise InputError(f"{path} has no file */sensor_post_baselines.csv: give a folder of eFlesh")
    try:
        tables = [pd.read_csv(file, header=None) for file in files]
        states = [pd.read_csv(file.with_name("states.csv"), header=None) for file in files]
        if list(map(len, tables)) != list(map(len, states)):
            raise ValueError("states.csv needs as many rows in the same order")
        fields = pd.concat(tables).to_numpy(dtype=float)[:, 1:]
        session = np.repeat([file.parent.name for file in files], list(map(len, tables)))
        _, x, y, _, *gauge = pd.concat(states).to_numpy(dtype=float).T
    except (OSError, ValueError) as error:
        raise InputError(f"{path} has no presses of eFlesh: {' '.join(str(error).split())}") from error
    readings = np.zeros((len(fields), 5, fields.shape[1]), np.float32)
    readings[:, 2] = 0.1 * fields  # the scale is nominal
    place = {"x": 1e-3 * (x - 274), "y": 1e-3 * (y + 115)}
    # Gram is inferred: it reproduces the published error. -1 stands for no value.
    targets = {"force": FORCES["g"] * np.where(gauge[0] == -1, np.nan, gauge[0])} if gauge else place
    limits = {"dangerous": ("force", 10.0)} if gauge else {"right": ("x", 0.015), "low": ("y", 0.015)}
    return build_recording(
        readings,
        10.0,  # nominal, of presses without a time
        targets={name: values.tolist() for name, values in targets.items()},
        labels={
            label: [None if np.isnan(value) else int(value > limit) for value in targets[name]]
            for label, (name, limit) in limits.items()
        },
        groups={"session": session.tolist()},
        about="eFlesh, github.com/notvenky/eFlesh, MIT License, Copyright (c) 2025 Venkatesh Pattabiraman",
        per_sensor=3,
        size=None if gauge else (0.03, 0.03),
    )
