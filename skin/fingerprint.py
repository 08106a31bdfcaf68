"""Hash of everything that a result depends on: configuration, the files it names, and version."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from skin import __version__
from skin.paths import MANIFEST, candidates

MACHINE = ("accelerator", "devices", "enable_progress_bar", "num_nodes", "precision", "strategy")
"""Settings of Lightning's Trainer that choose the machine, not the result."""


def config_hash(content: dict[str, Any]) -> str:
    """Return the hash of a configuration in plain containers, 16 hexadecimal digits."""
    files = {value: _hash_of(value) for value in _strings(content) if _file(value)}
    text = json.dumps([_without_machine(content), files, __version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without_machine(value: Any, group: str = "") -> Any:
    """Return a configuration without :data:`MACHINE`."""
    if not isinstance(value, dict):
        return value
    left_out = MACHINE if group == "trainer" else ()
    return {key: _without_machine(entry, key) for key, entry in value.items() if key not in left_out}


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for entry in value.values():
            yield from _strings(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _strings(entry)


def _file(name: str) -> Path | None:
    """Return the file that a setting names, the manifest of a data set, or None."""
    plain = "/" not in name and "." not in name
    try:
        paths = [path / MANIFEST if plain or path.is_dir() else path for path in candidates(name)]
        return next((found for found in paths if found.is_file()), None)
    except OSError:
        return None


def _hash_of(name: str) -> str:
    path = _file(name)
    if path is None:
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
