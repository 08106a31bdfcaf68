"""Read files from unknown sources without running code and in bounded memory."""

import hashlib
import json
import math
import re
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin.core.files import json_line

if TYPE_CHECKING:
    import pyarrow as pa


TEXT = 1 << 20
"""Bytes of a configuration or a calibration: the largest ones are some kB."""
_DEEPEST = 50  # levels: the deepest configuration has 6
_BYTES = 1 << 30


def regular(path: Path) -> None:
    """Check that a file is a regular one: a device never ends, and a named pipe may never answer.

    Raises:
        ValueError: it is something else.
        OSError: there is none.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("it is not a regular file")


def read_file(path: Path, maximum: int = _BYTES) -> bytes:
    """Return the content of a regular file.

    Args:
        path: of the file.
        maximum: largest size, bytes.

    Raises:
        ValueError: larger, or not a regular file.
        OSError: unreadable.
    """
    regular(path)
    if path.stat().st_size > maximum:
        raise ValueError(f"it has more than {maximum} bytes")
    return path.read_bytes()


def parse_json(text: str | bytes) -> Any:
    """Return the content of JSON text, whose numbers are finite.

    Raises:
        ValueError: no JSON, nested too deep, or with ``NaN`` or ``Infinity``.
    """
    try:
        return json.loads(text, parse_constant=_finite, parse_float=_finite)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} must be a finite number")
    return number


def load_yaml(path: Path) -> Any:
    """Return the content of a YAML file as plain containers, without resolving interpolations.

    Raises:
        ValueError: not a regular file, no YAML, too large, or with aliases, which can expand to gigabytes.
        OSError: unreadable.
    """
    return parse_yaml(read_file(path, TEXT).decode("utf-8"))


def parse_yaml(text: str) -> Any:
    """Return the content of YAML text as :func:`load_yaml` does.

    Raises:
        ValueError: no YAML, or with aliases.
    """
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise ValueError(f"aliases and more than {_DEEPEST} levels are not read")
        return OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (yaml.YAMLError, OmegaConfBaseException, AssertionError, TypeError, LookupError) as error:
        raise ValueError(" ".join(str(error).split()) or "it contains no configuration") from error


def load_npz(path: Path, maximum: int = _BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file without objects.

    Args:
        path: of the file.
        maximum: largest total size of the arrays and their headers, bytes.

    Raises:
        ValueError: no such file, unreadable, objects, larger arrays, or shapes that do not match the data.
    """
    try:
        check_archive(path, maximum)
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except Exception as error:  # whatever zipfile, zlib, numpy and the parser of its header raise
        raise ValueError(" ".join(str(error).split()) or "it is cut off") from error


def check_archive(path: Path, maximum: int = _BYTES) -> None:
    """Check that what a zip archive, such as weights of torch, expands to fits into memory.

    An array takes no more: reading ends with an error where its header claims more than its entry has.

    Args:
        path: of the file.
        maximum: largest total size of its entries, bytes.

    Raises:
        ValueError: not a regular file, no zip archive, or larger entries.
        OSError: unreadable.
    """
    regular(path)
    try:
        with zipfile.ZipFile(path) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
    except zipfile.BadZipFile as error:
        raise ValueError(f"it cannot be read as an archive of arrays: {error}") from error
    if total > maximum:
        raise ValueError(f"it expands to {total} bytes, more than {maximum}")


@contextmanager
def limited_memory(extra: int) -> Iterator[None]:
    """Let this process take no more than ``extra`` bytes on top of what it has, while the block runs.

    Who asks for more gets a MemoryError or the error of its library. There is no limit where the system does
    not know one for address space, as on macOS and Windows.
    """
    try:
        import resource
    except ImportError:  # Windows
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = psutil.Process().memory_info().vms + extra
    limit = limit if before[0] == resource.RLIM_INFINITY else min(limit, before[0])
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


# Checksums inside the files that they are of, so that damage never passes for content.

KEY = "skin_file_sha256"
"""Name of the entry with the checksum in the metadata of a binary file (Parquet, ONNX)."""
BLANK = 64 * "0"
"""Its value before :func:`seal`."""
# The formats write up to three bytes between a key and its value.
_ENTRY = re.compile(KEY.encode() + b".{1,4}?([0-9a-f]{64})", re.DOTALL)
_LINE = "sha256:"


class ChecksumError(ValueError):
    """A file is not as it was written; its argument, if any, is what fixes that."""

    def __str__(self) -> str:
        return ": ".join(["it is damaged or was changed: its checksum differs from its content", *self.args])


def sha256(content: bytes) -> str:
    """Return the checksum of some bytes, 64 hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def write_parquet(table: "pa.Table", path: Path, **settings: Any) -> None:
    """Write a Parquet file with a checksum for :func:`check_content`.

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


def json_sum(content: Any) -> str:
    """Return the checksum of JSON data, whatever their spacing and order."""
    return sha256(json_line(content, sort_keys=True).encode())


def read_parts(folder: Path) -> "tuple[dict[str, Any], dict[Path, pa.Table | None]]":
    """Read a folder of Parquet files of :func:`write_parquet`, in the order of their names.

    Returns:
        Metadata of ``about.json``, and the table of each file; None where the file is damaged, unreadable or
        has no checksum.

    Raises:
        ValueError: ``about.json``, which has its :func:`json_sum` under ``sum``, is damaged.
        OSError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    metadata = parse_json(read_file(folder / "about.json"))
    if not isinstance(metadata, dict) or metadata.pop("sum", "") != json_sum(metadata):
        raise ValueError("the checksum of about.json is not that of its content")
    parts: dict[Path, pa.Table | None] = {}
    for path in sorted(folder.glob("[!.]*.parquet")):
        parts[path] = None
        with suppress(OSError, ValueError):
            content = read_file(path)
            if KEY.encode() in content:
                check_content(content)
                parts[path] = pq.read_table(pa.BufferReader(content), page_checksum_verification=True)
    return metadata, parts


def seal(path: Path) -> None:
    """Replace the value :data:`BLANK` of the entry :data:`KEY` of a file by the checksum of the file.

    The checksum is of all bytes, with :data:`BLANK` at its own position.

    Raises:
        ValueError: the file has no such entry.
    """
    content = path.read_bytes()
    position, digest = _checksum(content)
    path.write_bytes(content[: position.start] + digest + content[position.stop :])


def check_content(content: bytes) -> None:
    """Check the checksum of :func:`seal` in the content of a file, before anything else of it is interpreted.

    Files of other programs have none and pass.

    Raises:
        ChecksumError: it is not as it was written.
    """
    if KEY.encode() in content:
        position, digest = _checksum(content)
        if content[position] != digest:
            raise ChecksumError


def _checksum(content: bytes) -> tuple[slice, bytes]:
    """Return where the checksum is, in the last entry (metadata are at the end), and what it must be."""
    match = _ENTRY.match(content, max(content.rfind(KEY.encode()), 0))
    if match is None:
        raise ChecksumError
    start, end = match.span(1)
    return slice(start, end), sha256(content[:start] + BLANK.encode() + content[end:]).encode()


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
