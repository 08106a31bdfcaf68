"""Formats of frames: how bytes are cut into pieces, and what the fields of a piece are."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from math import inf, nan
from typing import Literal

import numpy as np

from skin.device.resampling import Check, FrameError
from skin.errors import InputError
from skin.wire.clocks import UNITS
from skin.wire.lines import Reader, read_named
from skin.wire.protocol import Line, RawFrame


@dataclass(frozen=True)
class Roles:
    """What the fields of a frame are.

    Attributes:
        count: number of fields.
        values: the fields that are sensors.
        counter: the field that numbers the frames; None: none does.
        time: the field with the device's clock; None: none has it.
        invalid: numbers that firmware sends instead of a value.
        magnitude: whether three values in a row are the axes of one sensor, whose value is their length.
        unit: s per tick of the clock, as far as the fields tell; None: they do not.
        summary: what was inferred, in words.
    """

    count: int
    values: tuple[int, ...]
    counter: int | None = None
    time: int | None = None
    invalid: frozenset[float] = frozenset()
    magnitude: bool = False
    unit: float | None = None
    summary: str = ""

    @property
    def sensors(self) -> int:
        """S."""
        return len(self.values) // (3 if self.magnitude else 1)

    @cached_property
    def _take(self) -> slice | list[int]:
        first, last = self.values[0], self.values[-1] + 1
        return slice(first, last) if self.values == tuple(range(first, last)) else list(self.values)

    def frame(self, line: Line) -> RawFrame:
        """Return the frame of a line with ``count`` fields.

        A word, or digits of another base, in place of a value costs only it; anything else may be a line that
        is damaged.

        Raises:
            FrameError: counter or time are no ``number``, or a value is none.
        """
        fields, finite = line.fields, line.finite
        seq = None if self.counter is None else fields[self.counter]
        # Microseconds in 32 bits with a sign fall below 0 after 36 minutes.
        ticks = None if self.time is None else float(fields[self.time] + 2.0**32 * (fields[self.time] < 0))
        if (seq is not None and (not 0 <= seq < inf or seq % 1)) or (
            ticks is not None and not 0 <= ticks < inf
        ):
            raise FrameError("number")
        values = np.array(fields, dtype=np.float64)[self._take]
        if not finite:
            strange = [word for position, word in line.strange.items() if position in self.values]
            words_alone = all(word.isalpha() or not word.strip(b"0123456789abcdefABCDEF") for word in strange)
            if strange and not (words_alone and 2 * np.isfinite(values).sum() > len(values)):
                raise FrameError("number", word=strange[0].decode("ascii", "replace"))
            finite = bool(np.isfinite(values).all())
        if self.invalid and not self.invalid.isdisjoint(values.tolist()):
            values[np.isin(values, list(self.invalid))] = nan
            finite = False
        if self.magnitude:
            values = np.linalg.norm(values.reshape(-1, 3), axis=1)
        return RawFrame(None if seq is None else int(seq), ticks, values, finite)


Split = Callable[[bytes], tuple[list[bytes], bytes]]
"""Returns the complete pieces of bytes, and what is left."""


def split_at(delimiter: bytes, data: bytes) -> tuple[list[bytes], bytes]:
    """Return the pieces between delimiters, and what is left. LF also stands for CRLF and LF CR."""
    *pieces, left = data.split(delimiter)
    return pieces, left


def fixed_length(length: int, pattern: bytes, follow: bytes = b"", margin: int = 0) -> Split:
    """Return a function that cuts frames of a fixed length, which only their own bytes delimit.

    Bytes between them are pieces of their own. What must follow a frame is checked, too, because a lost byte
    would shift its values.

    Args:
        length: bytes of a frame.
        pattern: regular expression of a frame.
        follow: that of what must follow it; empty: nothing.
        margin: bytes that ``follow`` takes.
    """
    step = re.compile(pattern + b"(?=" + follow + b")", re.DOTALL)
    both = re.compile(b"(?=" + pattern * 2 + b")", re.DOTALL)

    def split(data: bytes) -> tuple[list[bytes], bytes]:
        pieces, position = list[bytes](), 0
        while len(data) - position >= length + margin:
            following = None if (fits := step.match(data, position)) else both.search(data, position + 1)
            end = following.start() if following else len(data) - 2 * length + 1
            end = position + length if fits else end
            if end <= position:
                break
            pieces.append(data[position:end])
            position = end
        return pieces, data[position:]

    return split


ANSI = re.compile(rb"\x1b\[[0-9;]*[A-Za-z]|\0")  # colours of a terminal, and the end of a string in C


@dataclass
class FrameFormat:
    """How bytes are cut into pieces, and how the frames that end with them are read.

    A frame is a piece, or several: the rows of a matrix, or an index and its values. It counts only if each
    of its rows arrived, in order.

    Attributes:
        split: cuts bytes into pieces.
        reader: of the fields of a piece.
        titles: names of the fields; ``values.*`` stands for as many as are left. They repeat over all fields.
        name: word for the user.
        ignore: regular expression of the lines that are no frames.
        frame: regular expression of a frame of bytes; None: pieces are lines.
        plain: the frames are those of our protocol, in which no byte is left out.
        roles: of the fields; None: not known yet.
        check: kind of checksum.
        rows: pieces of a frame.
        index: field with the number of the row; None: other lines stand between two frames.
        first: the smallest index.
    """

    split: Split
    reader: Reader
    titles: Sequence[str] = ()
    name: str = "text"
    ignore: re.Pattern[bytes] | None = None
    frame: re.Pattern[bytes] | None = None
    plain: bool = False
    roles: Roles | None = None
    check: Check = "none"
    rows: int = 0
    index: int | None = None
    first: float = 0.0

    def __post_init__(self) -> None:
        self._partial, self._open, self._reported = list[Line](), False, True

    @property
    def sensors(self) -> int:
        """S."""
        return self.roles.sensors * (self.rows or 1) if self.roles else 0

    @property
    def keys(self) -> tuple[str, ...]:
        """Names by which the values of a piece are found; empty: they are in a fixed order."""
        return (
            tuple(self.reader.args[2])
            if isinstance(self.reader, partial) and self.reader.func is read_named
            else ()
        )

    def names(self, count: int) -> Sequence[str]:
        """Return the names of ``count`` fields; empty: they have none."""
        if "values.*" in self.titles:
            inner = [f"values.{number}" for number in range(count - len(self.titles) + 1)]
            return [name for title in self.titles for name in (inner if title == "values.*" else [title])]
        fits = self.titles and count % len(self.titles) == 0
        return list(self.titles) * (count // len(self.titles)) if fits else ()

    def fields(self, piece: bytes) -> Line | bytes:
        """Return the fields of a piece; the line where it is empty, ignored or a comment; else FrameError."""
        if self.frame is None:
            piece = (piece if self.plain else ANSI.sub(b"", piece)).strip(b"\r\n")
            if not piece or piece.startswith(b"#") or (self.ignore and self.ignore.fullmatch(piece)):
                return piece
        elif not self.frame.fullmatch(piece):
            raise FrameError("structure")
        read = self.reader(piece)
        if isinstance(read, bytes) or self.roles is None:
            return read
        if read.check != self.check:
            raise FrameError("checksum")
        if len(read.fields) != self.roles.count:
            raise FrameError("fields", len(read.fields) - self.roles.count + len(self.roles.values))
        return read

    def try_fields(self, piece: bytes) -> Line | bytes | None:
        """Return the fields of a piece, or a line that is no frame; None: it is neither."""
        try:
            return self.fields(piece)
        except FrameError:
            return None

    def read(self, piece: bytes) -> RawFrame | bytes:
        """Return the frame that ends with a piece; the line, or nothing, where none does; else FrameError."""
        if self.rows:
            return self._read_row(self.try_fields(piece))
        read = self.fields(piece)
        return read if isinstance(read, bytes) else self.roles.frame(read)  # type: ignore[union-attr]

    def _read_row(self, row: Line | bytes | None) -> RawFrame | bytes:
        """Return the frame whose last row this is; bytes within a frame; else raise FrameError."""
        if isinstance(row, bytes) and (self.index is not None or row.startswith(b"# skin")):
            return row
        expected = len(self._partial)
        if self.index is not None:
            number = row.fields[self.index] - self.first if isinstance(row, Line) else -1
        else:
            number = (expected if self._open else -1) if isinstance(row, Line) else 0
        fits = number in (0, expected)
        incomplete = number != expected and bool(expected or not self._reported)
        kept = self._partial if number and fits else []
        self._partial = [*kept, row] if fits and isinstance(row, Line) else []
        self._open, self._reported = fits, not fits
        if incomplete:
            raise FrameError("rows")
        if len(self._partial) < self.rows:
            return row if isinstance(row, bytes) else b""
        frames = [self.roles.frame(line) for line in self._partial]  # type: ignore[union-attr]
        self._partial, self._open = [], False
        values = np.concatenate([frame.values for frame in frames])
        return RawFrame(frames[0].seq, frames[0].ticks, values, all(frame.finite for frame in frames))


def protocol_roles(run: Sequence[Line], sensors: int | None, n: int | None) -> Roles | int | None:
    """Return the fields of our protocol: seq and t_us before the values, or the values alone.

    Three lines show one of S sensors; noise may count by chance, so eight are needed where S is unknown.

    Args:
        run: frames alike; the last eight.
        sensors: S, or None to detect it.
        n: number of sensors of the header, or None.

    Returns:
        the roles; None: more lines are needed; a number: that of the values of lines of another number.
    """
    count, expected = len(run[-1].fields), sensors or n
    if len(run) < 3:
        return None
    counted = _count(run[-3:])
    if not (count == expected or (counted and count - 2 == expected)):
        if sensors is not None or len(run) < 8:
            return count - 2 * counted
        expected = count - 2 * _count(run)
    shift = count - (expected or 0)
    return Roles(count, tuple(range(shift, count)), *((0, 1) if shift else ()))


def _count(run: Sequence[Line], missing: int = 1000) -> bool:
    """Return whether the first two fields are a frame number, some of which may be missing, and a time.

    A clock of whole seconds, or one that stands still, is one too: the decoder judges it. Lines across a wrap
    show neither.
    """
    table = np.array([line.fields[:2] for line in run])
    steps, whole = np.diff(table, axis=0), len(run[0].fields) > 2 and not (table[:, 0] % 1).any()
    later = (steps >= (1, 0)).all() and (steps[:, 0] <= missing).all()
    return bool(whole and later and (table >= 0).all() and np.isfinite(table).all())


class SensorCountError(InputError):
    """The device has another number of sensors than the layout.

    Attributes:
        sent: values per frame.
    """

    def __init__(self, sent: int, sensors: int) -> None:
        self.sent = sent
        super().__init__(
            f"the device sends {sent} values per frame, the layout has {sensors} sensors: give its own "
            "layout, as in layout=file layout.path=FILE.csv; or an adapter, if a value is a clock or a "
            "counter: skin listen adapter=auto proposes one"
        )


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
        numbered = names if isinstance(field, str) else range(count)
        hits = [
            position
            for position, name in enumerate(numbered)
            if name == field or (isinstance(name, str) and fnmatchcase(name, str(field)))
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
) -> Roles | int:
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
    left_out = resolve(drop, names, count)
    free = [position for position in range(count) if position not in left_out]
    each = 1 if axes == "plain" else _AXES
    # As many fields as sensors: none is a counter.
    closed = values is None and sensors == len(free) / each and not names
    roles: dict[str, int | None] = {}
    for role, setting, behaves, pattern in (
        ("counter", counter, counts, _COUNTERS),
        ("time", time, runs, _CLOCKS),
    ):
        taken = [position for position in free if position not in roles.values()]
        if setting == "auto":
            roles[role] = None if closed else _recognise(table, names, taken, behaves, pattern)
        else:
            roles[role] = None if setting is None else resolve([setting], names, count)[0]
    others = [position for position in free if position not in roles.values()]
    picked = others if values is None else resolve(values, names, count)
    if len(picked) % each:
        raise InputError(
            f"device.adapter.axes={axes} takes x, y, z of each place, but {len(picked)} values "
            "are left: leave out the others by drop"
        )
    if axes == "normal":
        picked, each = picked[_AXES - 1 :: _AXES], 1
    if not picked or (sensors is not None and len(picked) != sensors * each):
        return len(picked) // each
    found = Roles(count, tuple(picked), roles["counter"], roles["time"], invalid, axes == "magnitude")
    return _with_unit(found, table, names, time_unit)


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


def _with_unit(
    roles: Roles, table: np.ndarray, names: Sequence[str], unit: str | None, usual: float = 0.01
) -> Roles:
    """Return the roles of fields (L, C) with the unit of the clock, and what was inferred, in words.

    Without a name, the unit is taken whose steps are nearest to ``usual`` s, until the host's clock tells.
    """
    words = [f"field {roles.counter} counts frames"] if roles.counter is not None else []
    if roles.time is None:
        return replace(roles, summary="; ".join(words))
    steps = np.diff(table[:, roles.time])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    name, source = names[roles.time].rpartition(".")[2] if names else "", "as the adapter says"
    if unit is None:
        unit, source = next((u for u in _NAMED_UNITS if _NAMED_UNITS[u].fullmatch(name)), None), "by its name"
    if unit is None:
        source = f"as it rises by {step:.4g} per frame"
        unit = min(UNITS, key=lambda unit: abs(np.log10((step * UNITS[unit] or usual) / usual)))
    words.append(f"field {roles.time} is the time in {unit}, {source}")
    return replace(roles, unit=UNITS[unit], summary="; ".join(words))
