"""A file to which one writer at a time appends whole lines."""

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from skin.errors import InputError
from skin.files import json_line, unwritable
from skin.safe_loading import parse_json

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None  # type: ignore[assignment]

_SUM = ', "sum": "'


class LineWriter:
    """Appends lines to a file. A line that does not fit on the disk is removed completely.

    The file itself is locked (not on Windows), because it may have another name, a hard link.

    Args:
        path: of an existing file.

    Raises:
        InputError: the file cannot be written, or another writer has it, whatever it calls it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _input_error(path):
            # Windows would write two bytes for the end of a line.
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_BINARY", 0))
            self._size = os.fstat(self._file).st_size
        if fcntl is not None:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(self._file)
                raise _busy(path) from error

    def cut(self, size: int) -> None:
        """Remove what is after the first ``size`` bytes; InputError as below."""
        with _input_error(self._path):
            os.ftruncate(self._file, size)
        self._size = size

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


def _busy(path: Path) -> InputError:
    return InputError(f"{path} is being recorded by another process: end that, or give another out=")


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
        if path.is_file():
            LineWriter(path).close()  # refuses at once a file that is being recorded under another name
    except Timeout as error:
        raise _busy(path) from error
    except OSError as error:
        raise unwritable(path, error, "out=FILE.csv") from error
    try:
        yield
    finally:
        lock.release()


def line_sum(text: str) -> str:
    """Return the checksum of a line, 8 hexadecimal digits."""
    return f"{zlib.crc32(text.encode()):08x}"


def encode_event(event: str, **what: Any) -> tuple[str, str]:
    """Return an event as a line of JSON after #, with its checksum, and the checksum."""
    text = "# " + json_line({"event": event, **what})
    token = line_sum(text)
    return f'{text[:-1]}{_SUM}{token}"}}', token


def decode_event(line: str) -> tuple[dict[str, Any], str]:
    """Decode a line of :func:`encode_event`; return event and checksum, which is empty in older sessions.

    Raises:
        ValueError: no JSON, or a wrong checksum.
    """
    content = parse_json(line[1:])
    token = content.pop("sum", "")
    if token and line_sum(line.rpartition(_SUM)[0] + "}") != token:
        raise ValueError("wrong checksum")
    return content, token
