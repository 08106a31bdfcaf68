"""Propose an adapter from a few seconds of a stream: ``skin listen adapter=auto``.

Candidates are played through a decoder; what decides is how plausible the values are, not how many lines
match.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, zip_longest
from typing import Any

import numpy as np

from skin.device.resampling import FrameError
from skin.errors import InputError
from skin.wire.adapter import Adapter, is_text, read_adapter
from skin.wire.decoder import Decoder, kind_of_line
from skin.wire.formats import ANSI, FrameFormat, counts, cycles, last_part, runs
from skin.wire.protocol import INVALID, OVER, Line, split_words

Pieces = Sequence[tuple[float, bytes]]
"""Bytes with the time of their arrival, s."""

_SAME = 0.98
"""Part of the bytes or characters that repeat from frame to frame; others are damaged."""
_FRAMES = 10  # that a candidate must read
_DATE = (
    rb"(?:20\d\d[-/.]\d\d?[-/.]\d\d?|\d\d?[-/.]\d\d?[-/.](?:20\d\d|\d\d(?=[T\s,;]+\d\d?:\d\d))|20\d{6}(?=T\d))"
    rb"(?:T\d[\d:.]*(?:Z|[-+]\d\d(?::?\d\d)?)?)?"
)
"""A day, with or without the time of ISO 8601; one with a year of two digits only before a time."""
_NUMBER = re.compile(
    _DATE + rb"|\d{1,2}:\d\d:\d\d(?:\.\d+)?|(?:(?<!\w)[-+])?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]\d+)?"
)
_WORD = r"[-+.:\w/]+"  # a number, or a word in its position
_ASIDE = re.compile(r"(?i)temp.*|.*[_\[(](t|temp.*|°?c|deg.?c)[\])]?|.*humid.*|rssi|.*batt.*|temperature")
_GUIDE = re.compile(r"(?i)min|max|low|lower|high|upper|zero|ref.*|limit")
"""Names of fields that are not forces, and of lines that keep a plotter from scaling."""
_UNIT = re.compile(
    rb"[-+]?\d+\.?\d*\s*(?:[^\x00-\x7f]+)?(?:C|F|%|V|dBm?)|(?:" + _DATE + rb"\s*)?(?:\d+:\d\d:\d\d\S*)?"
)
"""Texts with a number in each: a quantity with its unit, the day, and the time of the day."""


@dataclass(frozen=True)
class Proposal:
    """An adapter that reads a stream.

    Attributes:
        adapter: for the configuration.
        summary: what it makes of the stream, in words.
        sensors: values per frame.
        score: the lower, the more plausible.
        values: (F, S), of all frames; NaN where there was none.
    """

    adapter: Adapter
    summary: str
    sensors: int
    score: float
    values: np.ndarray


class _ImplausibleError(Exception):
    """A candidate reads the stream, but not as frames of a skin; the message says why."""


@np.errstate(over="ignore", invalid="ignore")  # numbers of a faulty wire
def propose(pieces: Pieces, seconds: float | None = None, margin: float = 0.25) -> list[Proposal]:
    """Return the adapters that read a stream, the most plausible first.

    Args:
        pieces: what was received.
        seconds: for which the stream was read; None: until the last piece.
        margin: difference of the score up to which another reading is returned, too.

    Raises:
        InputError: nothing was received, or no adapter reads it; the text is in the message.
    """
    data = b"".join(piece for _, piece in pieces)
    if not data:
        raise InputError(
            "nothing received: is the board plugged in and sending? If it waits for a text, give it, as in "
            "'device.adapter={kind: text, start: s}' or poll for a text per frame"
        )
    _refuse_pauses([time for time, _ in pieces], seconds)
    readings, reasons = list[Proposal](), list[str]()
    for number, adapter in enumerate(_text(data)):
        if readings and number / 100 > readings[0].score + margin:
            break
        try:
            reading = _read(adapter, pieces, data)
        except _ImplausibleError as error:
            reasons.append(str(error))
        except (InputError, FrameError):
            continue
        else:
            readings.append(replace(reading, score=reading.score + number / 100))
            readings.sort(key=lambda reading: reading.score)
    if not readings:
        raise InputError(f"no adapter reads what the board sends: {_sample(data, reasons)}")
    best = readings[0]
    count = min(len(reading.values) for reading in readings)  # of frames that all have at the end
    others = [
        other
        for other in readings[1:]
        if other.score < best.score + margin
        and not np.array_equal(other.values[-count:], best.values[-count:], equal_nan=True)
    ]
    return [best, *others[:1]]


def _refuse_pauses(
    times: Sequence[float], seconds: float | None, boot: float = 2.5, pause: float = 0.5
) -> None:
    """Refuse a stream that is silent for more than a fifth of the time, apart from ``boot`` s at first."""
    end = times[-1] if seconds is None else seconds
    gaps = [end - times[-1], times[0] - boot, *(later - before for before, later in pairwise(times))]
    silent = sum(gap for gap in gaps if gap > pause)
    if 5 * silent > end - min(times[0], boot) and len(times) > _FRAMES:
        raise InputError(
            f"the board sent nothing for {silent:.1f} of {end:.1f} s: if it only sends what changes, nobody "
            "knows whether the skin is untouched; let the firmware send every frame, or listen again"
        )


def _sample(data: bytes, reasons: Sequence[str]) -> str:
    """Return the text that was received, or its bytes, and what may help."""
    if reasons:
        reason = Counter(reasons).most_common(1)[0][0]
        return f"{reason}; or read it by device.adapter.pattern (docs/hardware.md)"
    if is_text(data):
        lines = [line for line in re.split(rb"[\r\n]+", data) if line.strip()]
        texts = "; ".join(repr(line[:100].decode("ascii", "replace")) for line in lines[-3:])
        return (
            f"the last lines are {texts}: if it waits for a text, give start=; a pattern (docs/hardware.md) "
            "reads any lines"
        )
    return (
        f"{len(data)} bytes that are not text, which begin with {data[:48].hex(' ')}: right baud rate? "
        "Describe binary frames yourself, as in kind: binary, head: aa 55, struct: {force: (16,)<u2}"
    )


def _read(adapter: Adapter, pieces: Pieces, data: bytes) -> Proposal:
    """Return what an adapter makes of a stream.

    Raises:
        InputError, FrameError: it reads nothing.
        _ImplausibleError: what it reads are no frames of a skin.
    """
    notes, score = list[str](), 0.0
    if adapter.kind in ("text", "json"):
        adapter, notes, score = _settle(adapter, data)
    decoder = Decoder(adapter=adapter)
    frames = [frame for now, piece in pieces for frame in decoder.feed(piece, now)]
    stats, bad = decoder.stats, decoder.stats.bad_frames
    if decoder.frame_format is None or len(frames) < max(_FRAMES, 0.9 * (len(frames) + bad)):
        raise FrameError("structure")
    if adapter.kind == "protocol" and stats.check == "none" and decoder.header is None:
        raise FrameError("structure")
    values = np.array([np.where(frame.valid, frame.values, np.nan) for frame in frames])
    score += bad / len(frames) + _judge_values(values, decoder.frame_format)
    passed = frames[-1].t_host - frames[0].t_host
    rate = f" at {(len(frames) - 1) / passed:.3g} Hz" if passed > 0 else ""
    if errors := _errors(values, passed / len(frames)):
        adapter = replace(adapter, invalid=(*adapter.invalid, *errors))
        notes.append(f"{', '.join(f'{error:g}' for error in errors)} in single frames is no value")
    numbers = [column[np.isfinite(column)] for column in values.T]
    levels = ", ".join(f"{np.median(column) if len(column) else 0:.4g}" for column in numbers[:64])
    words = [
        f"{decoder.sensors} values{rate}",
        decoder.frame_format.roles.summary if decoder.frame_format.roles else "",
        stats.clock,
        *notes,
        f"medians {levels}",
    ]
    return Proposal(adapter, "; ".join(filter(None, words)), decoder.sensors or 0, score, values)


def _judge_values(values: np.ndarray, frame_format: FrameFormat, maximum: int = 64) -> float:
    """Return how implausible values (F, S) are.

    Raises:
        _ImplausibleError: the values of several sensors follow one another in a field, or nothing changes.
    """
    moving = values[:, np.nanmax(values, axis=0, initial=-np.inf) > np.nanmin(values, axis=0, initial=np.inf)]
    if not moving.shape[1]:
        raise _ImplausibleError("no value ever changes")
    # Between frames next to each other, readings at rest differ as much as between frames further apart.
    near = _typical_step(moving, 1)
    for lag in range(2, min(maximum, len(moving) // 4)):
        if np.mean(near > 3 * _typical_step(moving, lag) + 2 * _resolution(moving)) >= 0.5:
            raise _ImplausibleError(
                f"every {lag} lines are alike, those between them are not: they are of several sensors; let "
                "the firmware send a line per frame, or number the lines"
            )
    score = 0.5 * (1 - moving.shape[1] / values.shape[1])
    if frame_format.index is not None:
        rows = np.median(np.nan_to_num(values), axis=0).reshape(frame_format.rows, -1)
        # A counter of a few bits numbers lines that are all alike.
        score += 3.0 * bool((np.ptp(rows, axis=0) <= 2 * np.median(near)).all())
    return score


def _errors(values: np.ndarray, period: float, longest: float = 0.0205) -> list[float]:
    """Return constants that one value of (F, S) jumps to in single frames again and again, as after an error.

    Nothing touches a skin for one frame of 20 ms; the largest counts of converters may be meant, though.
    """
    steps = np.diff(values, axis=0)
    far = 50 * np.maximum(_typical_step(values, 1), _resolution(values))
    back = np.abs(steps[:-1] + steps[1:]) < far / 5
    single = (np.abs(steps[:-1]) > far) & (np.abs(steps[1:]) > far) & back
    alone = single & (single.sum(axis=1, keepdims=True) == 1)
    often = Counter(values[1:-1][alone].tolist())
    ends = {0.0, *(2.0**bits - 1 for bits in (8, 10, 12, 14))}
    return sorted(
        value for value, count in often.items() if count > 1 and value not in ends and period <= longest
    )


def _resolution(values: np.ndarray) -> np.ndarray:
    """Return the smallest difference of each value (S,)."""
    steps = (np.diff(np.unique(column[np.isfinite(column)])) for column in values.T)
    return np.array([step.min() if len(step) else 1.0 for step in steps])


def _typical_step(values: np.ndarray, lag: int) -> np.ndarray:
    """Return the mean change of each value (S,) over ``lag`` frames, without the largest fifth."""
    steps = np.sort(np.abs(values[lag:] - values[:-lag]), axis=0)
    return np.nan_to_num(steps)[: max(1, 4 * len(steps) // 5)].mean(axis=0)


def _settle(adapter: Adapter, data: bytes) -> tuple[Adapter, list[str], float]:
    """Return an adapter with the roles of its fields, what it leaves out, in words, and its score."""
    layout = next(adapter.layouts(data))
    pieces = layout.split(data)[0]
    reads = [(piece, layout.try_fields(piece)) for piece in pieces[1:]]  # the first may be half a line
    lines = [(piece, read) for piece, read in reads if isinstance(read, Line) and not _is_title(read)]
    if len(lines) < _FRAMES:
        raise FrameError("structure")
    width = Counter(len(read.fields) for _, read in lines).most_common(1)[0][0]
    table = [read for _, read in lines if len(read.fields) == width]
    others = [
        piece.strip(b"\r\n ")
        for piece, read in reads
        if read is None or (isinstance(read, Line) and (_is_title(read) or len(read.fields) != width))
    ]
    names = layout.names(width)
    if not names and adapter.pattern is None and adapter.rows is None:
        names = _titles(pieces, width)
    left_out = dict.fromkeys(_text_columns(table), "is text")
    ignore, kinds = _ignored(others, [piece for piece, _ in lines])
    if adapter.rows is None:
        score = 0.1 * len(kinds) + 0.2 * len(others) / (len(others) + len(table))
        roles, reasons = _roles(np.array([read.fields for read in table]), names, left_out)
        left_out = reasons | left_out
    else:
        _refuse_unequal_rows([read for _, read in lines])
        # Text or other data between lines of one sensor each does not make them rows.
        between = {kind_of_line(line) for line in others}
        wordy = re.compile(r"[^#]*[^\W\d_]{2}[^#]*")
        score = 0.5 * any(kind.count("#") > 1 or wordy.fullmatch(kind) for kind in between)
        ignore, kinds, roles = None, [], {"counter": None}
    by_name = bool(names) and len(set(names)) == len(names)
    described = {position: names[position] if by_name else position for position in sorted(left_out)}
    notes = [f"field {field} {left_out[position]}" for position, field in described.items()]
    notes += [f"{count} lines such as {kind!r} are ignored" for kind, count in kinds]
    if by_name and adapter.pattern is None:
        roles["names"] = tuple(names)
    return (
        replace(adapter, drop=(*adapter.drop, *described.values()), ignore=ignore, **roles),
        notes,
        score,
    )


def _refuse_unequal_rows(lines: Sequence[Line]) -> None:
    """Refuse rows of which those of another length would be left out; a clock may stand between matrices."""
    lengths = Counter(
        len(line.fields) for line in lines if np.isfinite(line.fields).any() and not line.strange
    )
    alone = np.array([line.fields[0] for line in lines if len(line.fields) == 1])
    rows = lengths.total() - len(alone) * runs(alone)
    if max(lengths.values(), default=0) < _SAME * rows or 3 * rows < 2 * lengths.total():
        raise _ImplausibleError(
            f"lines have {' or '.join(map(str, sorted(lengths)))} fields, so sensors of some would be lost: "
            "let the firmware send a line per frame"
        )


def _is_title(read: Line) -> bool:
    return len(read.strange) == len(read.fields)


def _titles(pieces: Sequence[bytes], width: int) -> Sequence[str]:
    """Return the names in a line of names between separators; empty: there is none."""
    for piece in pieces:
        line = piece.strip(b"\r\n #")
        for mark in (b",", b";", b"\t"):
            words = [word.strip(b' "').decode("utf-8", "replace") for word in line.split(mark)]
            if len(words) == width > 1 and all(re.match(r"[^\W\d]", word) for word in words):
                return words
    return ()


def _text_columns(lines: Sequence[Line]) -> list[int]:
    """Return the fields that are text in most lines.

    Raises:
        _ImplausibleError: a field is text now and then, or hides a number.
    """
    strange = Counter(position for line in lines for position in line.strange)
    columns = [position for position, count in strange.items() if count > 0.9 * len(lines)]
    for position, count in strange.items():
        column = [line.strange[position] for line in lines if position in line.strange]
        words, changes = {*column}, sum(before != word for before, word in pairwise(column))
        word = min(words).decode("ascii", "replace")
        if position not in columns and (count > 2 or re.fullmatch(r"[0-9A-Fa-f]+", word)):
            raise _ImplausibleError(
                f"the word {word!r} stands in place of numbers: give device.adapter.over=[{word}] if that is "
                f"beyond the range, device.adapter.invalid=[{word}] if it is no value"
            )
        numbers = {tuple(_NUMBER.findall(word)) for word in words}
        if (
            position in columns
            and (len(numbers - {()}) > 1 or 2 * changes > len(column))
            and not all(map(_UNIT.fullmatch, words))
        ):
            raise FrameError("number")  # with a text beside it, or after the name of one of several boards
    return columns


def _ignored(others: Sequence[bytes], frames: Sequence[bytes]) -> tuple[str | None, list[tuple[str, int]]]:
    """Return a pattern of lines of another kind than frames, and their kinds with their numbers.

    Raises:
        _ImplausibleError: such lines name what follows them.
    """
    kinds = Counter(kind_of_line(line) for line in others)
    kept = list[tuple[str, int]]()
    for kind, count in kinds.most_common(8):
        start, words = kind.partition("#")[0], split_words(kind.lower().encode())
        # Words for values are none of another kind: known ones, and those of several sensors.
        values = (INVALID | OVER) & {*words} or ("#" not in kind and len({*words}) < len(words))
        alike = any(kind_of_line(frame).startswith(start) for frame in frames[:_FRAMES])
        if len(re.findall(r"[^\W\d_]", start)) < 2 or values or alike:
            continue
        numbers = Counter(tuple(re.findall(rb"\d+", line)) for line in others if kind_of_line(line) == kind)
        naming = "#" in kind and 2 <= len(numbers) <= 64 and min(numbers.values()) > 2 and kind.count("#") < 3
        size = len(re.findall(rb"\d+", frames[0]))
        if naming or (len(numbers) > 2 and size == len(next(iter(numbers)))):
            raise _ImplausibleError(
                f"lines such as {kind!r} name other values, or those after them: let the firmware send a "
                "line per frame, or give them as device.adapter.ignore"
            )
        kept.append((kind, count))
    starts = dict.fromkeys(re.escape(kind.partition("#")[0]) + ".*" for kind, _ in kept)
    return "|".join(starts) or None, kept


def _roles(
    table: np.ndarray, names: Sequence[str], text: Collection[int]
) -> tuple[dict[str, Any], dict[int, str]]:
    """Return the settings of counter and time of fields (L, C), and why other fields are no sensors."""
    free = [position for position in range(table.shape[1]) if position not in text]
    roles, many = dict[str, Any](counter=None, time=None), len(table) > 30
    for role, behaves in (("counter", partial(counts, wraps=many)), ("time", runs)):
        # Of a few lines, only the first two fields may look like a clock.
        seen = [position for position in free if many or names or position < 2] if len(free) > 1 else []
        roles[role] = next((position for position in seen if behaves(table[:, position])), None)
        free = [position for position in free if position != roles[role]]
    counter = roles["counter"]
    if counter is not None and np.count_nonzero(np.diff(table[:, counter]) < 0) > 1:
        roles["modulus"] = int(table[:, counter].max()) + 1
    named = {position: names[position] if names else "" for position in free}
    last = {position: last_part(name) for position, name in named.items()}
    aside = [
        position for position in free if _ASIDE.fullmatch(named[position]) or _ASIDE.fullmatch(last[position])
    ]
    left_out = dict.fromkeys(aside, "is no force, by its name")
    still = np.ptp(table, axis=0) == 0
    moving = table[:, [position for position in free if not still[position] and position not in aside]]
    low, high = moving.min(initial=np.inf), moving.max(initial=-np.inf)
    outside = [position for position in free if still[position] and not low < table[0, position] < high]
    pair = outside == [free[0], free[-1]] and np.count_nonzero(table[0, outside] <= low) == 1
    guides = [position for position in outside if pair or _GUIDE.fullmatch(last[position])]
    left_out |= {position: f"is always {table[0, position]:g}, a guide of a plotter" for position in guides}
    rest = [position for position in free if position not in left_out]
    for position in (rest[-1], rest[0]) if len(rest) > 2 else ():
        inner, column = table[:, [other for other in rest if other != position]], table[:, position]
        # What varies as the others do: quiet sensors at rest are near their mean, too.
        near = [total - column for total in _sums(inner, table, counter) if not still[position]]
        if any(np.mean(np.abs(error) < 0.51) > _SAME and error.std() < 0.3 * column.std() for error in near):
            return roles, left_out | {position: "is a sum of the others"}
    return roles, left_out


def _sums(inner: np.ndarray, table: np.ndarray, counter: int | None) -> Iterator[np.ndarray]:
    """Yield what firmware sends to check fields (L, C): sums and parities."""
    parts = [inner] if counter is None else [inner, np.column_stack([table[:, counter], inner])]
    for part in parts if not (table[:, [0]] % 1).any() else ():
        whole = np.nan_to_num(part).astype(np.int64)
        for total in (whole.sum(axis=1), np.bitwise_xor.reduce(whole, axis=1)):
            yield from (total, total % 256, total % 65536)


def _text(data: bytes) -> Iterator[Adapter]:
    """Yield adapters of text, the most specific first."""
    yield Adapter()
    if not is_text(data):
        yield read_adapter("anyskin_binary")
    if data.count(b"\n") + data.count(b"\r") >= _FRAMES:
        mark = b"\n" if b"\n" in data else b"\r"
        lines = (ANSI.sub(b"", line).strip(b"\r\n ") for line in data.split(mark)[1:-1])
        return (yield from _lines([line for line in lines if line and not line.startswith(b"#")]))
    # Text without lines: with a word at the end of each frame.
    for word, count in Counter(re.findall(rb"[^\d\s.,;+-]+", data)).most_common(2):
        if count >= _FRAMES and word.isascii():
            yield from _lines(data.split(word)[1:-1], word.decode())


def _lines(lines: Sequence[bytes], end: str | None = None) -> Iterator[Adapter]:
    text = partial(Adapter, kind="text", end=end)
    # The comma of 998;1,024 is between groups of digits: as a decimal sign, a press would read as no force.
    columns = [
        [word for word in column if re.fullmatch(rb"[-+]?\d[\d,]*", word)]
        for column in zip_longest(*(re.split(rb"[;=:\t ]+", line) for line in lines), fillvalue=b"")
    ]
    signs: Any = (
        "."
        if any(
            len({b"," in word for word in column}) == 2
            and all(re.fullmatch(rb"[-+]?\d{1,3}(,\d{3})*", word) for word in column)
            for column in columns
        )
        else ".,"
    )
    yield Adapter(kind="json", end=end)
    yield from (text(label=label, decimal=sign) for label in (":", "=") for sign in signs)
    # Names as A0,A1 above decimal numbers, and words as DEAD in their place, look like hexadecimal ones.
    title = next((line for line in lines if not re.search(rb"\b\d+\b", line)), b"")
    digits = re.split(rb"[,;\t ]+", b" ".join(line for line in lines if line != title).strip())
    lettered = [word for word in digits if not word.isdigit()]
    if (4 * len(lettered) > len(digits) or any(word[:1].isdigit() for word in lettered)) and all(
        re.fullmatch(rb"(?i)(0x)?[0-9a-f]{2,}", word) for word in digits
    ):
        yield text(base=16)
    yield from (text(decimal=sign) for sign in signs)
    yield text(rows=0, counter=None)
    firsts = [match[1].decode() for line in lines if (match := re.match(rb"\W*([A-Za-z_]\w*)", line))]
    if 2 * sum(before != word for before, word in pairwise(firsts)) > len(lines) and len(set(firsts)) <= 64:
        order, pattern = list(dict.fromkeys(firsts[1:])), r"\W*(?P<name>[A-Za-z_]\w*)[^-+.\w]+(?P<values>.*)"
        begin = order.index(min(order))
        yield text(pattern=pattern, names=(*order[begin:], *order[:begin]), rows=0, counter=None)
    yield from (text(**described) for described in _patterns(lines))
    yield replace(read_adapter("anyskin"), end=end)


def _patterns(lines: Sequence[bytes]) -> Iterator[dict[str, Any]]:
    """Yield patterns of the text around the numbers that many lines share."""
    shapes = [tuple(b" ".join(text.split()) for text in _NUMBER.split(line)) for line in lines]
    for shape, count in Counter(shapes).most_common(3):
        alike = [line for line, other in zip(lines, shapes, strict=True) if other == shape]
        if count < _FRAMES or len(shape) < 2:
            continue
        literals = [
            Counter(texts).most_common(1)[0][0] for texts in zip(*map(_NUMBER.split, alike), strict=True)
        ]
        columns = list(zip(*map(_NUMBER.findall, alike), strict=True))
        missing = INVALID & {word.lower() for text in literals for word in re.findall(rb"[A-Za-z/]+", text)}
        if missing or all(len(set(column)) == 1 for column in columns):
            continue  # the text is a value that is missing, or names of channels
        whole = [b"".join(column).isdigit() and cycles(np.array(column, float)) for column in columns[:-1]]
        index = whole.index(True) if True in whole else None
        first = len(columns) - 1
        while first > 0 and shape[first] == shape[-2] in (b"", b",", b";") and first - 1 != index:
            first -= 1
        separated = first < len(columns) - 1 or index is not None
        parts, used = list[str](), {"values", "value", "name"}
        for position, column in enumerate(columns[: first if separated else None]):
            parts.append(_literal(literals[position]))
            if len(set(column)) == 1 and re.search(rb"\w$", literals[position]):
                parts.append(re.escape(column[0].decode()))  # digits of a word
                continue
            word = re.sub(r"\W+", "_", literals[position].decode("ascii", "ignore")).strip("_").lower()
            name = "row" if position == index else word if word.isidentifier() else f"f{position}"
            name = f"f{position}" if name in used else name
            used.add(name)
            others = rf"(?P<{name}>{_WORD})" if index is None else rf"{_WORD}?"
            parts.append(rf"(?P<{name}>\d+)" if position == index else others)
        if separated:
            parts += [_literal(literals[first]), "(?P<values>.*?)"]
        rows: dict[str, Any] = {} if index is None else {"rows": 0, "index": "row", "counter": None}
        yield {"pattern": "".join(parts) + _literal(literals[-1])} | rows


def _literal(text: bytes) -> str:
    """Return a regular expression of the text between two numbers, whatever its blanks are."""
    words = [re.escape(word) for word in re.sub(rb"[^\x00-\x7f]+", b"\xff", text).decode("latin-1").split()]
    inner = r"\s+".join(word.replace("\xff", r"[^\x00-\x7f]+") for word in words)
    return rf"\s*{inner}\s*" if inner else r"\s+" if text else ""
