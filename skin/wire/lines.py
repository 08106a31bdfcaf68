"""Read the fields of a line of text: separated, labelled, without separators, by a pattern, or JSON."""

import json
import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import Any, Protocol

from skin.device.resampling import FrameError
from skin.wire.protocol import Line, ends_with_separator, parse_words, verify_line

_SEPARATORS = (b",", b";", b"\t")
_TIME = re.compile(rb"(?:\d{4}-\d\d-\d\d[T ])?(\d{1,2}):(\d\d):(\d\d(?:\.\d+)?)")  # of the day
_DEEP = 8  # levels of JSON


class LineReader(Protocol):
    """Reads the fields of a line."""

    @property
    def trailing(self) -> bool:
        """Whether every line ends with a separator."""

    @property
    def padded(self) -> bool:
        """Whether a separator at the end of a line is an empty field."""

    def __call__(self, line: bytes) -> Line:
        """Return the fields; FrameError if the line is none of these."""

    def names(self, count: int) -> Sequence[str]:
        """Return the names of ``count`` fields; empty: they have none."""


@dataclass(frozen=True)
class SeparatedReader:
    """Fields between separators.

    Attributes:
        separator: between fields; None: blanks.
        decimal: the decimal sign.
        invalid: words that mean no value.
        titles: of the fields, repeated over all.
        trailing, padded: as in :class:`LineReader`.
    """

    separator: bytes | None
    decimal: str
    invalid: Collection[bytes]
    titles: Sequence[str] = ()
    trailing: bool = False
    padded: bool = True

    @classmethod
    def learn(
        cls,
        lines: Sequence[bytes],
        separator: str | None,
        decimal: str,
        invalid: Collection[bytes],
        titles: Sequence[str],
    ) -> "SeparatedReader":
        """Return the reader of lines, with their commonest separator where none is given."""
        if separator is not None and separator.strip(" "):
            mark = separator.encode()
            return cls(mark, decimal, invalid, titles, bool(lines) and lines[-1].rstrip(b" ").endswith(mark))
        marks = [mark for mark in _SEPARATORS if mark != decimal.encode()] if separator is None else []
        best, most = None, 0
        for mark in marks:
            fields = Counter(line.count(mark) for line in lines if _is_numeric(line, mark))
            fields.pop(0, None)
            count = fields.most_common(1)[0][1] if fields else 0
            if count > most:
                best, most = mark, count
        data = [line for line in lines if best is not None and _is_numeric(line, best)]
        trailing = bool(data) and all(map(ends_with_separator, data))
        return cls(best, decimal, invalid, titles, trailing)

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        body, check = verify_line(line) if b"*" in line else (line, "none")
        return parse_words(self.words(body), check, self.invalid)

    def words(self, body: bytes) -> list[bytes]:
        """Return the fields of a line as text with a decimal point."""
        body = body.strip(b" ")
        if self.separator is None:
            words = body.split()
        else:
            words = body.removesuffix(self.separator).split(self.separator)
        if self.decimal == ",":
            if b"." in body and b":" not in body:
                raise FrameError("number", word=body.decode("ascii", "replace"))
            words = [word.replace(b",", b".") for word in words]
        return [_to_seconds(word) for word in words] if b":" in body else words

    def names(self, count: int) -> Sequence[str]:
        """Return the names of ``count`` fields."""
        return repeated(self.titles, count)


@dataclass(frozen=True)
class NumberReader:
    """Numbers of a fixed shape, with nothing or anything of a separator between them."""

    number: str
    split: SeparatedReader
    trailing: bool = False
    padded: bool = False

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        number = re.compile(self.number.encode())  # re caches it
        words, place = list[bytes](), 0
        while place < len(line):
            match = number.match(line, place)
            if match is not None and match.end() > place:
                words.append(match[0])
                place = match.end()
            elif line[place] in b" \t,;":
                place += 1
            else:  # not searched for further on: it would take as long as the square of the line's length
                raise FrameError("number", word=line[place:][:80].decode("ascii", "replace"))
        if self.split.decimal == ",":
            words = [word.replace(b",", b".") for word in words]
        return parse_words(words, "none", self.split.invalid)

    def names(self, count: int) -> Sequence[str]:
        """Return the names of ``count`` fields."""
        return repeated(self.split.titles, count)


@dataclass(frozen=True)
class PatternReader:
    """Fields in the named groups of a regular expression, of which ``values`` holds separated ones."""

    pattern: re.Pattern[bytes]
    split: SeparatedReader
    trailing: bool = False
    padded: bool = False

    @classmethod
    def learn(
        cls, lines: Sequence[bytes], pattern: str, separator: str | None, split: SeparatedReader
    ) -> "PatternReader":
        """Return the reader of lines that match a pattern."""
        compiled = re.compile(pattern.encode())
        matches = [match for line in lines if (match := compiled.fullmatch(line))]
        inner = [match["values"] or b"" for match in matches if "values" in compiled.groupindex]
        if inner:
            split = SeparatedReader.learn(inner, separator, split.decimal, split.invalid, split.titles)
        return cls(compiled, split)

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        match = self.pattern.fullmatch(line)
        if match is None:
            raise FrameError("structure")
        words = list[bytes]()
        for name, place in self.pattern.groupindex.items():
            text = match[place] or b""
            if name == "values":
                words += self.split.words(text)
            else:
                text = text.replace(b",", b".") if self.split.decimal == "," else text
                words.append(_to_seconds(text) if b":" in text else text)
        return parse_words(words, "none", self.split.invalid)

    def names(self, count: int) -> Sequence[str]:
        """Return the names of the groups."""
        groups = list(self.pattern.groupindex)
        more_fields = count - len(groups) + 1
        inner = [f"values.{place}" for place in range(more_fields)]
        return [title for name in groups for title in (inner if name == "values" else [name])]


@dataclass(frozen=True)
class LabelReader:
    """Fields with names, as in ``A0: 12, A1: 13``; every line has the same names in the same order."""

    pattern: re.Pattern[bytes]
    labels: Sequence[bytes]
    split: SeparatedReader
    trailing: bool = False
    padded: bool = False

    @classmethod
    def learn(cls, lines: Sequence[bytes], label: str, split: SeparatedReader) -> "LabelReader":
        """Return the reader of lines with the commonest names."""
        mark = re.escape(label.encode())
        # Each blank is matched in one way, or blanks would take a time as the square of their number.
        field = re.compile(
            rb"\s*([^\s,;\d.+-](?:[^\s,;=:]|[^\S\t]++(?![\s,;=:]))*?)\s*"
            + mark
            + rb"\s*([^\s,;]+)\s*[,;\t ]?\s*"
        )
        seen = Counter(names for line in lines if (names := _names_of(field, line)))
        labels = seen.most_common(1)[0][0] if seen else ()
        parts = [re.escape(name) + rb"\s*" + mark + rb"\s*+([^\s,;]*)" for name in labels]
        separator = rb"(?:\s*+[,;]\s*+|\s++|(?<=\s))"  # the last one: behind an empty field
        pattern = re.compile(rb"\s*+" + separator.join(parts) + rb"\s*+[,;]?\s*+")
        return cls(pattern, labels, split)

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        match = self.pattern.fullmatch(line)
        if match is None or not self.labels:
            raise FrameError("structure")
        words = (
            [word.replace(b",", b".") for word in match.groups()]
            if self.split.decimal == ","
            else match.groups()
        )
        return parse_words(words, "none", self.split.invalid)

    def names(self, count: int) -> Sequence[str]:
        """Return the labels."""
        return [name.decode("ascii", "replace") for name in self.labels]


@dataclass(frozen=True)
class JsonReader:
    """Numbers of a JSON value; their names are the keys, with a number for an entry of a list."""

    keys: tuple[str, ...]
    invalid: Collection[bytes]
    trailing: bool = False
    padded: bool = False

    @classmethod
    def learn(cls, lines: Sequence[bytes], invalid: Collection[bytes]) -> "JsonReader":
        """Return the reader of lines with the commonest keys."""
        seen = Counter(keys for line in lines if (keys := _keys_of(line)))
        return cls(seen.most_common(1)[0][0] if seen else (), invalid)

    def __call__(self, line: bytes) -> Line:
        """Return the fields of a line."""
        content = dict(_flatten("", _parse_json(line), 0))
        if content.keys() != set(self.keys):
            raise FrameError("structure")
        return self._numbers([content[key] for key in self.keys])

    def _numbers(self, content: Sequence[Any]) -> Line:
        numbers = list[float]()
        for value in content:
            if type(value) in (int, float):
                try:
                    numbers.append(float(value))
                except OverflowError:
                    numbers.append(nan)
            elif value is None:
                numbers.append(nan)
            elif isinstance(value, str):
                numbers += parse_words([value.encode()], "none", self.invalid).fields
            else:
                raise FrameError("number", word=str(value))
        numbers = [number if isfinite(number) else nan for number in numbers]
        return Line(numbers, "none", all(map(isfinite, numbers)))

    def names(self, count: int) -> Sequence[str]:
        """Return the keys."""
        return self.keys


def repeated(titles: Sequence[str], count: int) -> Sequence[str]:
    """Return names of ``count`` fields that repeat; empty where they do not fit."""
    if not titles or count % len(titles):
        return ()
    return list(titles) * (count // len(titles))


def _is_numeric(line: bytes, mark: bytes) -> bool:
    """Return whether most fields of a line begin like a number."""
    words = [word.strip()[:1] for word in line.removesuffix(mark).split(mark)]
    return 2 * sum(word in b"+-.0123456789" and word != b"" for word in words) >= len(words)


def _names_of(field: re.Pattern[bytes], line: bytes) -> tuple[bytes, ...]:
    """Return the labels of a line that consists of nothing else; empty otherwise."""
    names, place = list[bytes](), 0
    while place < len(line):
        match = field.match(line, place)
        if match is None or match.end() == place:
            return ()
        names.append(match[1])
        place = match.end()
    return tuple(names) if len(set(names)) == len(names) else ()


def _keys_of(line: bytes) -> tuple[str, ...]:
    try:
        return tuple(key for key, _ in _flatten("", _parse_json(line), 0))
    except FrameError:
        return ()


def _parse_json(line: bytes) -> Any:
    if not line.lstrip().startswith((b"{", b"[")):
        raise FrameError("structure")
    try:
        return json.loads(line, object_pairs_hook=_distinct)
    except (ValueError, RecursionError) as error:
        raise FrameError("structure") from error


def _distinct(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a key stands twice")
    return content


def _flatten(name: str, value: Any, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > _DEEP:
        raise FrameError("structure")
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    )
    if entries is None:
        yield name, value
        return
    for key, entry in entries:
        yield from _flatten(f"{name}.{key}" if name else str(key), entry, depth + 1)


def _to_seconds(word: bytes) -> bytes:
    """Return the time of the day in s where a field is one; else the field."""
    match = _TIME.fullmatch(word.strip())
    if match is None:
        return word
    hours, minutes, seconds = (float(part) for part in match.groups())
    return b"%.6f" % (3600 * hours + 60 * minutes + seconds)
