"""Tell which fields of a board's frames are a counter, a clock and sensors."""

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from skin.errors import InputError
from skin.wire.formats import Roles

if TYPE_CHECKING:
    from skin.wire.adapter import Adapter

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_LEADING = 2  # fields before the values that may be a counter and a clock without a name
_AXES = 3  # values of a sensor that measures along x, y, z
_MOSTLY = 0.75  # fraction of the steps, of which one may be a wrap and a few may miss frames
_REGULAR = 0.1, 10.0  # times the median step of a clock
_USUAL = 0.01  # s between two frames: the unit with the nearest steps is taken until the host's clock decides
_CLOCKS = re.compile(r"(?i)t|t.?(s|ms|us|sec|micros|millis)|ms|us|micros|millis|clock|.*time.*|.*stamp.*")
_COUNTERS = re.compile(r"(?i)n|i|seq|count|counter|frame|sample|packet|num|nr|.*(seq|count|frame|sample).*")
_NAMED_UNITS = {
    "us": re.compile(r"(?i).*(micro|[^a-z]us\b|^us$|_us|\(us|µs).*"),
    "ms": re.compile(r"(?i).*(milli|[^a-z]ms\b|^ms$|_ms|\(ms).*"),
    "s": re.compile(r"(?i).*([^a-z]s\b|_s$|\(s\)|sec).*"),
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


def resolve(selected: Sequence[int | str], names: Sequence[str], count: int) -> list[int]:
    """Return the numbers of fields that are given by number or by name, in order.

    Raises:
        InputError: there is no such field.
    """
    places = list[int]()
    for field in selected:
        if isinstance(field, int):
            hits = [field] if 0 <= field < count else []
        else:
            hits = [place for place, name in enumerate(names) if fnmatchcase(name, field)]
        if not hits:
            listed = f"their names are {', '.join(dict.fromkeys(names))}" if names else "they have no names"
            sent = f"the board sends {count} fields, 0 to {count - 1}"
            raise InputError(f"the adapter names a field {field}, {sent}; {listed}")
        places += [place for place in hits if place not in places]
    return places


def find_roles(
    table: np.ndarray, names: Sequence[str], sensors: int | None, adapter: "Adapter"
) -> Columns | int:
    """Return the roles of fields; the number of values seen where it is not that of the sensors.

    Args:
        table: (L, C), fields of consecutive frames; NaN where there was no number.
        names: of the C fields; empty: they have none.
        sensors: S, or None for as many as there are.
        adapter: says what is known.
    """
    count = table.shape[1]
    names = names if len(names) == count else ()
    free = [place for place in range(count) if place not in resolve(adapter.drop, names, count)]
    if adapter.values is not None:
        chosen = resolve(adapter.values, names, count)
    # As many fields as sensors: none is a counter.
    each = 1 if adapter.axes == "plain" else _AXES
    closed = sensors == (len(free) / each if adapter.values is None else -1) and not names
    roles: dict[str, int | None] = {}
    for role, behaves, pattern in (("counter", counts, _COUNTERS), ("time", runs, _CLOCKS)):
        setting = getattr(adapter, role)
        if setting is None or (closed and setting == "auto"):
            roles[role] = None
        elif setting != "auto":
            roles[role] = resolve([setting], names, count)[0]
        else:
            taken = [place for place in free if place not in roles.values()]
            roles[role] = _recognise(table, names, taken, behaves, pattern)
    others = [place for place in free if place not in roles.values()]
    values = others if adapter.values is None else chosen
    if len(values) % each:
        raise InputError(
            f"device.adapter.axes={adapter.axes} takes x, y, z of each place, but {len(values)} values "
            "are left: leave out the others by drop"
        )
    if adapter.axes == "normal":
        values, each = values[_AXES - 1 :: _AXES], 1
    if not values or (sensors is not None and len(values) != sensors * each):
        return len(values) // each
    layout = Roles(
        count, tuple(values), roles["counter"], roles["time"], adapter._numbers, adapter.axes == "magnitude"
    )
    return Columns(layout, *_unit(table, names, roles, adapter))


def counts(column: np.ndarray) -> bool:
    """Return whether a field (L,) numbers the frames."""
    if len(column) < 3 or not np.isfinite(column).all() or (column < 0).any() or (column % 1).any():
        return False
    steps = np.diff(column)
    return bool(np.mean(steps == 1) >= _MOSTLY and np.count_nonzero(steps <= 0) <= 1)


def runs(column: np.ndarray) -> bool:
    """Return whether a field (L,) is a clock."""
    if len(column) < 3 or not np.isfinite(column).all() or (column < 0).any():
        return False
    steps = np.diff(column)
    rising = steps[steps > 0]
    if len(rising) < _MOSTLY * len(steps) or np.count_nonzero(steps < 0) > 1:
        return False
    low, high = (factor * np.median(rising) for factor in _REGULAR)
    return bool(np.mean((rising >= low) & (rising <= high)) >= _MOSTLY)


def _recognise(table: np.ndarray, names: Sequence[str], free: Sequence[int], behaves, pattern) -> int | None:  # type: ignore[no-untyped-def]
    """Return the field that behaves as a counter or a clock: with its name, or before the values."""
    named = [place for place in free if names and pattern.fullmatch(names[place].rpartition(".")[2])]
    leading = [place for place in free if place < _LEADING and (not names or names[place].isdigit())]
    return next((place for place in [*named, *leading] if behaves(table[:, place])), None)


def _unit(
    table: np.ndarray, names: Sequence[str], roles: dict[str, int | None], adapter: "Adapter"
) -> tuple[float | None, str]:
    """Return s per tick of the clock, and what was inferred, in words."""
    words = [f"field {roles['counter']} counts frames"] if roles["counter"] is not None else []
    place = roles["time"]
    if place is None:
        return None, "; ".join(words)
    steps = np.diff(table[:, place])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    name = names[place].rpartition(".")[2] if names else ""
    hinted = [unit for unit, pattern in _NAMED_UNITS.items() if name and pattern.fullmatch(name)]
    unit: str | None = adapter.time_unit
    source = "the adapter"
    if unit is None and hinted:
        unit, source = hinted[0], "its name"
    if unit is None:
        source = f"its steps of {step:.4g}"
        periods = {name: step * scale or _USUAL for name, scale in UNITS.items()}
        unit = min(periods, key=lambda name: abs(np.log10(periods[name] / _USUAL)))
    return UNITS[unit], "; ".join([*words, f"field {place} is the time in {unit}, by {source}"])
