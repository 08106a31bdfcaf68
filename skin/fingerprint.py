"""What a result depends on: a hash of configuration, the files it names, and version; code and processor."""

import hashlib
import json
import platform
import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from skin import __version__
from skin.paths import BUNDLED, MANIFEST, ROOT, candidates

MACHINE = ("accelerator", "devices", "enable_progress_bar", "num_nodes", "precision", "strategy")
"""Settings of Lightning's Trainer that choose the machine, not the result."""
_FOLDERS = ("skin", "experiments", "conf", "data")  # results depend on nothing else in the repository


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


@cache
def source_tags() -> dict[str, str]:
    """Return the tags ``source_commit`` and ``source_dirty`` of the code, and ``processor``.

    ``source_commit`` is the last commit that changed the code; without git, the version of the package.
    ``source_dirty`` is ``true`` if files differ from that commit, ``false`` if none does, and ``unknown``
    without git.
    """
    commit, dirty = _git("log", "-1", "--format=%H", "--", *_FOLDERS), "unknown"
    if commit:
        dirty = "true" if _git("status", "--porcelain", "--", *_FOLDERS) else "false"
    return {
        "source_commit": commit or __version__,
        "source_dirty": dirty,
        "processor": _processor(),
    }


def _git(*arguments: str) -> str | None:
    """Return the output of git in the repository; None without git."""
    if BUNDLED != ROOT:  # a wheel, which may be installed inside another repository
        return None
    try:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _processor() -> str:
    """Return the name of the processor, with its family and model where the system tells them."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    known = dict(re.findall(r"^(model name|cpu family|model)\s*:\s*(.+)$", text, re.MULTILINE))
    if not known:
        return platform.processor() or platform.machine() or "unknown"
    return ", ".join(
        part for part in (
            known.get("model name"),
            f"family {known['cpu family']}" if "cpu family" in known else None,
            f"model {known['model']}" if "model" in known else None,
        ) if part
    )  # fmt: skip
