"""Recordings as Parquet files: one row per frame, as in the report (2.1.1).

Columns: ``simulation``, ``frame``, one per label, ``reading_00`` ... (N, in the layout's order), ``force``
(N), ``D_s_00`` ... and ``D_t_00`` ... (m), then ``gesture_*``: each gesture's parameters, repeated in its
rows, then ``saturated_00`` ...: 1 where a sensor is at its limit, then ``contact_00_x``, ``_y``, ``_radius``
(m), ``_force`` (N), ``_peak`` (Pa), ``contact_01_x`` ...: fingertips, empty where there is none. What is
unknown has no column; a reading that means nothing (a dead sensor) is empty and is read back as 0 and
invalid; an empty label or parameter is unknown, NaN. Everything else (units, layout, rate, seeds, versions)
is JSON in the file's schema under ``skin``. Of both there is a checksum (:mod:`skin.core.safe_loading`); what
has none, of older versions or made by hand, is read without.

The same columns are written to CSV, for a spreadsheet; without the rest, such a table is no recording.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import accumulate
from math import nan
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import torch
from annotated_types import Ge, Gt, Le, Lt, MinLen
from torch import Tensor

from skin.body.base import require_memory
from skin.core import files
from skin.core.files import MANIFEST, tabular, whole
from skin.core.safe_loading import check_content, parse_json, read_file, sha256, write_parquet
from skin.core.settings import ONCE, check_settings
from skin.device.touches import Recording, Touches
from skin.errors import InputError
from skin.touch.labels import CONTACT, Task

FORMAT = 1
UNITS = {"reading": "N", "force": "N", "D_s": "m", "D_t": "m", "positions": "m", "size": "m", "rate": "Hz"}

_Count = Annotated[int, Ge(1), Le(2**31 - 1)]  # rows, gestures and frames are numbered in 32 bits
_Extent = Annotated[float, Gt(0), Lt(1e9)]


def _description(
    format: int,
    units: dict,
    gestures: _Count,
    frames: _Count,
    rate: _Extent,
    positions: Annotated[list[tuple[float, float, float]], MinLen(1)],
    footprint: tuple[_Extent, _Extent],
    size: tuple[_Extent, _Extent],
    task: dict,
    labelled: bool,
    force: bool,
    displacement: bool,
    saturated: bool,
    parameters: Annotated[list[str], ONCE],
    metadata: dict,
    first: Annotated[int, Ge(0), Le(2**31 - 1)],
    contacts: Annotated[int, Ge(0), Le(2**31 - 1)] = 0,
) -> None:
    """Name the entries of a description, with their types."""


def describe_recording(recording: Recording, first: int = 0) -> dict[str, Any]:
    """Return everything that a file contains beside its rows; ``first`` is the number of the first touch."""
    touches, geometry = recording.touches, recording.touches.geometry
    return {
        "format": FORMAT,
        "units": UNITS,
        "gestures": len(touches),
        "first": first,
        "frames": touches.readings.shape[1],
        "rate": touches.rate,
        "positions": touches.positions.tolist(),
        "footprint": list(recording.footprint),
        "size": list(recording.size),
        "task": asdict(recording.task),
        "labelled": touches.labels is not None,
        "force": recording.force is not None,
        "displacement": recording.displacement is not None,
        "saturated": touches.saturated is not None,
        "parameters": list(recording.parameters),
        "metadata": recording.metadata
        # The normals of the sensors, which a recording has no tensor for.
        | ({} if geometry is None or geometry.ndim > 2 else {"directions": geometry[:, 3:6].tolist()}),
        # Only with contacts, so that a file without them is what earlier versions write and read.
        **({} if touches.contacts is None else {"contacts": touches.contacts.shape[2]}),
    }


def numbered(name: str, count: int) -> list[str]:
    """Return the columns of a quantity with one value per sensor."""
    digits = max(2, len(str(count - 1)))
    return [f"{name}_{number:0{digits}d}" for number in range(count)]


def column_types(about: dict[str, Any]) -> dict[str, pa.DataType]:
    """Return the name and type of every column of a description, in order."""
    task, sensors = about["task"], len(about["positions"])
    columns = {"simulation": pa.int32(), "frame": pa.int32()}
    if about["labelled"]:
        binary = set(Task(**task).binary)
        kinds = [pa.int8() if name in binary else pa.float32() for name in task["names"]]
        columns |= dict(zip(task["names"], kinds, strict=True))
    names = numbered("reading", sensors) + ["force"] * about["force"]
    limits = numbered("saturated", sensors) if about["saturated"] else []
    if about["displacement"]:
        names += numbered("D_s", sensors) + numbered("D_t", sensors)
    names += [f"gesture_{name}" for name in about["parameters"]]
    columns |= dict.fromkeys(names, pa.float32()) | dict.fromkeys(limits, pa.int8())
    return columns | dict.fromkeys(_contact_names(about), pa.float32())


def _contact_names(about: dict[str, Any]) -> list[str]:
    """Return the columns of contacts, one contact after the other."""
    return [
        f"{contact}_{name}" for contact in numbered("contact", about.get("contacts", 0)) for name in CONTACT
    ]


_EACH_FRAME = ("reading_", "force", "D_s_", "D_t_", "contact_")


def write_recording(recording: Recording, path: str | Path, first: int = 0) -> Path:
    """Write a recording atomically.

    Args:
        recording: to write.
        path: ``x.parquet``, or ``x.csv`` for its rows alone.
        first: number of its first touch in the column ``simulation``.

    Raises:
        InputError: another ending, or a folder that cannot be written.
    """
    path = tabular(path, "a recording")
    about = describe_recording(recording, first)
    table = tabulate(recording, about)
    with whole(path) as partial:
        if path.suffix == ".csv":
            pa.csv.write_csv(table, partial)
        else:
            text = files.json_line(about)
            table = table.replace_schema_metadata({"skin": text, "skin_sha256": sha256(text.encode())})
            # A dictionary of noisy readings would take most of the time and save no space.
            dictionary = [name for name in table.column_names if not name.startswith(_EACH_FRAME)]
            write_parquet(table, partial, compression="zstd", use_dictionary=dictionary)
    return path


def tabulate(recording: Recording, about: dict[str, Any]) -> pa.Table:
    """Return the rows of a recording, which :func:`describe_recording` describes."""
    touches, moves = recording.touches, recording.displacement
    batch, time, _ = touches.readings.shape

    def of_frames(values: Tensor | None) -> np.ndarray:
        return (
            np.empty((batch * time, 0)) if values is None else values.reshape(batch * time, -1).cpu().numpy()
        )

    def of_gestures(values: Tensor | None) -> np.ndarray:
        return of_frames(None if values is None else values[:, None].expand(-1, time, -1))

    parameters = torch.stack([*recording.parameters.values()], 1) if recording.parameters else None
    parts = (
        np.stack(_rows(about), axis=1),
        np.ma.masked_invalid(of_gestures(touches.labels)),
        np.ma.masked_array(of_frames(touches.readings), ~of_frames(touches.valid)),
        of_frames(recording.force),
        of_frames(None if moves is None else moves.movedim(3, 2)),
        np.ma.masked_invalid(of_gestures(parameters)),
        of_frames(touches.saturated),
        np.ma.masked_invalid(of_frames(touches.contacts)),
    )
    return pa.table(
        {
            name: pa.array(np.ma.getdata(array), kind, mask=np.ma.getmaskarray(array), safe=False)
            for (name, kind), array in zip(
                column_types(about).items(), (column for part in parts for column in part.T), strict=True
            )
        }
    )


def _rows(about: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns ``simulation`` and ``frame``."""
    batch, time = about["gestures"], about["frames"]
    return np.repeat(np.arange(batch) + about["first"], time), np.tile(np.arange(time), batch)


def read_recording(path: str | Path, complete: bool = True) -> Recording:
    """Read a recording of :func:`write_recording`; equal to the last bit.

    Args:
        path: ``x.parquet``.
        complete: read force, displacements and parameters too.

    Raises:
        InputError: no such file, not a recording, damaged, or rows that are not whole touches.
    """
    path = tabular(path, "a recording")
    if path.suffix == ".csv":
        raise InputError(f"{path} is a table without layout and rate: give {path.with_suffix('.parquet')}")
    with refused(path):
        check_content(path.read_bytes())
        about, task = _describe(path)
        if not complete:
            about |= {"force": False, "displacement": False, "parameters": []}
        columns = column_types(about)
        with pa.parquet.ParquetFile(path, page_checksum_verification=True) as file:
            rows = file.metadata.num_rows
            require_memory(
                16.0 * rows * len(columns), f"{path}, {rows} rows,", "give a recording of fewer gestures"
            )
            table = file.read(columns=list(columns)).cast(pa.schema(columns.items()))
        return from_table(table, about, task)


def read_description(path: Path) -> dict[str, Any]:
    """Return everything that a recording contains beside its rows, as :func:`describe_recording` does.

    Raises:
        InputError: as of :func:`read_recording`; the rows are not read.
    """
    with refused(path):
        return _describe(path)[0]


_AGAIN = "delete it, and repeat the skin generate that made the data set, which draws it again"


@contextmanager
def refused(path: Path) -> Iterator[None]:
    """Turn errors of a file that cannot be read as a recording into an InputError."""
    if not path.is_file():
        raise InputError(f"no recording {path}: skin generate n=1000 out={path} makes one")
    try:
        yield
    except InputError:
        raise
    except (OSError, pa.ArrowException, ValueError, KeyError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        reason += f": {_AGAIN}" if (path.parent.parent / MANIFEST).is_file() else ""
        raise InputError(f"{path} is damaged or no recording of this project: {reason}") from error


def _describe(path: Path) -> tuple[dict[str, Any], Task]:
    stored = pa.parquet.read_schema(path).metadata or {}
    if b"skin" not in stored:
        raise ValueError("its schema has no units, layout and rate under 'skin'")
    digest = sha256(stored[b"skin"]).encode()
    if stored.get(b"skin_sha256", digest) != digest:  # older files have none
        raise ValueError("its units, layout and rate are not those that were written")
    about = json.loads(stored[b"skin"])
    return about, check_description(about, path)


def check_description(about: dict[str, Any], path: Path) -> Task:
    """Check what :func:`describe_recording` returned; return its task.

    Raises:
        ValueError: it is of another version, or has other units.
        InputError: an entry is missing or invalid.
    """
    if isinstance(about, dict) and about.get("format") != FORMAT:
        raise ValueError(f"it has format {about.get('format')}, this version reads format {FORMAT}")
    check_settings(_description, about, f"{path}: description", whole=True)
    check_settings(Task, about["task"], f"{path}: task", whole=True)
    if about["units"] != UNITS:
        raise ValueError(f"it has the units {about['units']}, needed are {UNITS}: convert it before")
    return Task(**about["task"] | {"names": tuple(about["task"]["names"])})


def from_table(table: pa.Table, about: dict[str, Any], task: Task) -> Recording:
    """Return the recording of rows of :func:`tabulate`, with their description and its task.

    Raises:
        ValueError: rows that are not whole touches.
    """
    batch, time, sensors = about["gestures"], about["frames"], len(about["positions"])
    if table.num_rows != batch * time:
        raise ValueError(
            f"it has {table.num_rows} rows, not {batch} touches of {time} frames: is it cut off?"
        )
    for name, expected in zip(("simulation", "frame"), _rows(about), strict=True):
        if len(wrong := np.flatnonzero(table[name].to_numpy() != expected)):
            raise ValueError(
                f"row {wrong[0] + 1}: {name} is {table[name][wrong[0]]}, expected {expected[wrong[0]]}: "
                "every touch needs its frames in order"
            )

    def numbers(names: Sequence[str], unknown: float = 0.0) -> Tensor:
        columns = [table[name].cast(pa.float32()).fill_null(unknown).to_numpy() for name in names]
        return torch.from_numpy(np.stack(columns, axis=-1)).view(batch, time, -1)

    def of_sensors(name: str) -> Tensor:
        return numbers(numbered(name, sensors))

    valid = np.stack([table[name].is_valid().to_numpy() for name in numbered("reading", sensors)], axis=-1)
    contacts = _contact_names(about)
    touches = Touches(
        of_sensors("reading"),
        torch.from_numpy(valid).view(batch, time, -1),
        torch.tensor(about["positions"], dtype=torch.float32),
        numbers(task.names, nan)[:, 0].clone() if about["labelled"] else None,
        about["rate"],
        saturated=of_sensors("saturated") > 0.5 if about["saturated"] else None,
        contacts=numbers(contacts, nan).unflatten(-1, (-1, len(CONTACT))) if contacts else None,
    )
    return Recording(
        touches,
        task,
        tuple(about["size"]),
        tuple(about["footprint"]),
        numbers(["force"])[..., 0] if about["force"] else None,
        torch.stack([of_sensors("D_s"), of_sensors("D_t")], dim=-1) if about["displacement"] else None,
        {name: numbers([f"gesture_{name}"], nan)[:, 0, 0].clone() for name in about["parameters"]},
        about["metadata"],
    )


# A data set: recordings in ``shards/00000.parquet`` and so on, whose column ``simulation`` numbers the
# touches of all, and ``manifest.json`` with schema, version, units, seed, source commit and configuration.

_Positive = Annotated[int, Ge(1)]


def _manifest(
    version: int,
    columns: dict,
    units: dict,
    gestures: _Positive,
    frames: _Positive,
    rate: Annotated[float, Gt(0)],
    seed: int | None,
    source_commit: str,
    source_dirty: str,
    config_hash: str,
    config: dict,
    shards: Annotated[list[_Positive], MinLen(1)],
) -> None:
    """Name the entries of a manifest, with their types."""


def write_manifest(folder: Path, about: dict[str, Any], shards: Sequence[int], **source: Any) -> None:
    """Begin a data set: write its manifest.

    Args:
        folder: of the data set.
        about: description of any shard (:func:`describe_recording`).
        shards: number of touches of each.
        source: seed, source_commit, source_dirty, config_hash and config of the touches.
    """
    manifest = {
        "version": FORMAT,
        "columns": {name: str(kind) for name, kind in column_types(about).items()},
        "units": UNITS,
        "gestures": sum(shards),
        "frames": about["frames"],
        "rate": about["rate"],
        **source,
        "shards": list(shards),
    }
    files.write(files.json_line(manifest, indent=1) + "\n", folder / MANIFEST)


class DataSet:
    """A data set in a folder.

    Opening it reads the manifest and the description of every shard, but no touches.

    Args:
        folder: as ``skin generate out=FOLDER`` wrote it.
        complete: whether all shards must be there; False: only the manifest is read.

    Attributes:
        manifest: content of its manifest.
        counts: number of touches of each shard.
        firsts: number of the first touch of each shard.
        missing: numbers of the shards that are not there.

    Raises:
        InputError: there is no manifest, or a shard is missing, damaged or of another data set.
    """

    def __init__(self, folder: str | Path, complete: bool = True) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / MANIFEST
        if not path.is_file():
            raise InputError(
                f"{folder} is no data set, because it has no {MANIFEST}: give a folder that skin generate "
                f"n=1000 out={self.folder.name} made, or the .parquet file beside the folder of a session"
            )
        try:
            self.manifest = parse_json(read_file(path))
        except (OSError, ValueError) as error:
            raise InputError(f"{path} is damaged: {error}: restore it, or generate the data again") from error
        check_settings(_manifest, self.manifest, str(path), whole=True)
        self.counts: list[int] = self.manifest["shards"]
        expected = self.manifest | {"version": FORMAT, "units": UNITS, "gestures": sum(self.counts)}
        if wrong := [name for name, value in expected.items() if self.manifest[name] != value]:
            raise InputError(
                f"{path} has {wrong[0]} {self.manifest[wrong[0]]}, not {expected[wrong[0]]}: use the version "
                "of this program that wrote it, or generate the data again"
            )
        self.firsts = list(accumulate(self.counts[:-1], initial=0))
        self.missing = [n for n in range(len(self.counts)) if not self.path(n).is_file()]
        if complete:
            self._check_shards()

    def _check_shards(self) -> None:
        """Raise InputError unless every shard is there and is the one that the manifest describes."""
        if self.missing:
            raise InputError(
                f"{self.folder} is not complete, {len(self.missing)} of {len(self.counts)} shards are "
                f"missing, as {self.path(self.missing[0]).name} is: repeat the skin generate that made it, "
                "which adds them"
            )
        for number, (count, first) in enumerate(zip(self.counts, self.firsts, strict=True)):
            about = read_description(self.path(number))
            expected = about["gestures"], about["first"], about["metadata"].get("config_hash")
            if expected != (count, first, self.manifest["config_hash"]):
                raise InputError(f"{self.path(number)} is not the shard that {MANIFEST} describes: {_AGAIN}")

    def path(self, number: int) -> Path:
        """Return the path of a shard."""
        return self.folder / "shards" / f"{number:05d}.parquet"
