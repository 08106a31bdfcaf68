"""Propose an adapter from a few seconds of a stream: ``skin listen adapter=auto``."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from time import monotonic
from typing import Any

import numpy as np

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.wire.adapter import Adapter
from skin.wire.columns import counts, runs
from skin.wire.decoder import Decoder
from skin.wire.reader import ByteStream

_SHARE = 0.9  # of the pieces after the first frame that an adapter must read
_FRAMES = 10  # that it must read
_MOST_ROWS = 64
_LONGEST = 512  # bytes of a frame without an end
_SAME = 0.98  # fraction of the characters that repeat from frame to frame
_SIZE = 1e-4, 1e7  # of floats that are readings
_LONGEST_MARK = 8  # bytes
_MARKED = 0.01  # that a byte of a mark counts against the spread of readings
_NARROW, _CONSTANT = 0.1, 0.05  # that a counter of 8 bits and a constant channel count for it
_SINGLE = (0xA5, 0xAA, 0x55, 0xFF, 0xFE, 0x7E, 0x02)
"""Bytes that mark a frame alone."""
_NUMBER = re.compile(rb"(?<![\w.])(?:\d{1,2}:\d\d:\d\d(?:\.\d+)?|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_INDEXED = re.compile(rb"([A-Za-z_ \[(]*?)(\d+)([^\w.+-]+)([-+.\d].*)")
_ASIDE = re.compile(r"(?i)temp.*|.*_t|.*_temp.*|.*humid.*|rssi|.*batt.*")
"""Names of fields that are not forces."""


@dataclass(frozen=True)
class Proposal:
    """An adapter that reads a stream.

    Attributes:
        adapter: for the configuration.
        summary: what it makes of the stream, in words.
        sensors: values per frame.
    """

    adapter: Adapter
    summary: str
    sensors: int


def listen_raw(stream: ByteStream, seconds: float) -> list[tuple[float, bytes]]:
    """Return what a stream sends within ``seconds`` s, with the time of arrival, s."""
    begin, pieces = monotonic(), list[tuple[float, bytes]]()
    with suppress(OSError):
        while (now := monotonic()) - begin < seconds:
            if data := stream.read():
                pieces.append((now - begin, data))
    return pieces


def propose(pieces: Sequence[tuple[float, bytes]]) -> Proposal:
    """Return the first adapter that reads a stream.

    Args:
        pieces: bytes with the time of their arrival, s.

    Raises:
        InputError: nothing was received, or no adapter reads it; the text is in the message.
    """
    data = b"".join(piece for _, piece in pieces)
    if not data:
        raise InputError(
            "nothing received: is the board plugged in and sending? If it waits for a text, give it, as in "
            "'device.adapter={kind: text, start: s}' or poll for a text per frame"
        )
    for adapter in _candidates(data):
        if proposal := _try(adapter, pieces):
            return proposal
    raise InputError(f"no adapter reads what the board sends: {_sample(data)}")


def _sample(data: bytes) -> str:
    """Return the text that was received, or its bytes, and what may help."""
    if _is_text(data):
        lines = [line for line in re.split(rb"[\r\n]+", data) if line.strip()]
        texts = "; ".join(repr(line[:100].decode("ascii", "replace")) for line in lines[-3:])
        hint = "if it waits for a text, give start=; a pattern (docs/hardware.md) reads any lines"
        return f"the last lines are {texts}: {hint}"
    return (
        f"{len(data)} bytes that are not text, which begin with {data[:48].hex(' ')}: is the baud rate right?"
    )


def _is_text(data: bytes) -> bool:
    printable = sum(byte in b"\r\n\t" or 32 <= byte < 127 for byte in data)
    return printable > 0.95 * len(data)


def _try(adapter: Adapter, pieces: Sequence[tuple[float, bytes]]) -> Proposal | None:
    """Return a proposal if an adapter reads nearly all of a stream."""
    decoder, frames = Decoder(adapter=adapter), list[Frame]()
    try:
        for now, data in pieces:
            frames += decoder.feed(data, now)
        if decoder.frame_format is None or decoder.error() is not None:
            return None
    except InputError:
        return None
    if len(frames) < max(_FRAMES, _SHARE * (len(frames) + decoder.stats.bad_frames)):
        return None
    if adapter.kind == "protocol" and decoder.stats.check == "none" and decoder.header is None:
        return None
    passed = frames[-1].t_host - frames[0].t_host
    rate = f" at {(len(frames) - 1) / passed:.3g} Hz" if passed > 0 else ""
    detected = adapter.detect(b"".join(data for _, data in pieces), None)
    middle = np.median([frame.values for frame in frames], axis=0)[:_MOST_ROWS]
    levels = ", ".join(f"{value:.4g}" for value in middle)
    words = [f"{decoder.sensors} values{rate}", detected.summary, decoder.stats.clock, f"medians {levels}"]
    return Proposal(adapter, "; ".join(word for word in words if word), decoder.sensors or 0)


def _candidates(data: bytes) -> Iterator[Adapter]:
    yield Adapter()
    if not _is_text(data):
        yield from _binary(data)
        return
    if not {10, 13} & set(data):
        yield from _endless(data)
        return
    mark = b"\n" if b"\n" in data else b"\r"
    lines = [line.strip(b"\r\n ") for line in data.split(mark)[1:-1]]
    lines = [line for line in lines if line and not line.startswith(b"#")]
    yield from _named(Adapter(kind="json"), data, lines)
    plain = [Adapter(kind="text", decimal=sign) for sign in (".", ",")]
    labelled = [Adapter(kind="text", label=mark, decimal=sign) for mark in (":", "=") for sign in (".", ",")]
    patterns = [*_indexed(lines), *_skeleton(lines)]
    for adapter in chain(plain, labelled, patterns):
        rows = replace(adapter, rows=0, counter=None if adapter.pattern else adapter.counter)
        if _has_rows(rows, data):
            yield rows
        yield from _named(adapter, data, lines)
    for decimals in range(1, 7):
        yield Adapter(kind="text", number=rf"-?\d+\.\d{{{decimals}}}")


def _has_rows(adapter: Adapter, data: bytes) -> bool:
    return 1 < getattr(adapter.detect(data, None).frame_format, "rows", 0) <= _MOST_ROWS


def _named(adapter: Adapter, data: bytes, lines: Sequence[bytes]) -> Iterator[Adapter]:
    """Yield an adapter with names of its fields and without those that are not forces, and the adapter."""
    try:
        detected = adapter.detect(data, None).frame_format
    except InputError:
        return
    reader, roles = getattr(detected, "parse", None), getattr(detected, "roles", None)
    if detected is None or reader is None or roles is None:
        return
    names = reader.names(roles.count)
    if not names and adapter.pattern is None and getattr(reader, "separator", None):
        titles = [
            line.split(reader.separator) for line in lines if line.count(reader.separator) == roles.count - 1
        ]
        heads = [row for row in titles if all(re.match(rb"\s*[\"A-Za-z]", word) for word in row)]
        if heads:
            names = tuple(word.decode("ascii", "replace").strip(' "') for word in heads[0])
            adapter = replace(adapter, names=names)
    aside = tuple(name for name in dict.fromkeys(names) if _ASIDE.fullmatch(name.rpartition(".")[2]))
    if aside and len(aside) < len(names):
        yield replace(adapter, drop=aside)
    yield adapter


def _literal(text: bytes) -> str:
    """Return a regular expression of the text between two numbers, whatever its blanks are."""
    inner = r"\s+".join(re.escape(word) for word in text.decode("ascii", "replace").split())
    return rf"\s*{inner}\s*" if inner else r"\s+" if text else ""


def _skeleton(lines: Sequence[bytes]) -> Iterator[Adapter]:
    """Yield a pattern of the text around the numbers that most lines share."""
    shapes = Counter(map(_shape, lines))
    if not shapes:
        return
    shape = shapes.most_common(1)[0][0]
    alike = [line for line in lines if _shape(line) == shape]
    count = len(shape) - 1
    if count < 1 or len(alike) < _FRAMES:
        return
    literals = [
        Counter(_NUMBER.split(line)[place] for line in alike).most_common(1)[0][0]
        for place in range(count + 1)
    ]
    tokens = [_NUMBER.findall(line) for line in alike]
    first = count - 1
    while first > 0 and shape[first] == shape[count - 1]:
        first -= 1
    tail = count - first
    if (shape[count - 1] in (b"", b",", b";") and tail > 1) or count == 1:
        start = first if tail > 1 else 0
        start = 0 if all(text == shape[count - 1] for text in shape[1:count]) else start
        heads = _groups(tokens, literals, start, named=False)
        yield Adapter(
            kind="text", pattern=f"{heads}{_literal(literals[start])}(?P<values>.*?){_literal(literals[-1])}"
        )
    yield Adapter(kind="text", pattern=_groups(tokens, literals, count, named=True) + _literal(literals[-1]))


def _shape(line: bytes) -> tuple[bytes, ...]:
    """Return the text around the numbers of a line, whatever its blanks are."""
    return tuple(b" ".join(text.split()) for text in _NUMBER.split(line))


def _groups(tokens: Sequence[Sequence[bytes]], literals: Sequence[bytes], count: int, named: bool) -> str:
    """Return the named groups of the first ``count`` numbers, each behind the text before it."""
    parts, used = list[str](), set[str]()
    for place in range(count):
        column = [row[place] for row in tokens]
        word = re.sub(r"\W+", "_", literals[place].decode("ascii", "ignore")).strip("_").lower()
        name = word if named and word and not word[0].isdigit() else f"f{place}"
        if all(b":" in text for text in column):
            name = "time"
        else:
            with suppress(ValueError):
                numbers = np.array([float(text) for text in column])
                if place < 2:
                    name = "counter" if counts(numbers) else "time" if runs(numbers) else name
        name = name if name not in used else f"{name}_{place}"
        used.add(name)
        parts.append(rf"{_literal(literals[place])}(?P<{name}>[-+.:\w/]+)")
    return "".join(parts)


def _indexed(lines: Sequence[bytes]) -> Iterator[Adapter]:
    """Yield a pattern of lines with a word and a number of the row before the values."""
    matches = [match for line in lines if (match := _INDEXED.fullmatch(line))]
    if 2 * len(matches) < len(lines) or not matches:
        return
    before, after = (Counter(match[group] for match in matches).most_common(1)[0][0] for group in (1, 3))
    if len({match[2] for match in matches}) < 2:
        return
    yield Adapter(kind="text", pattern=rf"{_literal(before)}(?P<row>\d+){_literal(after)}(?P<values>.*)")


def _endless(data: bytes) -> Iterator[Adapter]:
    """Yield lengths of frames of text without an end."""
    classes = np.frombuffer(re.sub(rb"[-+.\d ]", b"0", data), np.uint8)
    for length in range(3, min(_LONGEST, len(data) // 4)):
        if np.mean(classes[length:] == classes[:-length]) > _SAME:
            yield Adapter(kind="text", end="", length=length)


def _binary(data: bytes) -> Iterator[Adapter]:
    """Yield structs of a fixed length between bytes that repeat."""
    for length in range(3, min(_LONGEST, len(data) // 6)):
        table = np.frombuffer(data[: len(data) // length * length], np.uint8).reshape(-1, length)
        constant = np.mean(table == np.median(table, axis=0), axis=0) > _SAME
        if not constant.any() or constant.all():
            continue
        begin, size = _longest(constant)
        ring = bytes(np.median(np.roll(table, -begin, axis=1), axis=0).astype(np.uint8)[:size])
        options = list[tuple[float, Adapter]]()
        for skip, where, mark in _marks(ring):
            shifted = np.roll(table.ravel(), -begin - skip)
            frames = shifted.reshape(-1, length)[:-1, len(mark) :]
            for spread, struct, drop in _structs(frames):
                place: dict[str, Any] = {where: mark.hex(" ")}
                described = Adapter(kind="binary", struct=struct, drop=drop, **place)
                options.append((spread - _MARKED * len(mark), described))
        yield from (adapter for _, adapter in sorted(options, key=lambda option: option[0]))


def _marks(constant: bytes) -> Iterator[tuple[int, str, bytes]]:
    """Yield what of constant bytes may be a mark: the bytes before it, ``head`` or ``tail``, and the mark."""
    for ending in (b"\r\n", b"\n"):
        if constant.endswith(ending):
            yield len(constant) - len(ending), "tail", ending
            return
    # Constant bytes of the values may stand beside the mark.
    for skip in range(min(len(constant), _LONGEST_MARK)):
        for size in range(1, min(len(constant) - skip, _LONGEST_MARK) + 1):
            mark = constant[skip : skip + size]
            if mark[-1] and (size > 1 or mark[0] in _SINGLE):
                yield skip, "head", mark


def _longest(constant: np.ndarray) -> tuple[int, int]:
    """Return begin and size of the longest run of True in a ring."""
    count, best = len(constant), (0, 0)
    for begin in range(count):
        size = next((step for step in range(count) if not constant[(begin + step) % count]), count)
        if size > best[1]:
            best = (begin, size)
    return best


def _structs(frames: np.ndarray) -> Iterator[tuple[float, dict[str, str], tuple[str, ...]]]:
    """Yield structs of frames (F, B) without their marks: how unlikely they are, and what to drop."""
    size = frames.shape[1]
    sums = np.cumsum(frames, axis=1, dtype=np.int64)[:, -2] % 256 if size > 2 else None
    xors = np.bitwise_xor.reduce(frames[:, :-1], axis=1)
    checks = [] if sums is None else [np.mean(check == frames[:, -1]) > _SAME for check in (sums, xors)]
    checked = any(checks)
    spare = 1 if checked else 0
    end, drop = ({"checksum": "u1"}, ("checksum",)) if checked else ({}, ())
    for head in _headers(frames):
        used = sum(np.dtype(kind).itemsize for kind in head.values())
        for kind in ("<f4", ">f4", "<u2", ">u2", "<i2", ">i2", "<i4", ">i4", "u1"):
            item = np.dtype(kind)
            left = size - used - spare
            if left <= 0 or left % item.itemsize:
                continue
            body = np.ascontiguousarray(frames[:, used : used + left])
            with np.errstate(invalid="ignore"):
                values = body.view(item).astype(np.float64)
            struct = head | {"force": f"({values.shape[1]},){kind}"} | end
            narrow = _NARROW * ("u1" in head.values()) + _CONSTANT * np.sum(np.ptp(values, axis=0) == 0)
            yield _spread(values, item) + narrow - len(head), struct, drop


_HEADERS = tuple(
    tuple(words.split())
    for words in ("u1", "<u2", "<u4", ">u2", ">u4", "u1 <u4", "<u2 <u4", "<u4 <u4", ">u2 >u4")
)
"""Types of a counter and a clock before the values."""


def _headers(frames: np.ndarray) -> Iterator[dict[str, str]]:
    """Yield counters and clocks before the values: none, or those that count."""
    yield {}
    for kinds in _HEADERS:
        place, head = 0, dict[str, str]()
        for kind in kinds:
            item = np.dtype(kind)
            if place + item.itemsize >= frames.shape[1]:
                break
            column = (
                np.ascontiguousarray(frames[:, place : place + item.itemsize]).view(item)[:, 0].astype(float)
            )
            part = column[:64] if item.itemsize > 1 else column[np.argmin(column) :][:64]
            name = "counter" if counts(part) and "counter" not in head else "time" if runs(part) else ""
            if not name or name in head:
                break
            head[name] = kind
            place += item.itemsize
        else:
            yield head


def _spread(values: np.ndarray, item: np.dtype) -> float:
    """Return how unlikely values (F, S) of a type are readings, 0 to 2: these keep to a part of the range."""
    turned = 0.03 * (item.str[0] == ">")
    if item.kind == "f":
        size = np.abs(values[values != 0])
        sound = np.isfinite(values).all() and bool(((size >= _SIZE[0]) & (size <= _SIZE[1])).all())
        return turned if sound else 2.0
    low, high = np.percentile(values, [5, 95], axis=0)
    wide = float(np.max((high - low) / 256**item.itemsize))
    # Of types that hold the same, the one that needs fewer bytes of zeros per value, and no sign.
    empty = np.abs(values).max() < 256 ** (item.itemsize // 2) and item.itemsize > 2
    return (
        0.1 + wide + 0.5 * empty + (0.01 if item.kind == "i" else 0.0) + (0.3 if item.itemsize == 1 else 0.0)
    )
