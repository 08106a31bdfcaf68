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


def test_a_press_is_found_and_rest_is_no_touch(board):
    seen = watch(board, frames(board, counts(force(12, (7, 9, 4, 6.0)))))
    assert seen.states(4, 7) == {"no touch"}
    assert 7 <= seen.first(3) <= 7.5 + LATE
    assert seen.kept(7.5 + LATE, 9)


def test_a_press_is_found_though_the_board_restarts(board):
    seen = watch(board, frames(board, counts(force(16, (8, 14, 4, 6.0))), restart=2.5))
    assert 8 <= seen.first(4) <= 8.5 + LATE
    assert seen.kept(8.5 + LATE, 14)


def test_frozen_values_are_unknown(board):
    values = counts(force(20))
    values[600:1500] = values[600]
    seen = watch(board, frames(board, values))
    assert seen.states(11 + LATE, 15) == {"unknown"}
    assert seen.states(16.5, 20) == {"no touch"}


def test_a_token_for_a_missing_value_is_unknown_and_keeps_the_alarm(board):
    values = counts(force(18, (6, 12, 7, 6.0)))
    values[800:1400, 7] = NUMBER
    seen = watch(board, frames(board, values))
    assert seen.first(3) <= 6.5 + LATE
    assert seen.kept(6.5 + LATE, 12)
    assert "no touch" not in seen.states(6.2 + LATE, 14)
    assert seen.states(17, 18) == {"no touch"}


@pytest.mark.parametrize("cut", [-1, 0])
def test_a_cut_wire_is_unknown(board, cut):
    """Without a header nobody knows what the converter can give: the channel falls far below rest."""
    values = counts(force(16, (6, 10, 7, 6.0)))
    values[800:1400, 7] = cut
    seen = watch(board, frames(board, values))
    assert seen.first(3) <= 6.5 + LATE
    assert seen.kept(6.5 + LATE, 10)
    assert "no touch" not in seen.states(6.2 + LATE, 14)


def test_silence_is_unknown(board):
    seen = watch(board, [*frames(board, counts(force(5))), 3.0, *frames(board, counts(force(1)))])
    assert seen.states(3, 5) == {"no touch"}
    assert seen.states(5.7, 8) == {"unknown"}


def test_damaged_frames_hide_no_press(board):
    """A tenth of the frames loses a byte."""
    randomness, pieces = np.random.default_rng(5), []
    for piece in frames(board, counts(force(12, (7, 9, 4, 6.0)))):
        if randomness.random() < 0.1:
            position = int(randomness.integers(len(piece)))
            piece = piece[:position] + piece[position + 1 :]
        pieces.append(piece)
    seen = watch(board, iter(pieces))
    assert seen.first(7) <= 7.5 + LATE
    assert seen.kept(7.5 + LATE, 9)
