"""Boards with formats of their own: whatever breaks is unknown, and no dangerous touch is hidden or late."""

import json
import struct

import numpy as np
import pytest

from tests.live.memory_view import MemoryView
from tests.live.test_safety import LATE, RATE, SCALE, SENSORS, arriving, force, settings

WORD, NUMBER = "off", -999
JSON = {"kind": "json", "invalid": [NUMBER]}
STRUCT = {"time": "<u4", "force": f"({SENSORS},)<i2"}
BINARY = {"kind": "binary", "struct": STRUCT, "head": "aa 55", "tail": "0d 0a", "invalid": [NUMBER]}
ROWS = {"kind": "text", "rows": 0, "invalid": [WORD]}


def to_json(n, row):
    """Return a line with a clock in ms and no counter."""
    return json.dumps({"ms": 10 * n + 400, "f": row}).encode() + b"\n"


def to_binary(n, row):
    """Return a frame with a clock in us and no checksum."""
    return b"\xaa\x55" + struct.pack(f"<I{SENSORS}h", 10_000 * n + 400, *row) + b"\r\n"


def to_rows(n, row):
    """Return three lines and an empty one, without clock and counter."""
    words = [WORD if value == NUMBER else str(value) for value in row]
    return "".join(" ".join(words[position : position + 3]) + "\n" for position in (0, 3, 6)).encode() + b"\n"


BOARDS = {"json": (JSON, to_json), "binary": (BINARY, to_binary), "rows": (ROWS, to_rows)}
"""Adapter, and encoder of a frame."""


def counts(newtons):
    return np.round(200 + newtons / SCALE).astype(int)


def frames(name, values, restart=None):
    """Yield the bytes of counts (F, S); the device restarts every ``restart`` s, with a banner."""
    encode = BOARDS[name][1]
    every = len(values) if restart is None else round(restart * RATE)
    for number, row in enumerate(values.tolist()):
        banner = b"" if number % every or restart is None else b"\r\nBooting...\r\nok\r\n"
        yield banner + encode(number % every, row)


def watch(name, stream):
    return MemoryView(arriving(stream), settings(), adapter=BOARDS[name][0], scale=SCALE)


@pytest.fixture(params=["json", "binary", "rows"])
def board(request):
    return request.param


def damaged(stream):
    """Yield frames of which a tenth loses a byte."""
    draw = np.random.default_rng(5)
    for piece in stream:
        position = int(draw.integers(len(piece)))
        yield piece[:position] + piece[position + 1 :] if draw.random() < 0.1 else piece


@pytest.mark.parametrize("trouble", ["none", "restarts", "damage"])
def test_a_press_is_found_and_rest_is_no_touch(board, trouble):
    restart = 2.5 if trouble == "restarts" else None
    stream = frames(board, counts(force(14, (7, 11, 4, 6.0))), restart)
    seen = watch(board, damaged(stream) if trouble == "damage" else stream)
    assert "no touch" in seen.states(4, 7)
    assert 7 <= seen.first(3 if trouble == "none" else 7) <= 7.5 + LATE
    assert seen.kept(7.5 + LATE, 11)


def test_frozen_values_and_silence_are_unknown(board):
    values = counts(force(20))
    values[600:1500] = values[600]
    seen = watch(board, [*frames(board, values), 3.0, *frames(board, counts(force(1)))])
    assert seen.states(11 + LATE, 15) == {"unknown"}
    assert seen.states(16.5, 20) == {"no touch"}
    assert seen.states(20.7, 23) == {"unknown"}


@pytest.mark.parametrize("sent", [NUMBER, -1, 0])
def test_a_token_for_a_missing_value_or_a_cut_wire_is_unknown_and_keeps_the_alarm(board, sent):
    """Without a header nobody knows what the converter can give: the channel falls far below rest."""
    values = counts(force(24, (6, 12, 7, 6.0), (20, 21, 7, 6.0)))
    values[800:1400, 7] = sent
    seen = watch(board, frames(board, values))
    assert seen.first(3) <= 6.5 + LATE
    assert seen.kept(6.5 + LATE, 12)
    assert "no touch" not in seen.states(6.2 + LATE, 14)
    assert not seen.kept(19, 20)
    assert 20 <= seen.first(19.5) <= 20.5 + LATE
    assert sent != NUMBER or seen.states(17, 18) == {"no touch"}
