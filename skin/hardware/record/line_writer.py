"""A file to which one writer at a time appends whole lines."""

import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from skin.errors import InputError
from skin.files import json_line, unwritable

_SUM = ', "sum": "'


class LineWriter:
    """Appends lines to a file. A line that does not fit on the disk is removed completely.

    Args:
        path: of an existing file.

    Raises:
        InputError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _input_error(path):
            # Windows would write two bytes for the end of a line.
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            self._size = os.fstat(self._file).st_size

    def add(self, text: str) -> None:
        """Add a line.

        Raises:
            InputError: the disk is full or fails; the file then ends with the previous line.
        """
        rest = data = text.encode() + b"\n"
        with _input_error(self._path):
            try:
                # Usually one call, so that a killed program has written all of a line or nothing. A nearly
                # full disk accepts a part.
                while rest:
                    rest = rest[os.write(self._file, rest) :]
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._file, self._size)
                raise
        self._size += len(data)

    def sync(self) -> None:
        """Flush all lines to the disk; InputError as above."""
        with _input_error(self._path):
            os.fsync(self._file)

    def close(self) -> None:
        """Close the file; InputError as above."""
        with _input_error(self._path):
            os.close(self._file)


@contextmanager
def _input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror}; its content is kept; make room and run the same "
            "command again"
        ) from error


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other programs from recording to a file. The lock ends with the process.

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
    """Return an event as a line of JSON after #, with its checksum, and the checksum."""
    text = "# " + json_line({"event": event, **what})
    token = f"{zlib.crc32(text.encode()):08x}"
    return f'{text[:-1]}{_SUM}{token}"}}', token


def decode_event(line: str) -> tuple[dict[str, Any], str]:
    """Decode a line of :func:`encode_event`; return event and checksum, which is empty in older sessions.

    Raises:
        ValueError: no JSON, or a wrong checksum.
    """
    content = json.loads(line[1:])
    token = content.pop("sum", "")
    if token and f"{zlib.crc32((line.rpartition(_SUM)[0] + '}').encode()):08x}" != token:
        raise ValueError("wrong checksum")
    return content, token
