"""Propose structs of binary frames: the fewer bits the changes of the values need, the more plausible.

Bytes that are read in another order, from another position or as another type jump.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from skin.wire.adapter import Adapter, is_text, read_adapter, try_fields
from skin.wire.clocks import UNITS
from skin.wire.formats import counts, runs
from skin.wire.protocol import Line

SAME = 0.98
"""Part of the bytes or characters that repeat from frame to frame; others are damaged."""
_KINDS = ("<f4", ">f4", "<u2", ">u2", "<i2", ">i2", "<i4", ">i4", "<i3", ">i3", "u1")
_HEADERS = tuple(
    tuple(words.split())
    for words in ("", "u1", "<u2", "<u4", ">u2", ">u4", "u1 <u4", "<u2 <u4", "<u4 <u4", ">u2 >u4")
)
"""Types of values, and of a counter and a clock before them."""


def binary_adapters(data: bytes, seconds: float, longest: int = 512) -> Iterator[Adapter]:
    """Yield adapters of frames of a fixed length between bytes that repeat, the most plausible first.

    Args:
        data: what was received.
        seconds: in which it was.
        longest: bytes of a frame.
    """
    if is_text(data):
        return
    options = list[tuple[float, Adapter]]()
    for length in range(3, min(longest, len(data) // 6)):
        table = np.frombuffer(data[: len(data) // length * length], np.uint8).reshape(-1, length)
        constant = np.mean(table == np.median(table, axis=0), axis=0) > SAME
        if not constant.any() or constant.all():
            continue
        begin, ring = _longest(constant), np.median(table, axis=0).astype(np.uint8)
        for skip in range(begin[1]):
            for size in range(1, min(begin[1] - skip, 4) + 1):
                mark = bytes(np.roll(ring, -begin[0] - skip)[:size])
                frames = np.roll(table.ravel(), -begin[0] - skip).reshape(-1, length)[:-1, size:]
                tail = mark in (b"\r\n", b"\n")
                position: dict[str, Any] = {"tail" if tail else "head": mark.hex(" ")}
                options += [
                    (
                        cost + _mark_cost(mark),
                        Adapter(kind="binary", struct=struct, drop=drop, **position, **roles),
                    )
                    for cost, struct, drop, roles in _structs(frames, seconds * length / len(data))
                ]
        if options:
            break
    options.sort(key=lambda option: option[0])
    yield from _chips(data)
    yield from (adapter for cost, adapter in options[:4] if cost < options[0][0] + 2)


def _chips(data: bytes) -> Iterator[Adapter]:
    """Yield the adapter of chips of which each sends four floats, the first its temperature."""
    chips = read_adapter("anyskin_binary")
    for layout in chips.layouts(data):
        reads = (try_fields(layout, piece) for piece in layout.split(data)[0])
        table = np.array([read.fields for read in reads if isinstance(read, Line)])
        temperatures = np.median(table, axis=0)[::4]
        if len(temperatures) > 1 and np.ptp(temperatures) < 3 and (abs(temperatures - 30) < 20).all():
            yield chips


def _mark_cost(mark: bytes) -> float:
    """Return how unlikely bytes mark a frame: zeros and small numbers are rather parts of values."""
    return sum(1.5 for byte in mark if byte in (0, 1)) + 0.5 * (len(mark) == 1) - 0.2 * len(mark)


def _longest(constant: np.ndarray) -> tuple[int, int]:
    """Return begin and size of the longest run of True in a ring."""
    count = len(constant)
    sizes = [
        next((step for step in range(count) if not constant[(begin + step) % count]), count)
        for begin in range(count)
    ]
    return int(np.argmax(sizes)), max(sizes)


def _structs(
    frames: np.ndarray, period: float
) -> Iterator[tuple[float, dict[str, str], tuple[str, ...], dict[str, Any]]]:
    """Yield structs of frames (F, B) without marks: bits that their changes need, what to drop, roles."""
    for header in _HEADERS:
        head, roles, used = dict[str, str](), dict[str, Any](counter=None, time=None), 0
        for kind in header:
            if used + int(kind[-1]) >= frames.shape[1]:
                break
            column = _numbers(frames, used, kind, 1)[:, 0]
            counting = counts(column[:256], wraps=True)
            ticks = [np.median(np.diff(column)) * unit / (period or 1) for unit in UNITS.values()]
            clock = runs(column[:64]) and any(0.6 < tick < 1.6 for tick in ticks)
            name = "counter" if counting and "counter" not in head else "time" if clock else ""
            if not name or name in head:
                break
            head[name], roles[name], used = kind, name, used + int(kind[-1])
        if len(head) < len(header):
            continue
        for spare, end, drop, cost in _tails(frames[:, used:]):
            for kind in _KINDS:
                count, odd = divmod(frames.shape[1] - used - spare, int(kind[-1]))
                if count < 1 or odd:
                    continue
                bits = _bits(_numbers(frames, used, kind, count), kind)
                if np.isfinite(bits):
                    yield bits + cost, head | {"force": f"({count},){kind}"} | end, drop, roles


def _tails(body: np.ndarray) -> Iterator[tuple[int, dict[str, str], tuple[str, ...], float]]:
    """Yield the size of a checksum at the end of bodies (F, B), its type, what to drop, its cost in bits."""
    sums = body[:, :-1].sum(axis=1) % 256, np.bitwise_xor.reduce(body[:, :-1], axis=1)
    if body.shape[1] > 2 and any(np.mean(check == body[:, -1]) > SAME for check in sums):
        yield 1, {"checksum": "u1"}, ("checksum",), 0.0
        return
    yield 0, {}, (), 0.0
    random = np.abs(np.diff(body.astype(int), axis=0)).mean(axis=0) > 60  # 85 of bytes drawn at random
    for size, kind in ((1, "u1"), (2, "<u2")):
        if body.shape[1] > size and random[-size:].all():
            yield size, {"checksum": kind}, ("checksum",), 4.0 * size


def _numbers(frames: np.ndarray, first: int, kind: str, count: int) -> np.ndarray:
    """Return numbers (F, N) of a type from byte ``first`` on."""
    reader = Adapter(kind="binary", struct={"n": f"({count},){kind}"}, head="00").struct_reader(
        len(frames), 0
    )
    data = np.ascontiguousarray(frames[:, first : first + count * int(kind[-1])])
    return np.array(reader(data.tobytes()).fields).reshape(len(frames), count)


def _bits(values: np.ndarray, kind: str) -> float:
    """Return the bits per frame that the changes of values (F, S) need: few where bytes are read as sent."""
    if kind.endswith("f4"):
        size = np.abs(values[values != 0])
        if not np.isfinite(values).all() or not ((size >= 1e-4) & (size <= 1e7)).all():
            return np.inf
        values = values / max(np.median(np.abs(values)), 1e-3) * 2**12  # about three digits
    bits = np.log2(1 + 2 * np.abs(np.diff(values, axis=0))).mean(axis=0)
    if (bits > 0.7 * 8 * int(kind[-1])).any():  # as of random bytes
        return np.inf
    return float(bits.sum() + 2 * np.count_nonzero(np.ptp(values, axis=0) == 0))
