"""Checksums inside the files that they are of, so that damage never passes for content."""

import hashlib
import mmap
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin.safe_loading import regular

if TYPE_CHECKING:
    import pyarrow as pa

KEY = "skin_file_sha256"
"""Name of the entry with the checksum in the metadata of a binary file (Parquet, ONNX)."""
BLANK = 64 * "0"
"""Its value before :func:`seal`."""
# The formats write at most three bytes between a key and its value.
_ENTRY = re.compile(KEY.encode() + b".{1,4}?([0-9a-f]{64})", re.DOTALL)
_LINE = "sha256:"


class ChecksumError(ValueError):
    """A file is not as it was written."""

    def __init__(self, fix: str = "") -> None:
        reason = "it is damaged or was changed: its checksum is not that of its content"
        super().__init__(f"{reason}: {fix}" if fix else reason)


def sha256(content: bytes) -> str:
    """Return the checksum of some bytes, 64 hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path) -> str:
    """Return the checksum of a regular file, which need not fit into memory.

    Raises:
        ValueError: no regular file.
        OSError: unreadable.
    """
    regular(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_parquet(table: "pa.Table", path: Path, **settings: Any) -> None:
    """Write a Parquet file with a checksum for :func:`check_seal`.

    Args:
        table: to write.
        path: of the file.
        settings: of ``pyarrow.parquet.ParquetWriter``.
    """
    import pyarrow.parquet as pq  # not needed for calibrations, which are read first

    with pq.ParquetWriter(path, table.schema, write_page_checksum=True, **settings) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({KEY: BLANK})
    seal(path)


def seal(path: Path) -> None:
    """Replace the value :data:`BLANK` of the entry :data:`KEY` of a file by the checksum of the file.

    The checksum is of all bytes, with :data:`BLANK` in its own place.

    Raises:
        ValueError: the file has no such entry.
    """
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        place = _find(content)
        if place is None:
            raise ValueError(f"{path} has no entry {KEY}")
        content[place] = _digest(content, place).encode()


def check_seal(path: Path) -> None:
    """Check the checksum of :func:`seal` before anything else of a file is interpreted.

    Files of older versions and of other programs have none and pass.

    Raises:
        ChecksumError: the file is not as it was written.
        ValueError: no regular file.
        OSError: unreadable.
    """
    regular(path)
    if path.stat().st_size:  # nothing cannot be mapped
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            check_content(content)


def check_content(content: bytes | mmap.mmap) -> None:
    """Do the same with the content of a file.

    Raises:
        ChecksumError: it is not as it was written.
    """
    place = _find(content)
    if place is not None and content[place].decode() != _digest(content, place):
        raise ChecksumError


def _find(content: bytes | mmap.mmap) -> slice | None:
    """Return where the checksum is: in the last entry, because metadata are at the end."""
    start = content.rfind(KEY.encode())
    match = None if start < 0 else _ENTRY.match(content, start)
    if start >= 0 and match is None:
        raise ChecksumError
    return match and slice(*match.span(1))


def _digest(content: bytes | mmap.mmap, place: slice) -> str:
    with memoryview(content) as whole:
        result = hashlib.sha256(whole[: place.start])
        result.update(BLANK.encode())
        result.update(whole[place.stop :])
    return result.hexdigest()


def text_sum(text: str) -> str:
    """Return the line of YAML with the checksum of all other lines of a text."""
    return f'{_LINE} "{_text_digest(text)}"  # of the other lines: remove it if you change them'


def check_text(text: str, content: Mapping) -> None:
    """Check the line of :func:`text_sum` in a YAML file, if there is one.

    Args:
        text: of the file.
        content: that YAML finds in it.

    Raises:
        ChecksumError: another line was changed.
    """
    if "sha256" in content and content["sha256"] != _text_digest(text):
        raise ChecksumError


def _text_digest(text: str) -> str:
    # Editors and git may convert the ends of lines.
    return sha256("\n".join(line for line in text.splitlines() if not line.startswith(_LINE)).encode())
