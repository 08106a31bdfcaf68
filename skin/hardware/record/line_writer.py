"""A file that grows by whole lines and has one writer at a time."""

import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from skin.errors import InputError
from skin.files import unwritable

_SUM = ', "sum": "'


class LineWriter:
    """Adds lines to the end of a file. Where one does not fit on the disk, nothing of it stays.

    Args:
        path: of the file, which exists.

    Raises:
        InputError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _said(path):
            # Windows would write two bytes for the end of a line.
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            self._size = os.fstat(self._file).st_size

    def add(self, text: str) -> None:
        """Add a line.

        Raises:
            InputError: the disk is full or fails; the file ends with the line before.
        """
        rest = data = text.encode() + b"\n"
        with _said(self._path):
            try:
                # One call is the rule: a program that is killed has written all of a line or nothing of it.
                # A disk that is nearly full takes a part.
                while rest:
                    rest = rest[os.write(self._file, rest) :]
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._file, self._size)
                raise
        self._size += len(data)

    def sync(self) -> None:
        """Let all lines reach the disk; InputError as above."""
        with _said(self._path):
            os.fsync(self._file)

    def close(self) -> None:
        """Close the file; InputError as above."""
        with _said(self._path):
            os.close(self._file)


@contextmanager
def _said(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; what it holds is kept, and the same command goes on "
            "once there is room"
        ) from error


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other programs from recording to a file. The lock ends with the process, however that ends.

    The empty file ``.NAME.lock`` that carries the lock stays beside it.

    Raises:
        InputError: another program records to it, or its folder cannot be written.
    """
    target = path.resolve()
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(
            f"{path} is being recorded by another process: end that, or give another out="
        ) from error
    except OSError as error:
        raise unwritable(path, error, "out=FILE.csv") from error
    try:
        yield
    finally:
        lock.release()


def encode_event(event: str, **what: Any) -> tuple[str, str]:
    """Return an event as a line of JSON behind #, with its checksum, and the checksum."""
    text = "# " + json.dumps({"event": event, **what})
    token = f"{zlib.crc32(text.encode()):08x}"
    return f'{text[:-1]}{_SUM}{token}"}}', token


def decode_event(line: str) -> tuple[dict[str, Any], str]:
    """Return what :func:`encode_event` was given and the checksum, empty in an older session that has none.

    Raises:
        ValueError: no JSON, or another checksum.
    """
    said = json.loads(line[1:])
    token = said.pop("sum", "")
    if token and f"{zlib.crc32((line.rpartition(_SUM)[0] + '}').encode()):08x}" != token:
        raise ValueError("wrong checksum")
    return said, token
