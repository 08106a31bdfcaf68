"""Atomic file writing; a full or read-only disk raises InputError."""

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from pydantic_core import to_jsonable_python

from skin.errors import InputError


def results(out: str | None) -> Path:
    """Return the folder that ``out=`` names, relative to the current one; None: ``results``."""
    return Path("results" if out is None else out).expanduser()


def tabular(path: str | Path, what: str) -> Path:
    """Return the path of a table.

    Args:
        path: as given by the user.
        what: its content, the subject of the message.

    Raises:
        InputError: another ending than .parquet or .csv.
    """
    path = Path(path).expanduser()
    if path.suffix not in (".parquet", ".csv"):
        raise InputError(f"{what} is a .parquet or .csv file, got {path.name}")
    return path


@contextmanager
def whole(path: Path, override: str = "out=FOLDER") -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` if the block succeeds.

    The file is flushed to the disk first, so that a power cut leaves either the old file or the new one.
    Missing folders are created.

    Args:
        path: of the file.
        override: setting that selects another folder, for the message.

    Raises:
        InputError: the disk is full or read-only, or the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix, delete=False
        ) as file:
            partial = Path(file.name)
        try:
            yield partial
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            partial.chmod(0o644)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error, override) from error


def write(text: str, path: Path) -> Path:
    """Write a text atomically and return its path.

    Raises:
        InputError: as of :func:`whole`.
    """
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def json_text(content: Any) -> str:
    """Return JSON with numbers to six digits; further ones depend on the processor."""
    rounded = json.loads(json_line(content), parse_float=lambda text: float(f"{float(text):.6g}"))
    return json_line(rounded, indent=2) + "\n"


def json_line(content: Any, **settings: Any) -> str:
    """Return valid JSON: numbers that are not finite, which JSON lacks, become ``null``.

    Args:
        content: plain containers.
        settings: of :func:`json.dumps`.
    """
    return json.dumps(to_jsonable_python(content, inf_nan_mode="null"), **settings)


def unwritable(path: Path | str, error: OSError, override: str) -> InputError:
    """Return the error for a file that cannot be written."""
    # The message of Arrow repeats the number and hides the reason.
    reason = os.strerror(error.errno) if error.errno else str(error)
    fix = "make room there" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "make it writable"
    return InputError(f"cannot write {path}: {reason}: {fix}, or choose another place, as in {override}")


# Where the files that come with the package are: in the repository, or in an installed wheel.


_PACKAGE = Path(__file__).parents[1]
ROOT = _PACKAGE.parent
"""The repository, where the package is imported from one."""

BUNDLED = _PACKAGE if (_PACKAGE / "conf").is_dir() else ROOT
"""The folder of ``conf``, ``data`` and ``models``; a wheel has them inside the package."""

CONF = BUNDLED / "conf"
MANIFEST = "manifest.json"
"""The file that makes a folder a data set."""


def candidates(name: str | Path) -> list[Path]:
    """Return where a file may be: relative to the current folder, or beside the package."""
    path = Path(name).expanduser()
    return [path] if path.is_absolute() else [Path.cwd() / path, BUNDLED / path]
