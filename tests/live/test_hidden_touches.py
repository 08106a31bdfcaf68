"""Streams of our protocol or of other boards: a dangerous touch is hidden for half a second at most."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from skin.errors import InputError
from skin.live.engine import DebounceSettings
from skin.wire.protocol import Header, encode_header, encode_line
from tests.live.memory_view import LOOK, MemoryView
from tests.live.test_safety import HEADER, LATE, RATE, SCALE, SENSORS, counted, force, lines, settings, watch

HIDDEN = 0.5 + 2 * LOOK  # s: a decision may be so old, and the display is looked at so often
COUNTS = encode_header(Header(n=SENSORS, rate=RATE, unit="adc", bits=10, id="left"))


def clocked(values, clock, counter=int):
    """Yield the bytes of readings (F, S) with the device's ``clock(t)``, s, and its counter."""
    for number, row in enumerate(values):
        line = encode_line(row.round(4), counter(number), round(1e6 * clock(number / RATE)) % 2**32)
        yield line if number else HEADER + line


def creeping(t):
    return min(t, 9.0) + 1e-4 * max(t - 9.0, 0.0)


@pytest.mark.parametrize(
    ("clock", "each"),
    [
        (creeping, 1),
        (creeping, 100),
        (lambda t: min(t, 9.0), 1),  # stops
        (lambda t: t / 30, 100),
        (lambda t: t / 100, 1),
        (lambda t: float(int(t)), 100),  # whole seconds
    ],
)
def test_a_clock_that_is_wrong(clock, each):
    seen = watch(clocked(force(28, (10, 18, 4, 6.0), (24, 26, 2, 6.0)), clock), each)
    late = HIDDEN + (each > 1)  # a second between two deliveries
    assert seen.hidden(10, 18) <= late
    assert seen.hidden(24, 26) <= late
    assert seen.first(9) <= 10 + 4.5 + each / RATE
    assert 24 <= seen.first(23) <= 24.5 + each / RATE
    assert "clock" in seen.notes(20, 28)
    assert seen.states(22.6, 23.9) == {"no touch"}


def test_a_counter_that_stands_still_keeps_no_alarm():
    seen = watch(clocked(force(16, (8, 10, 4, 6.0)), lambda t: t, lambda n: min(n, 900)))
    assert 8 <= seen.first(7) <= 8.5
    assert seen.states(13.5, 16) == {"no touch"}


@pytest.mark.parametrize("changes", [{"unit": "N"}, {"bits": 8}, {"id": "right"}, {"rate": 50.0}])
def test_a_header_that_changes(changes):
    """As after a new firmware: each second of the stream has the other header from 6 s on."""
    other = encode_header(replace(Header(n=SENSORS, rate=RATE, unit="adc", bits=10, id="left"), **changes))
    stream = []
    for number, data in enumerate(lines(force(20, (8, 13, 4, 6.0)), header=b"", encode=counted)):
        stream.append((COUNTS if number < 600 else other) * (number % 100 == 0) + data)
    with pytest.raises(InputError, match="header of the device has changed") as refused:
        watch(stream, scale=SCALE)
    assert next(iter(changes)) in str(refused.value)
    seen = watch(stream[:1100], scale=SCALE)
    assert seen.hidden(8, 11) <= HIDDEN
    assert seen.states(6.7, 11) == {"unknown"}


@pytest.mark.parametrize("restart", [None, 10.0])
def test_a_device_that_tares_itself(restart):
    """Under a press, in ``setup()``, or slowly, as firmware does that follows its own baseline."""
    values = force(30, (8, 16, 4, 6.0), (22, 24, 4, 6.0))
    if restart is None:
        values[:, 4] -= np.interp(np.arange(3000) / RATE, [9, 14, 16, 18], [0, 6, 6, 0])
    else:
        values[1000:, 4] -= 6.0
    seen = watch(lines(values, restart=restart))
    if restart is not None:
        assert seen.kept(8.6, 16)
        assert seen.hidden(8, 16) <= HIDDEN
        assert not seen.kept(20, 21)
    # Falling below rest tells; from then on there is no baseline.
    assert seen.states(17, 21.9) == {"unknown"}
    assert seen.hidden(16.5, 30) == 0
    assert "void" in seen.notes(17, 30)


@pytest.mark.parametrize(("load", "beside"), [(13.0, 0.0), (2.0, 0.2)])
def test_a_tare_under_a_load(load, beside):
    values = force(24, (0, 8, 4, load), (14, 22, 4, 5.0))
    seen = watch(lines(values), engine=overlapping(beside))
    assert seen.states(3, 7.9) == {"no touch"}  # nothing shows yet
    assert seen.states(8.5, 13.9) == {"unknown"}
    assert seen.hidden(8.5, 24) == 0


def test_a_baseline_above_the_stored_rest_is_void_at_once():
    """As `verify` finds it: nothing is shown as no touch."""
    raised = np.where(np.arange(SENSORS) == 4, 6.0, 0.01)
    values = force(12, (0, 12, 4, 6.0), (8, 9, 2, 6.0))
    seen = watch(lines(values), verify=lambda conversion: raised)
    assert seen.hidden(3, 12) == 0
    assert seen.notes(3, 7) >= {"void"}
    assert 8 <= seen.first(7) <= 8.5


def test_slow_drift_voids_nothing():
    """Five thresholds in 20 s; presses alarm afterwards, though they end below the limit above the tare."""
    presses = [(26 + 5 * n, 27 + 5 * n, n, 5.0) for n in range(2)]
    values = force(34, *presses) - np.interp(np.arange(3400) / RATE, [4, 24], [0, 1.5])[:, None]
    seen = watch(lines(values))
    for begin, *_ in presses:
        assert begin <= seen.first(begin - 1) <= begin + 0.5
    assert "void" not in seen.notes(3, 34)
    assert seen.states(4, 25.9) == {"no touch"}


def over_range(word):
    """Return what writes the fields of a line; above 3 N one is a word."""
    return lambda row: ",".join(word if value > 3 else f"{value:.3f}" for value in row)


def cut(row):  # a line that breaks off above 3 N
    return over_range("")(row)[: 20 if row.max() > 3 else None]


def hexadecimal(row):
    """Write counts that have letters under a press alone: the whole line is unreadable."""
    return " ".join(f"{0x200 + (int(value / SCALE) if value > 0.3 else 5):03X}" for value in row)


@pytest.mark.parametrize("write", [*map(over_range, ("nan", "OL", "3e38")), cut, hexadecimal])
@pytest.mark.parametrize("length", [0.1, 0.3, 4.0])
def test_values_that_are_lost_under_a_press(write, length):
    presses = [(8 + 6 * n, 8 + 6 * n + length, 2 * n, 6.0) for n in range(3)]
    values = force(26, *presses)
    ramp = np.r_[np.linspace(0, 1, 6), np.ones(1), np.linspace(1, 0, 6)]
    values = np.apply_along_axis(lambda column: np.convolve(column, ramp / ramp.sum(), "same"), 0, values)
    stream = [f"{write(row)}\n".encode() for row in values]
    seen = watch(stream, scale=SCALE if write is hexadecimal else 1.0)
    for begin, end, *_ in presses:
        assert seen.hidden(begin, end + 0.3) <= HIDDEN
        after = begin + (HIDDEN if write is cut else 0.2)  # without frames there is no verdict
        touch = [look for look in seen.looks if after < look.t < end]
        assert all(look.danger is not False for look in touch)
        words = {word for look in seen.looks if begin < look.t < end + 1 for word in look.words}
        assert "safe" not in words
        # Of lines that are lost from the beginning nothing may be left.
        assert words & {"dangerous", "dangerous?"} or (write, length) == (hexadecimal, 0.1)
    assert seen.states(5, 7.9) == {"no touch"}


def test_a_dead_channel_hides_no_frames_that_are_lost_under_a_touch():
    values = force(16, (12, 16, 2, 2.0))
    values[:, 7] = 0.0
    stream = enumerate(zip(lines(values), values, strict=True))
    kept = ((n / RATE, data) for n, (data, row) in stream if row.max() < 1 or n % 4 == 0)
    assert "unreadable" in MemoryView(kept, settings()).notes(13, 16)


def test_frames_of_a_link_that_is_a_tenth_slower_than_the_board_are_unknown():
    late = ((1.1 * n / RATE, data) for n, data in enumerate(lines(force(60, (50, 52, 4, 6.0)))))
    assert MemoryView(late, settings()).states(25, 66) == {"unknown"}


def test_what_a_long_touch_lifts_beside_it_is_no_touch_afterwards():
    seen = watch(lines(force(30, (8, 20, 4, 20.0), (8, 20, 5, -0.8))))
    assert seen.states(25, 30) == {"no touch"}


def test_a_restart_is_no_sign_of_life():
    values = np.where((np.arange(3000) > 999)[:, None] & (np.arange(SENSORS) == 4), 0.01, force(30))
    assert watch(lines(values, restart=4.0)).states(16, 30) == {"unknown"}


@pytest.mark.parametrize("lost", ["frames", "values"])
def test_what_is_lost_at_random_makes_no_touch_doubtful(lost):
    probability, values = np.random.default_rng(0), force(30, (8, 28, 4, 2.0))
    if lost == "frames":
        stream = [data for data in lines(values) if probability.random() > 0.1]
    else:
        values[probability.random(values.shape) < 0.01] = np.nan
        stream = [",".join(map(str, row)).encode() + b"\n" for row in values]
    seen = watch(stream, scale=1.0)
    assert not seen.notes(0, 30) & {"unreadable", "over_range"}
    assert {look.danger for look in seen.looks if 12 < look.t < 26} == {False}


def overlapping(fraction):
    """Return settings of a skin on whose neighbours a press reads a part."""
    presses = 5.0 * np.eye(SENSORS)
    for sensor in range(SENSORS - 1):
        presses[sensor, sensor + 1] = presses[sensor + 1, sensor] = 5.0 * fraction
    return replace(settings(), presses=presses)


@pytest.mark.parametrize("fraction", [0.04, 0.2])
def test_a_wire_that_breaks_to_its_rest_value(fraction):
    touches = [(8, 18, 4, 6.0), (8, 18, 3, 6.0 * fraction), (8, 18, 5, 6.0 * fraction)]
    values = force(24, *touches)
    values[1200:, 4] = np.random.default_rng(1).normal(scale=0.02, size=1200)
    seen = watch(lines(values), engine=overlapping(fraction))
    assert seen.kept(8.6, 18)
    assert "lost_wire" in seen.notes(12.5, 18)
    assert seen.hidden(8, 18) <= HIDDEN
    assert not seen.kept(20.5, 22)
    assert "no touch" not in seen.states(20.5, 22) or fraction == 0.2  # where the neighbours feel a press


def test_a_finger_that_slides_or_lifts_breaks_no_wire():
    fraction, times = 0.2, np.arange(2400) / RATE
    values = force(24)
    position = np.interp(times, [8, 12], [3.0, 5.0])  # one pitch in 2 s
    for sensor in range(SENSORS):
        near = np.clip(1 - np.abs(position - sensor), 0, 1)
        felt = near + fraction * np.clip(1 - np.abs(np.abs(position - sensor) - 1), 0, 1)
        values[:, sensor] += 6.0 * felt * ((times > 7) & (times < 14))
    seen = watch(lines(values), engine=overlapping(fraction))
    assert "lost_wire" not in seen.notes(0, 24)
    assert seen.states(18, 24) == {"no touch"}


def test_a_block_that_is_sent_again_and_again():
    """The device, or a bridge, is stuck: what was read in half a second comes ever again."""
    values = force(20, (12, 15, 4, 6.0))
    values[600:1900] = np.tile(values[550:600], (26, 1))
    seen = watch(lines(values))
    assert seen.states(3, 6) == {"no touch"}
    assert seen.states(6.6, 18.9) == {"unknown"}
    assert seen.states(19.7, 20) == {"no touch"}


def test_few_values_that_alternate_are_no_block():
    """Noise of one count, in step with the frames on some channels."""
    values = np.round(force(20, (12, 15, 4, 6.0)) / SCALE + 200)
    values[:, :6] += np.arange(2000)[:, None] % 2
    seen = watch(lines(values, encode=lambda row: row.astype(int)), scale=SCALE)
    assert seen.states(3, 11.9) == {"no touch"}
    assert 12 <= seen.first(11) <= 12.5


def sure(readings, valid):
    """Return probabilities: a touch is dangerous with .98 above 4 N."""
    danger = np.where(readings.max(axis=(1, 2)) > 4, 0.98, 0.02)
    return np.repeat(danger[:, None], 4, axis=1)


@pytest.mark.parametrize(("above", "danger"), [(0.99, {None}), (0.9, {True})])
def test_probably_dangerous_is_not_safe(above, danger):
    strict = replace(settings(), classify=sure, patience=DebounceSettings(above=above))
    seen = watch(lines(force(12, (6, 8, 4, 6.0))), engine=strict)
    during = [look for look in seen.looks if 6.6 < look.t < 8]
    assert {look.danger for look in during} == danger
    words = {word for look in during for word in look.words}
    assert words & {"safe", "dangerous?", "dangerous"} == {"dangerous" if True in danger else "dangerous?"}
    assert ("near_threshold" in seen.notes(6.6, 8)) is (None in danger)


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


def frames(name, values, restart=None):
    """Yield the bytes of counts (F, S); the device restarts every ``restart`` s, with a banner."""
    encode = BOARDS[name][1]
    every = len(values) if restart is None else round(restart * RATE)
    for number, row in enumerate(values.tolist()):
        banner = b"" if number % every or restart is None else b"\r\nBooting...\r\nok\r\n"
        yield banner + encode(number % every, row)


def view_of(name, stream):
    return watch(stream, adapter=BOARDS[name][0], scale=SCALE)


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
    stream = frames(board, counted(force(14, (7, 11, 4, 6.0))), restart)
    seen = view_of(board, damaged(stream) if trouble == "damage" else stream)
    assert "no touch" in seen.states(4, 7)
    assert 7 <= seen.first(3 if trouble == "none" else 7) <= 7.5 + LATE
    assert seen.kept(7.5 + LATE, 11)


def test_frozen_values_and_silence_are_unknown(board):
    values = counted(force(20))
    values[600:1500] = values[600]
    seen = view_of(board, [*frames(board, values), 3.0, *frames(board, counted(force(1)))])
    assert seen.states(11 + LATE, 15) == {"unknown"}
    assert seen.states(16.5, 20) == {"no touch"}
    assert seen.states(20.7, 23) == {"unknown"}


@pytest.mark.parametrize("sent", [NUMBER, -1, 0, 125])
def test_a_token_for_a_missing_value_or_a_cut_wire_is_unknown_and_keeps_the_alarm(board, sent):
    """Without a header nobody knows what the converter can give: the channel falls far below rest."""
    values = counted(force(24, (6, 12, 7, 6.0), (20, 21, 7, 6.0)))
    values[800:1400, 7] = sent
    seen = view_of(board, frames(board, values))
    assert seen.first(3) <= 6.5 + LATE
    assert seen.kept(6.5 + LATE, 12)
    assert "no touch" not in seen.states(6.2 + LATE, 14)
    assert not seen.kept(19, 20)
    assert 20 <= seen.first(19.5) <= 20.5 + LATE
    assert sent != NUMBER or seen.states(17, 18) == {"no touch"}
