"""The schema of recordings, and checks of their JSON metadata before memory is allocated for the rows."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import pyarrow as pa
from annotated_types import Ge, Gt, Le, Lt, MinLen

from skin.body._memory import require_memory
from skin.labels import Task
from skin.recording import Recording
from skin.settings import ONCE, check_settings

FORMAT = 1
UNITS = {"reading": "N", "force": "N", "D_s": "m", "D_t": "m", "positions": "m", "size": "m", "rate": "Hz"}

_Count = Annotated[int, Ge(1), Le(2**31 - 1)]  # rows, gestures and frames are numbered in 32 bits
_Extent = Annotated[float, Gt(0), Lt(1e9)]


@dataclass(frozen=True)
class _Description:
    """Required keys, which older recordings have too, and ``first``."""

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
    first: Annotated[int, Ge(0), Le(2**31 - 1)] = 0  # older recordings do not say


def check_metadata(about: Any, where: str) -> Task:
    """Check the metadata of a recording, and return its task.

    Args:
        about: decoded JSON.
        where: file, for the message.

    Raises:
        InputError: a key is missing or has a wrong type; the message names it.
        ValueError: invalid labels.
    """
    fields = about
    if isinstance(about, Mapping):
        if unknown := set(about) - set(_Description.__annotations__) - {"format", "saturated", "sha256"}:
            raise ValueError(f"its description has unknown entries: {', '.join(sorted(unknown))}")
        fields = {name: value for name, value in about.items() if name in _Description.__annotations__}
    check_settings(_Description, fields, f"{where}: description", whole=True)
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


def describe_recording(recording: Recording, first: int = 0) -> dict[str, Any]:
    """Return everything that a file contains beside its rows; ``first`` is the number of the first touch."""
    touches = recording.touches
    return {
        "format": FORMAT,
        "units": UNITS,
        "gestures": len(touches),
        "first": first,
        "frames": touches.readings.shape[1],
        "rate": touches.rate,
        "positions": touches.positions.tolist(),
        "footprint": list(recording.footprint),
        "size": list(recording.size),
        "task": asdict(recording.task),
        "labelled": touches.labels is not None,
        "force": recording.force is not None,
        "displacement": recording.displacement is not None,
        "saturated": touches.saturated is not None,
        "parameters": list(recording.parameters),
        "metadata": recording.metadata,
    }


def numbered(name: str, count: int) -> list[str]:
    """Return the columns of a quantity with one value per sensor."""
    digits = max(2, len(str(count - 1)))
    return [f"{name}_{number:0{digits}d}" for number in range(count)]


def column_types(about: dict[str, Any]) -> dict[str, pa.DataType]:
    """Return the name and type of every column of a description, in order."""
    task, sensors = about["task"], len(about["positions"])
    columns = {"simulation": pa.int32(), "frame": pa.int32()}
    if about["labelled"]:
        cosines = 2 if task.get("direction") else 0  # older recordings do not say
        kinds = [pa.int8()] * (len(task["names"]) - cosines) + [pa.float32()] * cosines
        columns |= dict(zip(task["names"], kinds, strict=True))
    names = numbered("reading", sensors) + ["force"] * about["force"]
    limits = numbered("saturated", sensors) if about.get("saturated") else []  # older recordings do not say
    if about["displacement"]:
        names += numbered("D_s", sensors) + numbered("D_t", sensors)
    names += [f"gesture_{name}" for name in about["parameters"]]
    return columns | dict.fromkeys(names, pa.float32()) | dict.fromkeys(limits, pa.int8())
