"""Captures of CoST.csv, cached on disk."""

import hashlib
import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np

from skin.array_cache import folder
from skin.device._cost import CHANNELS, SOURCE, Captures, read_captures
from skin.errors import InputError
from skin.files import whole
from skin.safe_loading import load_npz

# Raise it when the meaning of a stored file changes.
_FORMAT = 1


def cached_captures(path: Path, window: int) -> Captures:
    """Return the captures of a file from the cache, or read the file and cache them.

    The cache's key is the file's content, so a changed file is read again. If the cache folder cannot be
    written to, a warning is issued.

    Args:
        path: of CoST.csv.
        window: frames per capture.

    Raises:
        InputError: no such file, or not in the corpus's format.
    """
    if not path.is_file():
        raise InputError(f"no file {path}: download CoST.csv from {SOURCE} and add device.path=FILE")
    try:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    key = hashlib.sha256(f"{_FORMAT} {window} {content}".encode()).hexdigest()
    stored = folder(None) / f"cost-{key}.npz"
    known = _load(stored, window)
    if known is not None:
        return known
    found = read_captures(path, window)
    try:
        _save(stored, found)
    except InputError as error:
        warnings.warn(f"captures cannot be kept in {stored.parent}: {error}", RuntimeWarning, stacklevel=2)
    return found


def _load(path: Path, window: int) -> Captures | None:
    """Return the captures in a cache file, or None if it is missing or invalid."""
    try:
        stored = load_npz(path)
        found = Captures(**{field.name: stored[field.name] for field in fields(Captures)})
    except Exception:  # A broken archive may raise anything; the file is then read again.
        return None
    sound = found.counts.shape[1:] == (window, CHANNELS) and found.counts.dtype == np.float32
    others = [values for name, values in vars(found).items() if name != "counts"]
    sound = sound and all(one.shape == (len(found),) and one.dtype.kind == "i" for one in others)
    return found if sound else None


def _save(path: Path, found: Captures) -> None:
    """Write a cache file atomically: other processes may read or write it at the same time."""
    with whole(path) as partial:
        np.savez(partial, **vars(found))
