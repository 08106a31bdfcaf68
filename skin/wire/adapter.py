"""Adapters: descriptions of what a board sends (``conf/adapter/``), and the formats that follow from them."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge
from numpy.lib.recfunctions import structured_to_unstructured

from skin.core.files import CONF
from skin.core.safe_loading import load_yaml
from skin.core.settings import check_settings
from skin.device.resampling import FrameError
from skin.errors import InputError
from skin.wire.columns import Columns, find_roles, resolve
from skin.wire.formats import (
    DetectedFormat,
    FixedFormat,
    FrameFormat,
    RowsFormat,
    SensorCountError,
    TextFormat,
    detect_format,
    detection_error,
)
from skin.wire.lines import (
    JsonReader,
    LabelReader,
    LineReader,
    NumberReader,
    PatternReader,
    SeparatedReader,
)
from skin.wire.protocol import INVALID, Format, Header, Line, parse_header

_RUN = 12  # frames alike that show a format: noise hardly rises as often by accident
_MOST_REPEATS = 256
_NUMBER = rb"[-+.\d ]"


@dataclass(frozen=True, kw_only=True)
class Adapter:
    """Format of what a board sends, and texts to send to it.

    Attributes:
        kind: ``protocol`` (ours, docs/hardware.md), ``text``, ``json`` (one value per line), ``binary``, or
            ``auto``: to be proposed by ``skin listen``.
        format: of our protocol: ``auto``, ``text`` or ``binary``.
        separator: text between fields; None: comma, semicolon, tab or blanks.
        decimal: ``.`` or ``,``.
        label: text between the name of a field and its number, such as ``:``.
        pattern: regular expression of a whole line: a named group per field, or a group ``values`` with
            fields between separators.
        number: regular expression of one number, where nothing separates fields.
        names: of the fields, repeated over all of them.
        end: text after each frame; None: LF, CRLF, LF CR or CR.
        length: bytes of a frame of text that has no end.
        rows: lines per frame; 0: found in the stream; None: each line is a frame.
        index: field with the number of the row; None: another line, or an empty one, separates frames.
        struct: name -> numpy type of each field of a binary frame, as in ``{time: <u4, force: (16,)<u2}``.
        repeat: how often the fields of ``struct`` follow each other; 0: found in the stream.
        head, tail: bytes in hexadecimal at the beginning and the end of each binary frame.
        values: fields that are sensors, by number from 0 or by name with ``*``; None: all others.
        drop: fields to leave out.
        axes: ``plain``: every value is a sensor; ``normal`` or ``magnitude``: three in a row are x, y, z at
            one place, of which z, or the length, is the sensor.
        counter, time: fields that number the frames and hold the clock; ``auto``: recognised; None: none.
        time_unit: ``s``, ``ms`` or ``us``; None: found in the stream.
        modulus: number at which the counter begins again; None: found in the stream.
        invalid: words and numbers that mean that there is no value, beside those of our protocol.
        start: text sent until the first frame arrives.
        poll: text sent for each frame.
        stop: text sent at the end.
    """

    kind: Literal["protocol", "text", "json", "binary", "auto"] = "protocol"
    format: Format = "auto"
    separator: str | None = None
    decimal: Literal[".", ","] = "."
    label: str | None = None
    pattern: str | None = None
    number: str | None = None
    names: Sequence[str] = ()
    end: str | None = None
    length: Annotated[int, Ge(1)] | None = None
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
    start: str | None = None
    poll: str | None = None
    stop: str | None = None

    def __post_init__(self) -> None:
        settings = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        changed = {entry.name for entry in fields(self) if settings[entry.name] != entry.default}
        check_settings(Adapter, {name: settings[name] for name in changed}, "device.adapter")
        for name in ("pattern", "number"):
            try:
                re.compile(settings[name] or "")
            except re.error as error:
                raise InputError(
                    f"device.adapter.{name}={settings[name]} is not a regular expression: {error}"
                ) from error
        if self.pattern and not re.compile(self.pattern).groupindex:
            raise InputError("device.adapter.pattern needs a named group per field, as in (?P<values>.*)")
        if self.decimal == "," and self.separator == ",":
            raise InputError("device.adapter: the decimal sign cannot separate fields, too: set separator")
        for name in ("start", "poll", "separator", "label", "end"):
            if settings[name] == "" and name != "end":
                raise InputError(f"device.adapter.{name} is empty: leave it out")
        if self.kind == "text" and self.end == "" and not self.length:
            raise InputError("device.adapter: text without an end needs its length, as in length: 11")
        if self.kind == "binary":
            self._check_struct()

    def _check_struct(self) -> None:
        if not self.struct:
            raise InputError("device.adapter: binary frames need a struct, as in struct: {force: (16,)<u2}")
        if not self._mark(self.head) + self._mark(self.tail):
            raise InputError("device.adapter: binary frames need a head or a tail, as in head: aa 55")
        if self._record.itemsize * max(1, self.repeat) > 2**15 or not self._record.itemsize:
            raise InputError(f"device.adapter.struct has {self._record.itemsize} bytes: at most 32768")

    @cached_property
    def _record(self) -> np.dtype:
        try:
            record = np.dtype([(name, kind) for name, kind in (self.struct or {}).items()])
        except (TypeError, ValueError, SyntaxError) as error:
            raise InputError(f"device.adapter.struct={dict(self.struct or {})}: {error}") from error
        kinds = {record[name].base.kind for name in record.names or ()}
        if not kinds <= set("iuf"):
            raise InputError("device.adapter.struct holds numbers alone, as in <u2, i1 or (16,)<f4")
        return record

    def _mark(self, text: str) -> bytes:
        try:
            return bytes.fromhex(text)
        except ValueError as error:
            raise InputError(f"device.adapter: {text} are not bytes in hexadecimal, as in aa 55") from error

    @cached_property
    def _words(self) -> frozenset[bytes]:
        return INVALID | {str(word).lower().encode() for word in self.invalid}

    @cached_property
    def _numbers(self) -> frozenset[float]:
        numbers = set()
        for word in self.invalid:
            try:
                numbers.add(float(word))
            except ValueError:
                continue
        return frozenset(numbers)

    def describe(self) -> str:
        """Return the settings that differ from their defaults, as YAML."""
        import yaml

        settings = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        changed = [entry.name for entry in fields(self) if settings[entry.name] != entry.default]
        lines = []
        for name in dict.fromkeys(["kind", *changed]):
            value = list(settings[name]) if isinstance(settings[name], tuple) else settings[name]
            text = yaml.safe_dump(value, sort_keys=False, default_flow_style=True, width=10_000)
            lines.append(f"{name}: {text.replace('...', '').strip()}")
        return "\n".join(lines)

    def may_end(self, data: bytes) -> bool:
        """Return whether a frame may end in ``data``."""
        if self.kind == "protocol":
            return b"\n" in data or b"\0" in data
        return self.kind == "binary" or self.length is not None or self._delimiter(data) in data

    def _delimiter(self, data: bytes) -> bytes:
        return self.end.encode() if self.end else b"\n" if b"\n" in data else b"\r"

    def detect(self, data: bytes, sensors: int | None) -> DetectedFormat:
        """Return the format of the first bytes of a connection.

        Args:
            data: from the first byte on; an incomplete piece at the end is ignored.
            sensors: S, or None to detect it.
        """
        if self.kind == "protocol":
            return detect_format(data, sensors, self.format)
        if self.kind == "binary":
            return self._detect_struct(data, sensors)
        if self.length is not None:
            return self._detect_endless(data, sensors, self.length)
        if self.rows is not None or self.index is not None:
            return self._detect_rows(data, sensors)
        return self._detect_lines(data, sensors)

    def _reader(self, lines: Sequence[bytes]) -> LineReader:
        """Return what reads the fields of lines like these; what it leaves open follows from them."""
        if self.kind == "json":
            return JsonReader.learn(lines, self._words)
        split = SeparatedReader.learn(lines, self.separator, self.decimal, self._words, self.names)
        if self.pattern is not None:
            return PatternReader.learn(lines, self.pattern, self.separator, split)
        if self.label is not None:
            return LabelReader.learn(lines, self.label, split)
        return split if self.number is None else NumberReader(self.number, split)

    def _lines(self, data: bytes) -> list[bytes]:
        """Return the complete lines; the first may be half of one."""
        return [line.strip(b"\r\n") for line in data.split(self._delimiter(data))[:-1]][1:]

    def _detected(
        self, layout: FrameFormat, columns: Columns, header: Header | None = None
    ) -> DetectedFormat:
        """Return a format with what its columns show of the clock."""
        return DetectedFormat(layout, None, header, columns.unit, self.time_unit is not None, columns.summary)

    def _detect_lines(self, data: bytes, sensors: int | None) -> DetectedFormat:
        lines, header, count_seen = self._lines(data), None, None
        for line in lines:
            header = parse_header(line) or header if line.startswith(b"#") else header
        lines = [line for line in lines if line and not line.startswith(b"#")]
        reader, run = self._reader(lines), list[Line]()
        for line in lines:
            read = _try(reader, line)
            if read is None or (
                run and (len(run[-1].fields), run[-1].check) != (len(read.fields), read.check)
            ):
                run = []
            if read is None:
                continue
            run = [*run[1 - _RUN :], read]
            if len(run) < _RUN:
                continue
            table = np.array([row.fields for row in run])
            columns = find_roles(table, reader.names(table.shape[1]), sensors, self)
            if isinstance(columns, int):
                count_seen = columns
                continue
            layout = TextFormat(
                columns.roles,
                read.check,
                reader.trailing,
                reader,
                self._delimiter(data),
                reader.padded,
                self.kind,
            )
            return self._detected(layout, columns, header)
        return DetectedFormat(count_seen=count_seen, header=header)

    def _detect_rows(self, data: bytes, sensors: int | None) -> DetectedFormat:
        lines = self._lines(data)
        reader = self._reader([line for line in lines if line and not line.startswith(b"#")])
        reads = [None if line.startswith(b"#") or not line else _try(reader, line) for line in lines]
        counts = Counter(len(read.fields) for read in reads if read)
        if not counts:
            return DetectedFormat()
        width = counts.most_common(1)[0][0]
        reads = [read if read and len(read.fields) == width else None for read in reads]
        rows = [read.fields for read in reads if read]
        index, first = _find_index(rows, reader.names(width), self.index), 0
        if index is not None:
            numbers = [row[index] for row in rows]
            first, count = int(min(numbers)), int(max(numbers) - min(numbers)) + 1
            starts = [row for row in rows if row[index] == first]
        else:
            blocks = [list(block) for filled, block in groupby(reads, bool) if filled][1:-1]
            count = Counter(map(len, blocks)).most_common(1)[0][0] if blocks else 0
            starts = [block[0].fields for block in blocks if block[0] and len(block) == count]
        if count < 1 or len(starts) < _RUN or self.rows not in (None, 0, count):
            return DetectedFormat()
        described = replace(self, drop=(*self.drop, *([] if index is None else [index])))
        columns = find_roles(np.array(starts), reader.names(width), None, described)
        if isinstance(columns, int):
            return DetectedFormat(count_seen=columns)
        total = count * columns.roles.sensors
        if sensors not in (None, total):
            return DetectedFormat(count_seen=total)
        line = TextFormat(columns.roles, "none", reader.trailing, reader, self._delimiter(data), False)
        return self._detected(RowsFormat(line, count, index, first), columns)

    def _detect_struct(self, data: bytes, sensors: int | None) -> DetectedFormat:
        head, tail, seen = self._mark(self.head), self._mark(self.tail), None
        if data.count(head or tail) < _RUN:
            return DetectedFormat()
        for repeat in [self.repeat] if self.repeat else range(1, _MOST_REPEATS):
            size = repeat * self._record.itemsize
            length = len(head) + size + len(tail)
            pattern = re.escape(head) + b".{%d}" % size + re.escape(tail)
            match = re.search(b"(?:" + pattern + b"){%d}" % _RUN, data, re.DOTALL)
            if not match:
                continue
            parse = _struct_parser(self._record, repeat, len(head))
            cut = range(match.start(), match.end(), length)
            table = np.array([parse(data[place : place + length]).fields for place in cut])
            columns = find_roles(table, _struct_names(self._record) * repeat, sensors, self)
            if isinstance(columns, int):
                seen = columns
                continue
            follow = b"" if tail else re.escape(head)
            layout = FixedFormat(
                columns.roles, parse, length, re.compile(pattern, re.DOTALL), follow, 0 if tail else len(head)
            )
            return self._detected(layout, columns)
        return DetectedFormat(count_seen=seen)

    def _detect_endless(self, data: bytes, sensors: int | None, length: int) -> DetectedFormat:
        split = SeparatedReader.learn([data], self.separator, self.decimal, self._words, self.names)
        separator = split.separator or b" "
        count = data[:length].count(separator) + 1
        width, odd = divmod(length - (count - 1) * len(separator), count)
        if odd or width < 1 or count < 2:
            return DetectedFormat()
        pattern = re.escape(separator).join([_NUMBER + b"{%d}" % width] * count)
        match = re.search(b"(?:" + pattern + b"){%d}" % _RUN, data)
        if not match:
            return DetectedFormat()
        cut = range(match.start(), match.end(), length)
        reads = [_try(split, data[place : place + length]) for place in cut]
        table = np.array([read.fields for read in reads if read])
        columns = find_roles(table, (), sensors, self) if len(table) == _RUN else 0
        if isinstance(columns, int):
            return DetectedFormat(count_seen=columns or None)
        follow = _NUMBER + b"{%d}" % width + re.escape(separator)
        layout = FixedFormat(
            columns.roles, split, length, re.compile(pattern), follow, width + len(separator), "text"
        )
        return self._detected(layout, columns)

    def explain(self, data: bytes, count_seen: int | None, sensors: int | None) -> InputError:
        """Return the error for data in which no frame was found."""
        if self.kind == "protocol":
            return detection_error(data, count_seen, sensors)
        if count_seen is not None and sensors is not None:
            return SensorCountError(count_seen, sensors)
        hint = "skin listen adapter=auto proposes an adapter"
        if self.kind == "binary" or self.length is not None or len(lines := self._lines(data)) < 2:
            return InputError(
                f"the adapter reads no frame in {len(data)} bytes, which begin with {data[:64].hex(' ')}, as "
                f"text {data[:40].decode('ascii', 'replace')!r}: {hint}"
            )
        texts = [line for line in lines if line and not line.startswith(b"#")][-3:]
        reader, reasons = self._reader(texts), list[str]()
        for line in texts:
            try:
                count = len(reader(line).fields)
                reasons.append(f"{count} fields")
            except FrameError as error:
                reasons.append(
                    f"field {error.word!r} is not a number" if error.word else "its shape is another"
                )
        shown = "; ".join(
            f"{line[:80].decode('ascii', 'replace')!r} ({reason})"
            for line, reason in zip(texts, reasons, strict=True)
        )
        return InputError(f"the adapter matches no {_RUN} lines in a row: {shown}: {hint}")


def read_adapter(described: str | Mapping[str, Any] | Adapter) -> Adapter:
    """Return an adapter.

    Args:
        described: name of one in ``conf/adapter/``, path of a YAML file, or settings.

    Raises:
        InputError: there is no such adapter, or a setting is wrong.
    """
    if isinstance(described, Adapter):
        return described
    if isinstance(described, str):
        shipped = {path.stem: path for path in sorted((CONF / "adapter").glob("*.yaml"))}
        path = shipped.get(described, Path(described))
        try:
            described_settings = load_yaml(path)
        except (OSError, ValueError) as error:
            if path.suffix in (".yaml", ".yml"):
                raise InputError(f"device.adapter={path} cannot be read: {error}") from error
            raise InputError(
                f"there is no device.adapter={described}: there are {', '.join(shipped)}, or give a file, as "
                "in device.adapter=board.yaml, which skin listen adapter=auto proposes"
            ) from error
    else:
        described_settings = described
    check_settings(Adapter, described_settings, "device.adapter", whole=True)
    settings: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in described_settings.items()
    }
    return Adapter(**settings)


def _try(reader: Callable[[bytes], Line], line: bytes) -> Line | None:
    """Return the fields of a line that has any number; else None."""
    try:
        read = reader(line)
    except FrameError:
        return None
    return read if any(np.isfinite(read.fields)) else None


def _find_index(rows: Sequence[Sequence[float]], names: Sequence[str], field: int | str | None) -> int | None:
    """Return the field that numbers the rows; None if there is none."""
    if field is not None:
        return resolve([field], names, len(rows[0]))[0]
    table = np.array(rows)
    for column in range(min(2, table.shape[1] - 1)):
        numbers = table[:, column]
        if not np.isfinite(numbers).all() or (numbers % 1).any():
            continue
        first, last, steps = numbers.min(), numbers.max(), np.diff(numbers)
        if (
            last > first
            and 0 <= first <= 1
            and np.mean((steps == 1) | ((numbers[:-1] == last) & (numbers[1:] == first))) > 0.9
        ):
            return column
    return None


def _struct_names(record: np.dtype) -> list[str]:
    return [name for name in record.names or () for _ in range(int(np.prod(record[name].shape, dtype=int)))]


def _struct_parser(record: np.dtype, repeat: int, offset: int) -> Callable[[bytes], Line]:
    bases = {record[name].base for name in record.names or ()}
    base, count = next(iter(bases)), record.itemsize * repeat
    plain = len(bases) == 1

    def parse(piece: bytes) -> Line:
        if plain:
            row = np.frombuffer(piece, base, count // base.itemsize, offset).astype(np.float64)
        else:
            rows = np.frombuffer(piece, record, repeat, offset)
            row = structured_to_unstructured(rows, np.float64).ravel()
        return Line(row, "none", bool(np.isfinite(row).all()))  # type: ignore[arg-type]

    return parse
