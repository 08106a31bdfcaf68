"""A hash of what a result depends on: its configuration, the files it names, and the version."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from skin import __version__
from skin.paths import candidates

__all__ = ["digest"]

# Group -> settings that were added later. With these values nothing changes, so older runs keep their hash.
_LATER: dict[str, dict[str, Any]] = {
    "touch": {"stretch": 4.0, "leak": 0.6, "strict": False},
    "layout": {"depth": None},
}


def digest(content: dict[str, Any]) -> str:
    """Return the hash of a configuration in plain containers, 16 hexadecimal digits."""
    files = {value: _hash_of(value) for value in _strings(content) if _file(value)}
    text = json.dumps([_without_later(content), files, __version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without_later(value: Any, group: str = "") -> Any:
    """Return a configuration without the later settings that are at their defaults, wherever a group is."""
    if not isinstance(value, dict):
        return value
    later = _LATER.get(group, {})
    return {key: _without_later(one, key) for key, one in value.items() if later.get(key, ...) != one}


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
    """Return the file that a setting names, as the package finds it, if there is one."""
    if "/" not in name and "." not in name:
        return None
    try:
        return next((found for found in candidates(name) if found.is_file()), None)
    except OSError:
        return None


def _hash_of(name: str) -> str:
    path = _file(name)
    if path is None:
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
