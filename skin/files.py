"""Atomic file writing; a full or read-only disk raises InputError."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile

from skin.errors import InputError


def results(out: str | None) -> Path:
    """Return the folder that ``out=`` names, relative to the current one; None: ``results``."""
    return Path("results" if out is None else out).expanduser()


def tabular(path: str | Path, what: str) -> Path:
    """Return the path of a table.

    Args:
        path: as a person gave it.
        what: is in it, the subject of the sentence.

    Raises:
        InputError: another ending than .parquet or .csv.
    """
    path = Path(path).expanduser()
    if path.suffix not in (".parquet", ".csv"):
        raise InputError(f"{what} is a .parquet or .csv file, got {path.name}")
    return path


@contextmanager
def whole(path: Path, place: str = "out=FOLDER") -> Iterator[Path]:
    """Give a temporary path beside ``path``, with its ending, that takes its place if the block ends well.

    It has reached the disk then, so that a power cut leaves the old file or the new one.

    Folders that are missing are made.

    Args:
        path: of the file.
        place: setting that chooses another folder, for the message.

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
        raise unwritable(path, error, place) from error


def write(text: str, path: Path) -> Path:
    """Write a text whole and return its path.

    Raises:
        InputError: as of :func:`whole`.
    """
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def unwritable(path: Path | str, error: OSError, place: str) -> InputError:
    """Return what a person is told where a disk refuses."""
    # Arrow's own words repeat the number and hide the reason.
    reason = os.strerror(error.errno) if error.errno else str(error)
    mend = "make room there" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "make it writable"
    return InputError(f"cannot write {path}: {reason}: {mend}, or choose another place, as in {place}")
