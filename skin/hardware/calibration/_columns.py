"""Read tables of a bench: CSV or Parquet with a header."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from skin.body._memory import require_memory
from skin.errors import InputError
from skin.files import tabular, whole, write

_KEY = b"skin_session"
_RECORDED = b"time,seq,raw_"  # of skin record: all its columns are numbers
_NUMBERS = b"0123456789+-.e,"
_log = logging.getLogger("skin.hardware.record")


def load_table(path: str | Path, what: str) -> tuple[pa.Table, dict[str, Any]]:
    """Return a table and its metadata: JSON in the Parquet schema, or in ``x.csv.json`` beside a CSV.

    Lines of a CSV that start with ``#`` are comments. Damaged lines of a session of skin record are
    skipped, with a warning.

    Raises:
        InputError: no such file, another ending, unreadable, or no rows.
    """
    path = tabular(path, f"a {what}")
    if not path.is_file():
        raise InputError(f"no {what} {path}")
    try:
        if path.suffix == ".parquet":
            with pa.parquet.ParquetFile(path) as file:
                size = 16.0 * file.metadata.num_rows * file.metadata.num_columns
                require_memory(size, f"the {what} {path}", "give fewer rows")
                table = file.read()
            about = json.loads((table.schema.metadata or {}).get(_KEY, b"{}"))
        else:
            table = pa.csv.read_csv(pa.py_buffer(_rows(path)))
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


def _rows(path: Path) -> bytes:
    """Return a CSV without comments and, for sessions of skin record, without damaged lines."""
    lines = path.read_bytes().removeprefix(b"\xef\xbb\xbf").splitlines()
    rows = [(number, line) for number, line in enumerate(lines, 1) if not line.startswith(b"#")]
    header = rows[0][1] if rows else b""
    if header.startswith(_RECORDED):
        columns = header.count(b",")
        good = [
            row for row in rows[1:] if not row[1].translate(None, _NUMBERS) and row[1].count(b",") == columns
        ]
        if damaged := [number for number, _ in sorted(set(rows[1:]) - set(good))]:
            _log.warning("%s: %d damaged lines skipped, the first is line %d", path, len(damaged), damaged[0])
        rows = [rows[0], *good]
    return b"".join(line + b"\n" for _, line in rows)


def save_table(columns: Mapping[str, Any], about: Mapping[str, Any], path: str | Path) -> Path:
    """Write a table and its metadata atomically, in the format of :func:`load_table`.

    Raises:
        InputError: another ending, or the file cannot be written.
    """
    path, table = tabular(path, "a session"), pa.table(dict(columns))
    with whole(path) as partial:
        if path.suffix == ".parquet":
            pa.parquet.write_table(table.replace_schema_metadata({_KEY: json.dumps(dict(about))}), partial)
        else:
            pa.csv.write_csv(table, partial)
            write(json.dumps(dict(about)) + "\n", path.with_name(path.name + ".json"))
    return path


def numbers(table: pa.Table, name: str, where: str) -> np.ndarray:
    """Return a column as float64; empty cells are NaN.

    Raises:
        InputError: the column is missing or is not numeric.
    """
    try:
        # A copy, because Arrow's memory cannot be written to and torch warns of that.
        return np.array(table[name].cast(pa.float64()).to_numpy())
    except (KeyError, pa.ArrowException) as error:
        found = ", ".join(table.column_names)
        raise InputError(f"{where}: the column {name} must hold numbers, found {found}: {error}") from error
