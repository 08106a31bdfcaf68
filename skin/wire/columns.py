"""Tell which fields of a board's frames are a counter, a clock and sensors."""

import re
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import Literal, NamedTuple

import numpy as np

from skin.errors import InputError
from skin.wire.clocks import UNITS
from skin.wire.formats import Roles

Field = int | str
"""A field by its number from 0, or by its name with ``*``."""
_AXES = 3  # values of a sensor that measures along x, y, z
_CLOCKS = re.compile(r"(?i)t|t.?(s|ms|us|sec|micros|millis)|ms|us|micros|millis|clock|.*time.*|.*stamp.*")
_COUNTERS = re.compile(r"(?i)n|i|seq|count|counter|frame|sample|packet|num|nr|.*(seq|count|frame|sample).*")
_NAMED_UNITS = {
    "us": re.compile(r"(?i).*(micro|[^a-z]us\b|^us$|_us|µs).*"),
    "ms": re.compile(r"(?i).*(milli|[^a-z]ms\b|^ms$|_ms).*"),
    "s": re.compile(r"(?i).*([^a-z]s\b|_s$|sec).*"),
}


class Columns(NamedTuple):
    """Roles of fields, and the unit of the clock among them.

    Attributes:
        roles: of the fields.
        unit: s per tick; None: there is no clock.
        summary: what was inferred, in words.
    """

    roles: Roles
    unit: float | None
    summary: str


def last_part(name: str) -> str:
    """Return a name without the names of the objects around it, and without its unit in brackets."""
    return re.sub(r"\s*[\[(].*[\])]$", "", name).rpartition(".")[2]


def resolve(selected: Sequence[Field], names: Sequence[str], count: int) -> list[int]:
    """Return the numbers of fields that are given by number or by name, in order.

    Raises:
        InputError: there is no such field.
    """
    positions = list[int]()
    for field in selected:
        if isinstance(field, int):
            hits = [field] if 0 <= field < count else []
        else:
            hits = [
                position for position, name in enumerate(names) if name == field or fnmatchcase(name, field)
            ]
        if not hits:
            listed = f"their names are {', '.join(dict.fromkeys(names))}" if names else "they have no names"
            sent = f"the board sends {count} fields, 0 to {count - 1}"
            raise InputError(f"the adapter names a field {field}, {sent}; {listed}")
        positions += [position for position in hits if position not in positions]
    return positions


def find_roles(
    table: np.ndarray,
    names: Sequence[str],
    sensors: int | None,
    *,
    drop: Sequence[Field] = (),
    values: Sequence[Field] | None = None,
    counter: Field | None = "auto",
    time: Field | None = "auto",
    axes: Literal["plain", "normal", "magnitude"] = "plain",
    time_unit: str | None = None,
    invalid: frozenset[float] = frozenset(),
) -> Columns | int:
    """Return the roles of fields; the number of values seen where it is not that of the sensors.

    Args:
        table: (L, C), fields of consecutive frames; NaN where there was no number.
        names: of the C fields; empty: they have none.
        sensors: S, or None for as many as there are.
        drop, values, counter, time, axes, time_unit: of :class:`skin.wire.adapter.Adapter`.
        invalid: numbers that mean no value.
    """
    count = table.shape[1]
    names = names if len(names) == count else ()
    free = [position for position in range(count) if position not in resolve(drop, names, count)]
    if values is not None:
        chosen = resolve(values, names, count)
    # As many fields as sensors: none is a counter.
    each = 1 if axes == "plain" else _AXES
    closed = sensors == (len(free) / each if values is None else -1) and not names
    roles: dict[str, int | None] = {}
    for role, setting, behaves, pattern in (
        ("counter", counter, counts, _COUNTERS),
        ("time", time, runs, _CLOCKS),
    ):
        if setting is None or (closed and setting == "auto"):
            roles[role] = None
        elif setting != "auto":
            roles[role] = resolve([setting], names, count)[0]
        else:
            taken = [position for position in free if position not in roles.values()]
            roles[role] = _recognise(table, names, taken, behaves, pattern)
    others = [position for position in free if position not in roles.values()]
    picked = others if values is None else chosen
    if len(picked) % each:
        raise InputError(
            f"device.adapter.axes={axes} takes x, y, z of each place, but {len(picked)} values "
            "are left: leave out the others by drop"
        )
    if axes == "normal":
        picked, each = picked[_AXES - 1 :: _AXES], 1
    if not picked or (sensors is not None and len(picked) != sensors * each):
        return len(picked) // each
    layout = Roles(count, tuple(picked), roles["counter"], roles["time"], invalid, axes == "magnitude")
    return Columns(layout, *_unit(table, names, roles, time_unit))


def counts(column: np.ndarray, mostly: float = 0.75, wraps: bool = False) -> bool:
    """Return whether a field (L,) numbers the frames.

    Args:
        column: the field.
        mostly: part of the steps that must be one; a few frames may be missing.
        wraps: whether it may begin again often, at 0 or 1, as one of three bits or more.
    """
    if len(column) < 3 or not np.isfinite(column).all() or (column < 0).any() or (column % 1).any():
        return False
    steps = np.diff(column)
    if wraps and column.min() in (0, 1) and column.max() >= 7:
        steps = steps % (column.max() - column.min() + 1)
    return bool(np.mean(steps == 1) >= mostly and np.count_nonzero(steps <= 0) <= 1)


def runs(column: np.ndarray, mostly: float = 0.75, regular: float = 10.0) -> bool:
    """Return whether a field (L,) is a clock.

    Args:
        column: the field.
        mostly: part of the steps that must be upwards, of which one may be a wrap.
        regular: times the median step that most steps may be larger or smaller.
    """
    if len(column) < 3 or not np.isfinite(column).all() or (column < 0).any():
        return False
    steps = np.diff(column)
    rising = steps[steps > 0]
    if len(rising) < mostly * len(steps) or np.count_nonzero(steps < 0) > 1:
        return False
    middle = np.median(rising)
    return bool(np.mean((rising >= middle / regular) & (rising <= middle * regular)) >= mostly)


def cycles(column: np.ndarray, maximum: int = 64) -> bool:
    """Return whether a field (L,) numbers rows: from 0 or 1 to at most ``maximum``, again and again."""
    first, last, steps = column.min(), column.max(), np.diff(column)
    numbers = first in (0, 1) and first < last < maximum and not (column % 1).any()
    return bool(numbers and np.mean((steps == 1) | (steps == first - last)) > 0.9)


def _recognise(
    table: np.ndarray,
    names: Sequence[str],
    free: Sequence[int],
    behaves: Callable[[np.ndarray], bool],
    pattern: re.Pattern[str],
    leading: int = 2,
) -> int | None:
    """Return the field that behaves as a counter or a clock: by its name, or one of the ``leading``."""
    named = [position for position in free if names and pattern.fullmatch(last_part(names[position]))]
    first = [position for position in free if position < leading and (not names or names[position].isdigit())]
    return next((position for position in [*named, *first] if behaves(table[:, position])), None)


def _unit(
    table: np.ndarray,
    names: Sequence[str],
    roles: dict[str, int | None],
    unit: str | None,
    usual: float = 0.01,
) -> tuple[float | None, str]:
    """Return s per tick of the clock, and what was inferred, in words.

    Without a name, the unit is taken whose steps are nearest to ``usual`` s, until the host's clock tells.
    """
    words = [f"field {roles['counter']} counts frames"] if roles["counter"] is not None else []
    position = roles["time"]
    if position is None:
        return None, "; ".join(words)
    steps = np.diff(table[:, position])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    name, source = names[position].rpartition(".")[2] if names else "", "the adapter"
    if unit is None:
        unit, source = (
            next((unit for unit in _NAMED_UNITS if _NAMED_UNITS[unit].fullmatch(name)), None),
            "its name",
        )
    if unit is None:
        source = f"its steps of {step:.4g}"
        unit = min(UNITS, key=lambda unit: abs(np.log10((step * UNITS[unit] or usual) / usual)))
    return UNITS[unit], "; ".join([*words, f"field {position} is the time in {unit}, by {source}"])
