"""Adapters: descriptions of what a board sends (``conf/adapters/``), and the formats that follow."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from itertools import groupby
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge

from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.core.settings import check_settings
from skin.errors import InputError
from skin.wire.formats import (
    FrameFormat,
    Roles,
    SensorCountError,
    cycles,
    find_roles,
    fixed_length,
    protocol_roles,
    resolve,
    split_at,
)
from skin.wire.lines import (
    LABEL,
    NumberWords,
    Reader,
    StructField,
    find_json,
    find_row,
    learn_keys,
    read_named,
    read_pattern,
    read_struct,
    read_words,
)
from skin.wire.protocol import INVALID, OVER, SEPARATORS, Line, parse_header, parse_words

_PLAIN = ("protocol", "auto")  # kinds that need no other setting
_RUN = 12  # frames alike that show a format: that noise rises as often by chance is improbable


@dataclass(frozen=True, kw_only=True)
class Adapter:
    """What a board sends, and what it must be told.

    Attributes:
        kind: ``protocol`` (ours, docs/hardware.md), ``text``, ``json`` (one value per line), ``binary``, or
            ``auto``: to be proposed by ``skin listen``.
        separator: text between fields; None: comma, semicolon, tab or blanks.
        decimal: ``.`` or ``,``.
        base: of whole numbers, 10 or 16.
        label: text between the name of a field and its number, such as ``:``.
        pattern: regular expression of a whole line: a named group per field, or a group ``values`` with
            fields between separators; with a group ``value``, of one field, whose name is the group ``name``.
            Without ``value``, a group ``name`` names the line: its position in ``names`` is that of the row.
        names: of the fields, repeated over all of them; of labelled fields and JSON their order.
        ignore: regular expression of lines that are no frames.
        end: text after each frame; None: LF, CRLF, LF CR or CR.
        rows: lines per frame; 0: found in the stream; None: each line is a frame.
        index: field with the number of the row; None: another line, or an empty one, separates frames.
        struct: name -> numpy type of each field of a binary frame, as in ``{time: <u4, force: (16,)<u2}``;
            also integers of three bytes, as in ``>i3``.
        repeat: how often the fields of ``struct`` follow each other; 0: found in the stream.
        head, tail: bytes in hexadecimal at the beginning and the end of each binary frame.
        values: fields that are sensors, by number from 0 or by name with ``*``; None: all others.
        drop: fields to leave out.
        axes: ``plain``: every value is a sensor; ``normal`` or ``magnitude``: three in a row are x, y, z at
            one position, of which z, or the length, is the sensor.
        counter, time: fields that number the frames and hold the clock; ``auto``: recognised; None: none.
        time_unit: ``s``, ``ms`` or ``us``; None: found in the stream.
        modulus: number at which the counter begins again; None: found in the stream.
        invalid: words and numbers that mean that there is no value, beside those of our protocol.
        over: words for a value beyond the range of the converter, beside those of meters, such as ``OL``.
        limit: value that ``over`` stands for; None: the largest count, if the header gives bits.
        start: text sent until the first frame arrives.
        poll: text sent for each frame.
        stop: text sent at the end.
    """

    kind: Literal["protocol", "text", "json", "binary", "auto"] = "protocol"
    separator: str | None = None
    decimal: Literal[".", ","] = "."
    base: Literal[10, 16] = 10
    label: str | None = None
    pattern: str | None = None
    names: Sequence[str] = ()
    ignore: str | None = None
    end: str | None = None
    rows: Annotated[int, Ge(0)] | None = None
    index: int | str | None = None
    struct: Mapping[str, str] | None = None
    repeat: Annotated[int, Ge(0)] = 1
    head: str = ""
    tail: str = ""
    values: Sequence[int | str] | None = None
    drop: Sequence[int | str] = ()
    axes: Literal["plain", "normal", "magnitude"] = "plain"
    counter: int | str | None = "auto"
    time: int | str | None = "auto"
    time_unit: Literal["s", "ms", "us"] | None = None
    modulus: Annotated[int, Ge(2)] | None = None
    invalid: Sequence[int | float | str] = ()
    over: Sequence[str] = ()
    limit: float | None = None
    start: str | None = None
    poll: str | None = None
    stop: str | None = None

    def __post_init__(self) -> None:
        check_settings(Adapter, {name: getattr(self, name) for name in self._changed}, "device.adapter")
        groups = {}
        for name in ("pattern", "ignore"):
            text = getattr(self, name)
            try:
                groups[name] = re.compile(text or "").groupindex
            except re.error as error:
                raise InputError(
                    f"device.adapter.{name}={text} is not a regular expression: {error}"
                ) from error
        binary = self.kind == "binary"
        size = sum(field.size for field in self._fields) if self.struct else 1
        empty = [name for name in ("start", "poll", "separator", "label", "end") if getattr(self, name) == ""]
        for wrong, message in (
            (
                self.pattern and not groups["pattern"],
                ".pattern needs a named group per field, as in (?P<values>.*)",
            ),
            (self.decimal == self.separator, ": the decimal sign cannot separate fields, too: set separator"),
            (empty, f".{' and '.join(empty)} is empty: leave it out"),
            (binary and not self.struct, ": binary frames need a struct, as in struct: {force: (16,)<u2}"),
            (
                binary and not self._mark(self.head) + self._mark(self.tail),
                ": binary frames need a head or a tail, as in head: aa 55",
            ),
            (not 0 < size * max(1, self.repeat) <= 2**15, f".struct has {size} bytes: at most 32768"),
        ):
            if wrong:
                raise InputError(f"device.adapter{message}")

    @cached_property
    def _changed(self) -> list[str]:
        return [entry.name for entry in fields(self) if getattr(self, entry.name) != entry.default]

    @cached_property
    def _fields(self) -> list[StructField]:
        """The fields of a binary frame."""
        table = list[StructField]()
        for name, kind in (self.struct or {}).items():
            try:
                described = np.dtype(re.sub(r"([iu])3$", r"\g<1>4", kind))
            except (TypeError, ValueError, SyntaxError) as error:
                raise InputError(f"device.adapter.struct={dict(self.struct or {})}: {error}") from error
            if described.base.kind not in "iuf":
                raise InputError("device.adapter.struct holds numbers alone, as in <u2, i1 or (16,)<f4")
            code = described.base.str[:2] + ("3" if kind[-1] == "3" else str(described.base.itemsize))
            table.append(StructField(name, code, int(np.prod(described.shape, dtype=int))))
        return table

    def _mark(self, text: str) -> bytes:
        try:
            return bytes.fromhex(text)
        except ValueError as error:
            raise InputError(f"device.adapter: {text} are not bytes in hexadecimal, as in aa 55") from error

    @cached_property
    def _words(self) -> NumberWords:
        """How words become numbers."""
        over, invalid = (
            {str(word).lower().encode() for word in words} for words in (self.over, self.invalid)
        )
        return NumberWords(self.decimal, self.base, (INVALID | invalid) - over, OVER - invalid | over)

    @cached_property
    def _numbers(self) -> frozenset[float]:
        """Numbers that mean no value."""
        words = [str(word).encode() for word in self.invalid]
        return frozenset(filter(isfinite, parse_words(words, invalid=()).fields))

    def describe(self) -> str:
        """Return the settings that differ from their defaults, as YAML."""
        import yaml

        settings = ((name, getattr(self, name)) for name in dict.fromkeys(["kind", *self._changed]))
        dump = partial(yaml.safe_dump, sort_keys=False, default_flow_style=True, width=10_000)
        return "\n".join(
            dump({name: list(value) if isinstance(value, tuple) else value})[1:-2] for name, value in settings
        )

    def may_end(self, data: bytes) -> bool:
        """Return whether a frame may end in ``data``."""
        return self.kind == "binary" or self._delimiter(data) in data

    def _delimiter(self, data: bytes) -> bytes:
        return self.end.encode() if self.end else b"\n" if b"\n" in data or self.kind == "protocol" else b"\r"

    @np.errstate(over="ignore", invalid="ignore")  # numbers of a faulty wire
    def detect(self, data: bytes, sensors: int | None) -> FrameFormat | int | None:
        """Return the format of the first bytes of a connection.

        Args:
            data: from the first byte on; an incomplete piece at the end is ignored.
            sensors: S, or None to detect it.

        Returns:
            the format; a number: values of readable frames, not those of the layout; None: not known yet.
        """
        protocol, seen = self.kind == "protocol", None
        for layout in self.layouts(data):
            # Without a checksum, the first line may be half of one.
            pieces = layout.split(data)[0][layout.frame is None and not protocol :]
            rows = self.rows is not None or self.index is not None
            detected = (self._detect_rows if rows else self._detect_run)(layout, pieces, sensors)
            if isinstance(detected, FrameFormat):
                return detected
            seen = seen if detected is None else detected
        return seen

    def layouts(self, data: bytes) -> Iterator[FrameFormat]:
        """Yield how data may be cut and read; what the adapter leaves open follows from them."""
        if self.kind == "binary":
            yield from self._binary_layouts(data)
            return
        plain = self.kind == "protocol"
        ignore = None if self.ignore is None else re.compile(self.ignore.encode())
        lines = [line for line in self._lines(data) if not (ignore and ignore.fullmatch(line))]
        cut, name = partial(split_at, self._delimiter(data)), "text" if plain else self.kind
        yield FrameFormat(cut, *self._reader(lines), name, ignore, plain=plain)

    def _binary_layouts(self, data: bytes, maximum_repeats: int = 256) -> Iterator[FrameFormat]:
        head, tail = self._mark(self.head), self._mark(self.tail)
        repeats = [self.repeat] if self.repeat else range(1, maximum_repeats)
        names = [field.name for field in self._fields for _ in range(field.numbers)]
        for repeat in repeats if data.count(head or tail) >= _RUN else ():
            size = repeat * sum(field.size for field in self._fields)
            pattern = re.escape(head) + b".{%d}" % size + re.escape(tail)
            if re.search(b"(?:" + pattern + b"){%d}" % _RUN, data, re.DOTALL):
                follow = b"" if tail else head
                split = fixed_length(len(head) + size + len(tail), pattern, re.escape(follow), len(follow))
                reader = partial(read_struct, self._fields, repeat, len(head))
                yield FrameFormat(split, reader, names, "binary", frame=re.compile(pattern, re.DOTALL))

    def _reader(self, lines: Sequence[bytes]) -> tuple[Reader, Sequence[str]]:
        """Return what reads the fields of lines like these, and their names."""
        numbers, keys = self._words, tuple(self.names)
        if self.kind == "json":
            keys = keys or learn_keys(find_json, lines)
            return partial(read_named, numbers, find_json, keys), keys
        marks = [self.separator.encode()] if self.separator and self.separator.strip() else []
        if self.separator is None:
            marks = [mark for mark in SEPARATORS if mark.decode() != self.decimal]
        text = self.pattern or (self.label and LABEL % re.escape(self.label))
        if text is None:
            bodies = [line.rpartition(b"*")[0 if b"*" in line else 2].rstrip(b" \r") for line in lines]
            trailing = 2 * sum(body.endswith(tuple(marks)) for body in bodies) > len(bodies)
            return partial(read_words, numbers, marks, trailing), keys
        pattern = re.compile(text.encode())
        groups = list(pattern.groupindex)
        if "value" not in groups:
            rows = {name.encode(): b"%d" % row for row, name in enumerate(keys if "name" in groups else ())}
            titles = ["values.*" if name == "values" else name for name in groups]
            return partial(read_pattern, numbers, pattern, marks, rows), titles
        find, named = partial(find_row, pattern), "name" in groups
        keys = keys or (learn_keys(find, lines) if named and self.rows is None else ())
        return partial(read_named, numbers, find, keys if named else ()), keys

    def _lines(self, data: bytes) -> list[bytes]:
        """Return the complete lines with fields; the first may be half of one."""
        lines = [line.strip(b"\r\n") for line in data.split(self._delimiter(data))[:-1]][1:]
        return [line for line in lines if line and not line.startswith(b"#")]

    def _roles(
        self, rows: Sequence[Line], layout: FrameFormat, sensors: int | None, *index: int
    ) -> Roles | int | None:
        """Return the roles of the fields of lines; None: a word stands in a field that is not dropped."""
        names = layout.names(len(rows[0].fields))
        dropped = [*resolve(self.drop, names, len(rows[0].fields)), *index]
        if any(position not in dropped for row in rows for position in row.strange):
            return None
        return find_roles(
            np.array([row.fields for row in rows]),
            names,
            sensors,
            drop=dropped,
            values=self.values,
            counter=self.counter,
            time=self.time,
            axes=self.axes,
            time_unit=self.time_unit,
            invalid=self._numbers,
        )

    def _detect_run(
        self, layout: FrameFormat, pieces: Sequence[bytes], sensors: int | None
    ) -> FrameFormat | int | None:
        header, count_seen, run = None, None, list[Line]()
        for piece in pieces:
            read = _numeric(layout, piece)
            if isinstance(read, bytes) and (read or not layout.plain):
                header = parse_header(read) or header
                continue
            if not isinstance(read, Line):
                run = []
                continue
            if run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check):
                run = []
            run, found = [*run[1 - _RUN :], read], None
            if layout.plain:
                found = protocol_roles(run[-8:], sensors, header and header.n)
            elif len(run) == _RUN:
                found = self._roles(run, layout, sensors)
            if isinstance(found, Roles):
                return replace(layout, roles=found, check=read.check)
            count_seen = count_seen if found is None else found
        return count_seen

    def _detect_rows(
        self, layout: FrameFormat, pieces: Sequence[bytes], sensors: int | None
    ) -> FrameFormat | int | None:
        reads = [read if isinstance(read := _numeric(layout, piece), Line) else None for piece in pieces]
        width = Counter(len(read.fields) for read in reads if read).most_common(1)
        rows = [read if read and len(read.fields) == width[0][0] else None for read in reads]
        numbered, first = [row for row in rows if row], 0.0
        index = self._find_index(numbered, layout) if numbered else None
        if index is not None:
            numbers = [row.fields[index] for row in numbered if abs(row.fields[index]) < 2**53] or [0.0]
            first, count = min(numbers), int(max(numbers) - min(numbers)) + 1
            starts = [row for row in numbered if row.fields[index] == first]
        else:
            blocks = [[row for row in block if row] for filled, block in groupby(rows, bool) if filled][1:-1]
            count = Counter(map(len, blocks)).most_common(1)[0][0] if blocks else 0
            starts = [block[0] for block in blocks if len(block) == count]
        if len(starts) < _RUN or self.rows not in (None, 0, count):
            return None
        roles = self._roles(starts, layout, None, *([] if index is None else [index]))
        if not isinstance(roles, Roles):
            return roles
        detected = replace(layout, name="rows", roles=roles, rows=count, index=index, first=first)
        return detected if sensors in (None, detected.sensors) else detected.sensors

    def _find_index(self, rows: Sequence[Line], layout: FrameFormat) -> int | None:
        """Return the field that numbers the rows; None if there is none."""
        table = np.array([row.fields for row in rows])
        names = layout.names(table.shape[1])
        if self.index is not None or ("name" in names and self.names):
            return resolve(["name" if self.index is None else self.index], names, table.shape[1])[0]
        leading = range(min(2, table.shape[1] - 1))
        return next((column for column in leading if cycles(table[:, column])), None)

    def explain(self, data: bytes, count_seen: int | None, sensors: int | None) -> InputError:
        """Return the error for data in which no frame was found."""
        if count_seen is not None and sensors is not None:
            return SensorCountError(count_seen, sensors)
        hint, start = "skin listen adapter=auto proposes an adapter", data[:64]
        sample = repr(start.decode("ascii", "replace")) if is_text(start) else start.hex(" ")
        missing = f"no frame in {len(data)} bytes, which begin with {sample}"
        if self.kind == "protocol":
            return InputError(
                f"{missing}: is the baud rate right, as in device.baudrate=115200? For another format, {hint}"
            )
        texts = [] if self.kind == "binary" else self._lines(data)[-3:]
        if not texts:
            return InputError(f"the adapter reads {missing}: {hint}")
        layout = next(self.layouts(data))
        shown = "; ".join(
            f"{line[:80].decode('ascii', 'replace')!r} ({_why(layout, line)})" for line in texts
        )
        return InputError(f"the adapter matches no {_RUN} lines in a row: {shown}: {hint}")


def read_adapter(described: str | Mapping[str, Any] | Adapter) -> Adapter:
    """Return an adapter.

    Args:
        described: ``protocol``, ``auto``, one of ``conf/adapters/``, the path of a YAML file, or settings.

    Raises:
        InputError: there is no such adapter, or a setting is wrong.
    """
    if isinstance(described, Adapter):
        return described
    if described in _PLAIN:
        described = {"kind": described}
    if isinstance(described, str):
        shipped = {path.stem: path for path in sorted((CONF / "adapters").glob("*.yaml"))}
        path = shipped.get(described, Path(described))
        try:
            described = load_yaml(path)
        except (OSError, ValueError) as error:
            if path.suffix in (".yaml", ".yml"):
                raise InputError(f"device.adapter={path} cannot be read: {error}") from error
            raise InputError(
                f"there is no device.adapter={described}: there are {', '.join((*_PLAIN, *shipped))}, or "
                "give a file, as in device.adapter=board.yaml, which skin listen adapter=auto proposes"
            ) from error
    settings: dict[str, Any] = described  # type: ignore[assignment]
    check_settings(Adapter, settings, "device.adapter", whole=True)
    plain: Any = {
        name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()
    }
    return Adapter(**plain)


def is_text(data: bytes) -> bool:
    """Return whether nearly all bytes are printable."""
    return sum(byte in b"\r\n\t\0\x1b" or 32 <= byte < 127 for byte in data) > 0.95 * len(data)


def _numeric(layout: FrameFormat, piece: bytes) -> Line | bytes | None:
    """Return the fields of a piece with any number, of our protocol with most; or a line that is none."""
    read = layout.try_fields(piece)
    if not isinstance(read, Line):
        return read
    count = np.count_nonzero(np.isfinite(read.fields))
    return read if (2 * count > len(read.fields) and not read.strange if layout.plain else count) else None


def _why(layout: FrameFormat, line: bytes) -> str:
    """Return why a line is no frame."""
    read = layout.try_fields(line)
    if not isinstance(read, Line):
        return "its shape is another" if read is None else "ignored"
    word = next(iter(read.strange.values()), b"").decode("ascii", "replace")
    return f"field {word!r} is not a number" if word else f"{len(read.fields)} fields"
