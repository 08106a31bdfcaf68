"""Read files from unknown sources without running code and in bounded memory."""

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

_TEXT = 1 << 20  # bytes: the largest configuration is some kB
_DEEP = 50  # levels: the deepest configuration has 6
_BYTES = 1 << 30


def load_yaml(path: Path) -> Any:
    """Return the content of a YAML file as plain containers, without resolving interpolations.

    Raises:
        ValueError: no YAML, too large, or with aliases, which can expand to gigabytes.
        OSError: unreadable.
    """
    if path.stat().st_size > _TEXT:
        raise ValueError(f"it has more than {_TEXT} bytes")
    text = path.read_text(encoding="utf-8")
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > _DEEP:
                raise ValueError(f"aliases and more than {_DEEP} levels are not read")
        return OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (yaml.YAMLError, OmegaConfBaseException, AssertionError) as error:
        raise ValueError(" ".join(str(error).split()) or "it is no configuration") from error


def load_npz(path: Path, most: int = _BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file without objects.

    Args:
        path: of the file.
        most: largest total size of the arrays, bytes.

    Raises:
        ValueError: no such file, objects, larger arrays, or shapes that do not match the data.
        OSError: unreadable.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            total = sum(_claimed(archive, entry) for entry in archive.infolist())
        if total > most:
            raise ValueError(f"its arrays take {total} bytes, more than {most}")
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except OSError:
        raise
    except Exception as error:  # whatever zipfile, zlib, numpy and the parser of its header raise
        raise ValueError(" ".join(str(error).split()) or "it is cut off") from error


def _claimed(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> int:
    """Return the size of an array, bytes, which must match that of its entry."""
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        known = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in known:
            raise ValueError(f"{entry.filename} has the unknown version {version}")
        shape, _, kind = known[version](file)
        size = math.prod(shape) * kind.itemsize
        if kind.hasobject or size != entry.file_size - file.tell():
            raise ValueError(f"{entry.filename} holds objects, or claims another size than it has")
    return size
