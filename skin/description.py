"""Check the JSON metadata of a recording before memory is allocated for its rows."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from skin.body._memory import require_memory
from skin.errors import InputError
from skin.labels import Task

__all__ = ["check", "check_rows"]

_LARGEST = 2**31 - 1  # rows, gestures and frames are numbered in 32 bits


def check(about: Any, where: str) -> None:
    """Check the description of a recording: types, shapes and ranges of what reading relies on.

    Args:
        about: as JSON gave it.
        where: it comes from, for the message.

    Raises:
        InputError: something is missing or is of another kind; the sentence names it.
    """
    if not isinstance(about, Mapping):
        raise InputError(
            f"{where} is no recording: its description is a {type(about).__name__}, not an object"
        )
    for name, (sound, what) in _SOUND.items():
        if name not in about:
            raise InputError(f"{where} is no recording: its description has no {name}")
        if not sound(about[name]):
            raise InputError(f"{where}: {name} must be {what}, got {_short(about[name])}")
    task = about["task"]
    try:
        Task(**task | {"names": tuple(task["names"])})
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: task describes no labels: {error}") from error


def check_rows(about: Mapping[str, Any], rows: int, columns: int, where: str) -> None:
    """Check that a file has the rows that its description tells of, and that they fit into memory.

    Args:
        about: checked before.
        rows, columns: that the file has.
        where: it is, for the message.

    Raises:
        InputError: other rows, or more than memory allows.
    """
    gestures, frames = about["gestures"], about["frames"]
    if gestures * frames != rows:
        raise InputError(
            f"{where} has {rows} rows, not {gestures} touches of {frames} frames: is it cut off?"
        )
    require_memory(16.0 * rows * columns, f"{where}, {rows} rows,", "give a recording of fewer gestures")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _count(value: Any) -> bool:
    return type(value) is int and 1 <= value <= _LARGEST


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def _positive(value: Any) -> bool:
    return _number(value) and 0 < value < 1e9


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_positive, value))


def _places(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) > 0
        and all(isinstance(one, list) and len(one) == 3 and all(map(_number, one)) for one in value)
    )


def _names(value: Any) -> bool:
    return (
        isinstance(value, list)
        and all(isinstance(one, str) for one in value)
        and len(set(value)) == len(value)
    )


def _task(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _names(value.get("names"))
        and len(value["names"]) > 0
        and value.get("kind", "binary") in ("binary", "exclusive")
        and isinstance(value.get("gate"), str | None)
        and isinstance(value.get("direction", False), bool)
    )


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


_SOUND: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "units": (lambda value: isinstance(value, dict), "an object"),
    "gestures": (_count, "a whole number of at least 1"),
    "frames": (_count, "a whole number of at least 1"),
    "rate": (_positive, "a number above 0, in Hz"),
    "positions": (_places, "[x, y, depth] of every sensor, in m"),
    "footprint": (_pair, "two numbers above 0, in m"),
    "size": (_pair, "two numbers above 0, in m"),
    "task": (_task, "an object with names, kind, gate and direction"),
    "labelled": (_flag, "true or false"),
    "force": (_flag, "true or false"),
    "displacement": (_flag, "true or false"),
    "parameters": (_names, "a list of names, each once"),
    "metadata": (lambda value: isinstance(value, dict), "an object"),
}
