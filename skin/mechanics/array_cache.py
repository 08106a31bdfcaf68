"""A cache on disk for computed arrays, with keys that are hashes of their inputs and source code."""

import hashlib
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from skin.core.files import whole
from skin.core.safe_loading import load_npz
from skin.errors import InputError


def folder(path: str | Path | None) -> Path:
    """Return the folder of the cache: the given one, else the variable SKIN_CACHE, else the user's cache."""
    return Path(path or os.environ.get("SKIN_CACHE") or platformdirs.user_cache_dir("skin")).expanduser()


def hashed(content: Mapping[str, Any], sources: Iterable[Path]) -> str:
    """Return a hash of the inputs and of the source code, so that changed code does not use old files."""
    code = [hashlib.sha256(source.read_bytes()).hexdigest() for source in sources]
    return hashlib.sha256(json.dumps([content, code], sort_keys=True).encode()).hexdigest()


def kept(
    path: Path,
    key: str,
    shapes: Mapping[str, Sequence[int]],
    build: Callable[[], Mapping[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """Return named float64 arrays from their file, or build them and write the file.

    A damaged file, or one with other contents, is rebuilt. A folder that is not writable gives a warning.

    Args:
        path: x.npz.
        key: of :func:`hashed`.
        shapes: of each array.
        build: computes them.
    """
    stored = _load(path, key, shapes)
    if stored is None:
        stored = dict(build())
        try:
            with whole(path) as partial:
                np.savez(partial, allow_pickle=False, **({"key": np.array(key)} | stored))
        except InputError as error:
            warnings.warn(
                f"the operator cannot be kept in {path.parent}: {error}", RuntimeWarning, stacklevel=3
            )
    return stored


def _load(path: Path, key: str, shapes: Mapping[str, Sequence[int]]) -> dict[str, np.ndarray] | None:
    """Return the arrays of a file, or None if there is no file or anything in it is wrong."""
    with suppress(Exception):  # any error of a broken archive: build the arrays again
        arrays = load_npz(path, maximum=sys.maxsize)  # an operator may be large, and the file is our own
        if str(arrays.pop("key")) == key and all(
            array.shape == tuple(shapes[name]) and array.dtype == np.float64 and np.isfinite(array).all()
            for name, array in arrays.items()
        ):
            return {name: arrays[name] for name in shapes}
    return None
