"""Hash of everything that a result depends on: configuration, the files it names, and version."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from skin import __version__
from skin.earlier_settings import in_frames
from skin.paths import MANIFEST, candidates

RENAMED: dict[str, str] = {
    "skin.learner.features.Features": "skin.learner.boosted_trees.BoostedTrees",
    "skin.representation.measured.Measured": "skin.representation.features.Features",
}
"""Former name of a class -> its name now. Add a line when you move or rename the class of an option."""

# Group -> settings added later, with their neutral values, which keep the hash of older runs.
_LATER: dict[str, dict[str, Any]] = {
    "touch": {"stretch": 4.0, "leak": 0.6, "strict": False, "over_sensors": True},
    "layout": {"depth": None},
    "evaluation": {"gestures": None, "profile": None},
}
MACHINE = ("devices", "enable_progress_bar", "num_nodes", "precision", "strategy")
"""Settings of Lightning's Trainer that choose the machine, not the result."""


def config_hash(content: dict[str, Any]) -> str:
    """Return the hash of a configuration in plain containers, 16 hexadecimal digits.

    Classes enter by their first name, so that renaming a module does not change the hash, and gestures in
    frames (:func:`skin.earlier_settings.in_frames`).
    """
    files = {value: _hash_of(value) for value in _strings(content) if _file(value)}
    first = renamed(in_frames(content), {new: old for old, new in RENAMED.items()})
    text = json.dumps([_relevant(first), files, __version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def renamed(value: Any, names: Mapping[str, str] = RENAMED) -> Any:
    """Return plain containers with renamed classes.

    Args:
        value: containers, or an entry of one.
        names: old -> new; by default ``RENAMED``.
    """
    if isinstance(value, dict):
        return {
            key: names.get(one, one) if key == "_target_" and isinstance(one, str) else renamed(one, names)
            for key, one in value.items()
        }
    return [renamed(one, names) for one in value] if isinstance(value, list) else value


def _relevant(value: Any, group: str = "") -> Any:
    """Return a configuration without settings that do not affect the result.

    These are later settings at their defaults, and those of the machine.
    """
    if not isinstance(value, dict):
        return value
    later = _LATER.get(group, {})
    kept = {key: _relevant(one, key) for key, one in value.items() if later.get(key, ...) != one}
    if group != "trainer":
        return kept
    # The CPU stands for all accelerators, as in earlier runs.
    return {key: one for key, one in kept.items() if key not in MACHINE} | {"accelerator": "cpu"}


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
