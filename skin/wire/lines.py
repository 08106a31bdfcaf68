"""Read the fields of a piece: numbers of a line, named fields by a pattern, JSON, or a struct."""

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from skin.device.resampling import FrameError
from skin.wire.protocol import Line, decode_frame, parse_words, split_words, verify_line

_DAYTIME = re.compile(rb"(?:\d{4}-\d\d-\d\d[T ])?(\d{1,2}):(\d\d):(\d\d(?:\.\d+)?)")
_HEX = re.compile(rb"(?i)(?:0x)?[0-9a-f]+")
# Each blank is matched in one way, or blanks would take a time as the square of their number.
LABEL = (
    r"\s*+(?P<name>[^\s,;\d.+-](?:[^\s,;=:]|[^\S\t]++(?![\s,;=:]))*?)\s*%s"
    r"\s*+(?P<value>[^\s,;]*+)\s*+[,;]?\s*+"
)
"""Pattern of one field with a name, as in ``A0: 12``, for the text between both."""
NUMBER = r"(?P<value>%s)[ \t,;]*+"
"""Pattern of one number, with anything of a separator after it, for that of its digits."""


@dataclass(frozen=True)
class NumberWords:
    """How words become numbers.

    Attributes:
        decimal: the decimal sign.
        thousands: sign between groups of three digits; empty: none.
        base: 10 or 16.
        invalid: words, in lower case, that mean no value.
        over: words, in lower case, for a value beyond the range of the converter.
    """

    decimal: str
    thousands: str
    base: int
    invalid: Collection[bytes]
    over: Collection[bytes]

    def __call__(self, words: Sequence[bytes], check: Any = "none") -> Line:
        """Return the numbers of words; the time of the day in s."""
        if self.base == 16:
            words = [b"%d" % int(word, 16) if _HEX.fullmatch(word.strip()) else word for word in words]
        if self.thousands:
            mark = re.escape(self.thousands).encode()
            words = [
                word.replace(self.thousands.encode(), b"")
                if re.fullmatch(rb"\s*[-+]?\d{1,3}(%s\d{3})+(\D\d*)?\s*" % mark, word)
                else word
                for word in words
            ]
        if self.decimal == ",":
            words = [word.translate(_SWAPPED) if b":" not in word else word for word in words]
        read = parse_words(words, check, self.invalid, self.over)
        if any(b":" in word for word in read.strange.values()):
            return parse_words([*map(_to_seconds, words)], check, self.invalid, self.over)
        return read


_SWAPPED = bytes.maketrans(b".,", b",.")  # a point is no decimal sign then


@dataclass(frozen=True)
class SeparatedReader:
    """Numbers between separators.

    Attributes:
        numbers: how words become numbers.
        marks: separators, of which the first that a line has counts; blanks otherwise.
        titles: of the fields, repeated over all.
        trailing: every line ends with a separator, so no line means an empty field by it.
    """

    numbers: NumberWords
    marks: Sequence[bytes]
    titles: Sequence[str] = ()
    trailing: bool = True

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        body, check = verify_line(line) if b"*" in line else (line, "none")
        return self.numbers(split_words(body, self.marks, self.trailing), check)

    def names(self, count: int) -> Sequence[str]:
        """Return the names of ``count`` fields; empty: they have none."""
        fits = bool(self.titles) and count % len(self.titles) == 0
        return list(self.titles) * (count // len(self.titles)) if fits else ()


@dataclass(frozen=True)
class PatternReader:
    """Fields in the named groups of a regular expression.

    A group ``values`` holds separated fields. With a group ``value``, the expression matches one field, and
    the line is a row of them, named by a group ``name``. A group ``name`` without ``value`` names the line.

    Attributes:
        pattern: of the line, or of one field.
        split: reads ``values``.
        keys: names of the fields, or of the lines, in the order of the frame.
    """

    pattern: re.Pattern[bytes]
    split: SeparatedReader
    keys: Sequence[str] = ()

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        if "value" in self.pattern.groupindex:
            fields = self.fields(line)
            words = position_by_key(fields, self.keys) if self.keys else fields.values()
            return self.split.numbers([word or b"" for word in words])
        match = self.pattern.fullmatch(line)
        if match is None:
            raise FrameError("structure")
        words = list[bytes]()
        for name, position in self.pattern.groupindex.items():
            text = match[position] or b""
            if name == "values":
                words += split_words(text, self.split.marks)
            elif name == "name" and self.keys:
                key = text.decode("ascii", "replace")
                if key not in self.keys:
                    raise FrameError("structure")
                words.append(b"%d" % self.keys.index(key))
            else:
                words.append(text)
        return self.split.numbers(words)

    def fields(self, line: bytes) -> dict[str, bytes]:
        """Return the text of each field of a row by its name, or by its number.

        Raises:
            FrameError: ``structure``: the line holds anything else, or a name twice.
        """
        fields, position = dict[str, bytes](), 0
        while position < len(line):
            match = self.pattern.match(line, position)
            if match is None or match.end() == position:
                raise FrameError("structure")
            found = match.groupdict()
            name = found["name"].decode("ascii", "replace") if "name" in found else str(len(fields))
            if name in fields:
                raise FrameError("structure")
            fields[name], position = found["value"], match.end()
        return fields

    def names(self, count: int) -> Sequence[str]:
        """Return the names of the fields."""
        groups = list(self.pattern.groupindex)
        if "value" in groups:
            return self.keys or self.split.names(count)
        inner = [f"values.{position}" for position in range(count - len(groups) + 1)]
        return [title for name in groups for title in (inner if name == "values" else [name])]


@dataclass(frozen=True)
class JsonReader:
    """Numbers of a JSON value, with or without a text before it; keys name the fields, as ``v.0``.

    Attributes:
        numbers: how words become numbers.
        keys: of the fields, in the order of the frame.
    """

    numbers: NumberWords
    keys: Sequence[str] = ()

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        values = position_by_key(self.fields(line), self.keys)
        return self.numbers([b"" if value is None else str(value).encode() for value in values])

    def fields(self, line: bytes) -> dict[str, Any]:
        """Return the value of each key.

        Raises:
            FrameError: ``structure``: the line ends with no object or list.
        """
        begin = min((position for position in (line.find(b"{"), line.find(b"[")) if position >= 0), default=0)
        try:
            content = json.loads(line[begin:], object_pairs_hook=_distinct)
        except (ValueError, RecursionError) as error:
            raise FrameError("structure") from error
        if not isinstance(content, dict | list):
            raise FrameError("structure")
        return dict(_flatten("", content))

    def names(self, count: int) -> Sequence[str]:
        """Return the keys."""
        return self.keys


@dataclass(frozen=True)
class StructReader:
    """Numbers of a binary frame.

    Attributes:
        record: numpy type of the fields; integers of three bytes are three bytes each.
        wide: name of a field of such integers -> their type, as in ``<i3``.
        repeat: how often the fields follow each other.
        offset: bytes before them.
    """

    record: np.dtype
    wide: Mapping[str, str]
    repeat: int
    offset: int

    def __call__(self, piece: bytes) -> Line:
        """Return the fields of a frame."""
        rows = np.frombuffer(piece, self.record, self.repeat, self.offset)
        names = self.record.names or ()
        row = np.concatenate([self._numbers(name, rows[name]) for name in names], axis=1).ravel()
        whole = bool(np.isfinite(row).all())
        row = row if whole else np.where(np.isfinite(row), row, np.nan)
        return Line(row, "none", whole)  # type: ignore[arg-type]

    def _numbers(self, name: str, column: np.ndarray) -> np.ndarray:
        """Return the numbers (R, N) of a field of all repetitions."""
        column, kind = column.reshape(len(column), -1), self.wide.get(name)
        if kind is None:
            with np.errstate(invalid="ignore"):
                return column.astype(np.float64)
        order = np.arange(3) if kind.startswith("<") else np.arange(3)[::-1]
        numbers = (column.reshape(len(column), -1, 3).astype(np.int64) << 8 * order).sum(axis=2)
        signed = numbers - (numbers >> 23 << 24) if "i" in kind else numbers
        return signed.astype(np.float64)

    def names(self, count: int) -> Sequence[str]:
        """Return the names of the fields; a field of several numbers has them all."""
        sizes = {
            name: int(np.prod(self.record[name].shape, dtype=int)) // (3 if name in self.wide else 1)
            for name in self.record.names or ()
        }
        return [name for name, size in sizes.items() for _ in range(size)] * self.repeat


class CobsReader:
    """Binary frames of our protocol, and comments between them."""

    def __call__(self, piece: bytes) -> Line | bytes:
        """Return number, clock and values of a frame; or the text of a comment."""
        return decode_frame(piece) if piece else b""

    def names(self, count: int) -> Sequence[str]:
        """Return no names."""
        return ()


Reader = CobsReader | SeparatedReader | PatternReader | JsonReader | StructReader
"""Returns the :class:`skin.wire.protocol.Line` of a piece, or bytes of a comment, or raises FrameError."""


def learn_keys(read: Callable[[bytes], Mapping[str, Any]], lines: Sequence[bytes]) -> tuple[str, ...]:
    """Return the names of the fields of lines: in their order, or by name where it changes.

    A name that less than a quarter of the lines have is left out.
    """
    seen = Counter(keys for line in lines if (keys := _keys(read, line)))
    counts = Counter(key for keys in seen.elements() for key in keys)
    common = [key for key, count in counts.items() if 4 * count >= seen.total()]
    first = max(seen, key=lambda keys: (len(keys), seen[keys]), default=())
    if set(common) <= set(first) and all(
        [key for key in first if key in keys] == [key for key in keys if key in first] for keys in seen
    ):
        return tuple(key for key in first if key in common)
    natural = partial(re.sub, r"\d+", lambda match: match[0].zfill(9))
    return tuple(sorted(common, key=natural))


def _keys(read: Callable[[bytes], Mapping[str, Any]], line: bytes) -> tuple[str, ...]:
    try:
        return tuple(read(line))
    except FrameError:
        return ()


def position_by_key(fields: Mapping[str, Any], keys: Sequence[str]) -> list[Any]:
    """Return fields in the order of keys, None where one is missing.

    Raises:
        FrameError: ``structure``: most are missing; ``fields``: an entry of a list is, perhaps not the last.
    """
    missing = [key for key in keys if key not in fields]
    if 2 * len(missing) > len(keys) or not keys:
        raise FrameError("structure")
    if any(key.rpartition(".")[2].isdigit() for key in missing):
        raise FrameError("fields", len(fields))
    return [fields.get(key) for key in keys]


def _distinct(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a key stands twice")
    return content


def _flatten(name: str, value: Any, depth: int = 8) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested objects and lists with their names."""
    if depth < 0:
        raise FrameError("structure")
    if not isinstance(value, dict | list):
        yield name, value
        return
    for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _flatten(f"{name}.{key}" if name else str(key), entry, depth - 1)


def _to_seconds(word: bytes) -> bytes:
    """Return the time of the day in s where a field is one; else the field."""
    match = _DAYTIME.fullmatch(word.strip())
    if match is None:
        return word
    hours, minutes, seconds = map(float, match.groups())
    return b"%.6f" % (3600 * hours + 60 * minutes + seconds)
