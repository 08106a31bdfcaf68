"""Check the JSON metadata of a recording before memory is allocated for its rows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt, MinLen

from skin.body._memory import require_memory
from skin.labels import Task
from skin.settings import ONCE, check_settings

_Count = Annotated[int, Ge(1), Le(2**31 - 1)]  # rows, gestures and frames are numbered in 32 bits
_Extent = Annotated[float, Gt(0), Lt(1e9)]


@dataclass(frozen=True)
class _Description:
    """Required keys, which older recordings have too."""

    units: dict
    gestures: _Count
    frames: _Count
    rate: _Extent
    positions: Annotated[list[tuple[float, float, float]], MinLen(1)]
    footprint: tuple[_Extent, _Extent]
    size: tuple[_Extent, _Extent]
    task: dict
    labelled: bool
    force: bool
    displacement: bool
    parameters: Annotated[list[str], ONCE]
    metadata: dict


def check_metadata(about: Any, where: str) -> Task:
    """Check the metadata of a recording, and return its task.

    Args:
        about: decoded JSON.
        where: file, for the message.

    Raises:
        InputError: a key is missing or has a wrong type; the message names it.
        ValueError: invalid labels.
    """
    known = about
    if isinstance(about, Mapping):
        known = {name: value for name, value in about.items() if name in _Description.__annotations__}
    check_settings(_Description, known, f"{where}: description", whole=True)
    check_settings(Task, about["task"], f"{where}: task", whole=True)
    return Task(**about["task"] | {"names": tuple(about["task"]["names"])})


def check_rows(about: Mapping[str, Any], rows: int, columns: int, where: str) -> None:
    """Check that a file has the rows that its metadata describe, and that they fit into memory.

    Args:
        about: checked before.
        rows, columns: that the file has.
        where: it is, for the message.

    Raises:
        InputError: more rows than memory allows.
        ValueError: other rows.
    """
    gestures, frames = about["gestures"], about["frames"]
    if gestures * frames != rows:
        raise ValueError(f"it has {rows} rows, not {gestures} touches of {frames} frames: is it cut off?")
    require_memory(16.0 * rows * columns, f"{where}, {rows} rows,", "give a recording of fewer gestures")
