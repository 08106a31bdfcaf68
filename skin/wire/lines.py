"""Read the fields of a piece: words of a line, named fields by a pattern or of JSON, or a struct."""

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from skin.device.resampling import FrameError
from skin.wire.protocol import Line, parse_words, split_words, verify_line

_HEX = re.compile(rb"(?i)(?:0x)?[0-9a-f]+")
# Each blank is matched in one way, or blanks would take a time as the square of their number.
LABEL = (
    r"\s*+(?P<name>[^\s,;\d.+-](?:[^\s,;=:]|[^\S\t]++(?![\s,;=:]))*?)\s*%s"
    r"\s*+(?P<value>[^\s,;]*+)\s*+[,;]?\s*+"
)
"""Pattern of one field with a name, as in ``A0: 12``, for the text between both."""

Reader = Callable[[bytes], Line | bytes]
"""Returns the :class:`skin.wire.protocol.Line` of a piece, or bytes of a comment, or raises FrameError."""


@dataclass(frozen=True)
class NumberWords:
    """How words become numbers.

    Attributes:
        decimal: the decimal sign.
        base: 10 or 16.
        invalid: words, in lower case, that mean no value.
        over: words, in lower case, for a value beyond the range of the converter.
    """

    decimal: str
    base: int
    invalid: Collection[bytes]
    over: Collection[bytes]

    def __call__(self, words: Sequence[bytes], check: Any = "none") -> Line:
        """Return the numbers of words."""
        if self.base == 16:
            # Python writes no more than 4300 decimal digits; from 2**1024 on, none is a float anyway.
            words = [
                b"%d" % min(int(word, 16), 2**1024) if _HEX.fullmatch(word.strip()) else word
                for word in words
            ]
        if self.decimal == ",":
            words = [word.translate(_SWAPPED) for word in words]
        return parse_words(words, check, self.invalid, self.over)


_SWAPPED = bytes.maketrans(b".,", b",.")  # a point is no decimal sign then


def read_words(numbers: NumberWords, marks: Sequence[bytes], trailing: bool, line: bytes) -> Line:
    """Return the numbers between separators.

    Args:
        numbers: how words become numbers.
        marks: separators, of which the first that a line has counts; blanks otherwise.
        trailing: every line ends with a separator, so no line means an empty field by it.
        line: with or without a checksum.
    """
    body, check = verify_line(line) if b"*" in line else (line, "none")
    return numbers(split_words(body, marks, trailing), check)


def read_pattern(
    numbers: NumberWords,
    pattern: re.Pattern[bytes],
    marks: Sequence[bytes],
    rows: Mapping[bytes, bytes],
    line: bytes,
) -> Line:
    """Return the numbers in the named groups of a regular expression of a line.

    Args:
        numbers: how words become numbers.
        pattern: of the line; its group ``values`` holds separated fields.
        marks: separators of these.
        rows: text of a group ``name`` -> number of the row; empty: no group names the line.
        line: the line.
    """
    match = pattern.fullmatch(line)
    if match is None or (rows and match["name"] not in rows):
        raise FrameError("structure")
    words = list[bytes]()
    for name, text in match.groupdict(b"").items():
        word = rows.get(text, text) if name == "name" else text
        words += split_words(text, marks) if name == "values" else [word]
    return numbers(words)


Find = Callable[[bytes], Mapping[str, bytes | None]]
"""Returns the text of each field of a line by its name; raises FrameError."""


def read_named(numbers: NumberWords, find: Find, keys: Sequence[str], line: bytes) -> Line:
    """Return the numbers of named fields in the order of keys, NaN where one is missing.

    Raises:
        FrameError: ``structure``: most are missing; ``fields``: an entry of a list is, perhaps not the last.
    """
    fields = find(line)
    missing = [key for key in keys if key not in fields]
    if 2 * len(missing) > len(keys):
        raise FrameError("structure")
    if any(key.rpartition(".")[2].isdigit() for key in missing):
        raise FrameError("fields", len(fields))
    return numbers([fields.get(key) or b"" for key in keys or fields])


def find_row(pattern: re.Pattern[bytes], line: bytes) -> dict[str, bytes | None]:
    """Return the fields of a line that a pattern with a group ``value`` matches one by one.

    Their names are its group ``name``, or their numbers.

    Raises:
        FrameError: ``structure``: the line holds anything else, or a name twice.
    """
    fields, position, count = dict[str, bytes | None](), 0, 0
    while (match := pattern.match(line, position)) and match.end() > position:
        groups = match.groupdict()
        fields[groups.get("name", b"%d" % count).decode("ascii", "replace")] = groups["value"]
        position, count = match.end(), count + 1
    if position < len(line) or count > len(fields):
        raise FrameError("structure")
    return fields


def find_json(line: bytes) -> dict[str, bytes | None]:
    """Return the values of a JSON value, with or without a text before it; its keys, as ``v.0``, name them.

    Raises:
        FrameError: ``structure``: the line ends with no object or list.
    """
    begin = min((position for position in (line.find(b"{"), line.find(b"[")) if position >= 0), default=0)
    try:
        content = json.loads(line[begin:])
    except (ValueError, RecursionError) as error:
        raise FrameError("structure") from error
    if not isinstance(content, dict | list):
        raise FrameError("structure")
    return {name: None if value is None else str(value).encode() for name, value in _flatten("", content)}


def _flatten(name: str, value: Any, depth: int = 8) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested objects and lists with their names."""
    if not isinstance(value, dict | list):
        yield name, value
    elif depth < 0:
        raise FrameError("structure")
    else:
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _flatten(f"{name}.{key}" if name else str(key), entry, depth - 1)


def learn_keys(find: Find, lines: Sequence[bytes]) -> tuple[str, ...]:
    """Return the names of the fields of lines: in their order, or by name where it changes.

    A name that less than a quarter of the lines have is left out.
    """
    seen = Counter[tuple[str, ...]]()
    for line in lines:
        try:
            seen[tuple(find(line))] += 1
        except FrameError:
            continue
    counts = Counter(key for keys in seen.elements() for key in keys)
    common = [key for key, count in counts.items() if 4 * count >= seen.total()]
    first = max(seen, key=lambda keys: (len(keys), seen[keys]), default=())
    if set(common) <= set(first) and all(
        [key for key in first if key in keys] == [key for key in keys if key in first] for keys in seen
    ):
        return tuple(key for key in first if key in common)
    # By the numbers in them: s10 follows s9.
    return tuple(sorted(common, key=partial(re.sub, r"\d+", lambda match: match[0].zfill(9))))


class StructField(NamedTuple):
    """Numbers of one type in a binary frame.

    Attributes:
        name: of the field.
        kind: type, as in ``<u2``, also integers of three bytes, as in ``<i3``.
        numbers: how many.
    """

    name: str
    kind: str
    numbers: int

    @property
    def size(self) -> int:
        """Bytes."""
        return int(self.kind[2:]) * self.numbers


def read_struct(table: Sequence[StructField], repeat: int, offset: int, piece: bytes) -> Line:
    """Return the numbers of a binary frame.

    Args:
        table: fields that follow each other.
        repeat: how often they do.
        offset: bytes before them.
        piece: the frame.
    """
    size = sum(field.size for field in table)
    rows = np.frombuffer(piece, np.uint8, repeat * size, offset).reshape(repeat, size)
    columns, begin = list[np.ndarray](), 0
    for field in table:
        columns.append(unpack(rows[:, begin : begin + field.size], field.kind))
        begin += field.size
    row = np.concatenate(columns, axis=1).ravel()
    whole = bool(np.isfinite(row).all())
    row = row if whole else np.where(np.isfinite(row), row, np.nan)
    return Line(row, "none", whole)  # type: ignore[arg-type]


def unpack(data: np.ndarray, kind: str) -> np.ndarray:
    """Return the numbers (R, N) of one type in bytes (R, B)."""
    if kind[2:] == "3":  # the upper three bytes of an integer of four
        wide = np.zeros((len(data), data.shape[1] // 3, 4), np.uint8)
        wide[..., slice(1, 4) if kind[0] == "<" else slice(0, 3)] = data.reshape(len(data), -1, 3)
        return (wide.view(kind[:2] + "4")[..., 0] >> 8).astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.ascontiguousarray(data).view(kind).astype(np.float64)
