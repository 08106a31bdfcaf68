"""Recordings as Parquet and CSV files: one row per frame, as in the report (2.1.1).

Columns: ``simulation``, ``frame``, one per label, ``reading_00`` ... (N, in the layout's order), ``force``
(N), ``D_s_00`` ... and ``D_t_00`` ... (m), then ``gesture_*``: each gesture's parameters, repeated in its
rows, then ``saturated_00`` ...: 1 where a sensor is at its limit. What is unknown has no column; a reading
that means nothing (a dead sensor) is empty and is read back as 0 and invalid. Everything else (units,
layout, rate, seeds, versions) is JSON: in the Parquet file's schema under ``skin``, beside ``x.csv`` in
``x.csv.json``.

Both have checksums of everything: a Parquet file as of :mod:`skin.checksum`, and ``x.csv.json`` under
``sha256`` of the table and of itself. What has none, of older versions or made by hand, is read without.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import torch
from torch import Tensor

from skin import files
from skin.checksum import ChecksumError, check_seal, file_sha256, sha256, write_parquet
from skin.errors import InputError
from skin.files import tabular, whole
from skin.labels import Task
from skin.recording import Recording, Touches
from skin.recording_metadata import (
    FORMAT,
    UNITS,
    check_metadata,
    check_rows,
    column_types,
    describe_recording,
    numbered,
)
from skin.safe_loading import read_file

_EACH_FRAME = ("reading_", "force", "D_s_", "D_t_")


def write_recording(recording: Recording, path: str | Path, first: int = 0) -> Path:
    """Write a recording atomically.

    Args:
        recording: to write.
        path: ``x.parquet`` or ``x.csv``.
        first: number of its first touch in the column ``simulation``.

    Raises:
        InputError: another ending, or a folder that cannot be written.
    """
    path = tabular(path, "a recording")
    about = describe_recording(recording, first)
    table = _table(recording, about)
    with whole(path) as partial:
        if path.suffix == ".parquet":
            text = files.json_line(about)
            table = table.replace_schema_metadata({"skin": text, "skin_sha256": sha256(text.encode())})
            # A dictionary of noisy readings would take most of the time and save no space.
            dictionary = [name for name in table.column_names if not name.startswith(_EACH_FRAME)]
            write_parquet(table, partial, compression="zstd", use_dictionary=dictionary)
        else:
            pa.csv.write_csv(table, partial)
            # The table is moved last, because the sidecar is useless without it.
            sums = {"sha256": {"table": file_sha256(partial), "description": _description_sum(about)}}
            files.write(files.json_line(about | sums, indent=1) + "\n", _sidecar(path))
    return path


def read_recording(path: str | Path, complete: bool = True) -> Recording:
    """Read a recording of :func:`write_recording`; equal to the last bit.

    Args:
        path: ``x.parquet`` or ``x.csv``.
        complete: read force, displacements and parameters too.

    Raises:
        InputError: no such file, not a recording, damaged, or rows that are not whole touches.
    """
    path = tabular(path, "a recording")
    with _refused(path):
        if path.suffix == ".parquet":
            check_seal(path)
        about, task = _described(path)
        if not complete:
            about |= {"force": False, "displacement": False, "parameters": []}
        return _recording(_read_table(path, about), about, task)


def read_description(path: Path) -> dict[str, Any]:
    """Return everything that a recording contains beside its rows, as :func:`describe_recording` does.

    Raises:
        InputError: as of :func:`read_recording`; the rows are not read.
    """
    with _refused(path):
        return _described(path)[0]


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turn what goes wrong with a file that is no recording into an InputError."""
    if not path.is_file():
        raise InputError(f"no recording {path}: skin generate n=1000 out={path} makes one")
    try:
        yield
    except InputError:
        raise
    except (OSError, pa.ArrowException, ValueError, KeyError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path} is damaged or no recording of this project: {reason}") from error


def _described(path: Path) -> tuple[dict[str, Any], Task]:
    about = _read_about(path)
    if isinstance(about, dict) and about.get("format") != FORMAT:
        raise ValueError(f"it has format {about.get('format')}, this version reads format {FORMAT}")
    task = check_metadata(about, str(path))
    sums = about.pop("sha256", None)
    if sums is not None and sums != {"table": file_sha256(path), "description": _description_sum(about)}:
        raise ChecksumError(f"remove sha256 from {_sidecar(path).name} if you changed it or the table")
    return about, task


def _description_sum(about: dict[str, Any]) -> str:
    """Return the checksum of a description, whatever its spacing and order."""
    return sha256(files.json_line(about, sort_keys=True).encode())


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _table(recording: Recording, about: dict[str, Any]) -> pa.Table:
    touches = recording.touches
    batch, time, sensors = touches.readings.shape

    def per_gesture(values: Tensor) -> np.ndarray:
        return np.repeat(values.cpu().numpy(), time)

    arrays = [np.repeat(np.arange(batch) + about["first"], time), np.tile(np.arange(time), batch)]
    arrays += [] if touches.labels is None else [per_gesture(column) for column in touches.labels.unbind(1)]
    readings = touches.readings.reshape(-1, sensors).cpu().numpy()
    invalid = ~touches.valid.reshape(-1, sensors).cpu().numpy()
    arrays += [np.ma.masked_array(readings[:, s], invalid[:, s]) for s in range(sensors)]
    if recording.force is not None:
        arrays.append(recording.force.flatten().cpu().numpy())
    if recording.displacement is not None:
        arrays += list(recording.displacement.permute(3, 2, 0, 1).reshape(2 * sensors, -1).cpu().numpy())
    arrays += [per_gesture(values) for values in recording.parameters.values()]
    if touches.saturated is not None:
        arrays += list(touches.saturated.reshape(-1, sensors).T.cpu().numpy())
    columns = column_types(about)
    return pa.table(
        {
            name: pa.array(np.ma.getdata(array), kind, mask=np.ma.getmaskarray(array), safe=False)
            for (name, kind), array in zip(columns.items(), arrays, strict=True)
        }
    )


def _read_about(path: Path) -> dict[str, Any]:
    if path.suffix == ".csv":
        sidecar = _sidecar(path)
        if not sidecar.is_file():
            raise ValueError(f"it needs {sidecar.name} beside it: units, layout and rate are there")
        return json.loads(read_file(sidecar))
    stored = pa.parquet.read_schema(path).metadata or {}
    if b"skin" not in stored:
        raise ValueError("its schema has no units, layout and rate under 'skin'")
    # Older files have no checksum.
    if stored.get(b"skin_sha256", sha256(stored[b"skin"]).encode()) != sha256(stored[b"skin"]).encode():
        raise ValueError("its units, layout and rate are not those that were written")
    return json.loads(stored[b"skin"])


def _read_table(path: Path, about: dict[str, Any]) -> pa.Table:
    columns = column_types(about)
    if path.suffix == ".csv":
        convert = pa.csv.ConvertOptions(column_types=columns, include_columns=list(columns))
        table = pa.csv.read_csv(path, convert_options=convert)
        check_rows(about, len(table), len(columns), str(path))
        return table
    with pa.parquet.ParquetFile(path, page_checksum_verification=True) as file:
        check_rows(about, file.metadata.num_rows, len(columns), str(path))
        return file.read(columns=list(columns)).cast(pa.schema(columns.items()))


def _recording(table: pa.Table, about: dict[str, Any], task: Task) -> Recording:
    if about["units"] != UNITS:
        raise ValueError(f"it has the units {about['units']}, needed are {UNITS}: convert it before")
    batch, time, sensors = about["gestures"], about["frames"], len(about["positions"])
    rows = np.stack([table[name].to_numpy() for name in ("simulation", "frame")], axis=1)
    first = about.get("first", 0)  # older recordings do not say
    whole = np.stack([np.repeat(np.arange(batch) + first, time), np.tile(np.arange(time), batch)], axis=1)
    if len(wrong := np.flatnonzero((rows != whole).any(axis=1))):
        raise ValueError(
            f"row {wrong[0] + 1}: simulation and frame are {rows[wrong[0]].tolist()}, expected "
            f"{whole[wrong[0]].tolist()}: every touch needs its {time} frames in order"
        )

    def column(name: str) -> Tensor:
        return torch.from_numpy(table[name].fill_null(0).to_numpy().astype(np.float32)).view(batch, time)

    def columns(name: str) -> Tensor:
        return torch.stack([column(column_name) for column_name in numbered(name, sensors)], dim=-1)

    present = [table[name].is_valid().to_numpy() for name in numbered("reading", sensors)]
    touches = Touches(
        columns("reading"),
        torch.from_numpy(np.stack(present, axis=-1)).view(batch, time, sensors),
        torch.tensor(about["positions"], dtype=torch.float32),
        torch.stack([column(name)[:, 0] for name in task.names], dim=1) if about["labelled"] else None,
        about["rate"],
        saturated=columns("saturated") > 0.5 if about.get("saturated") else None,
    )
    return Recording(
        touches,
        task,
        tuple(about["size"]),
        tuple(about["footprint"]),
        column("force") if about["force"] else None,
        torch.stack([columns("D_s"), columns("D_t")], dim=-1) if about["displacement"] else None,
        {name: column(f"gesture_{name}")[:, 0] for name in about["parameters"]},
        about["metadata"],
    )
