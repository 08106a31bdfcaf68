"""Adapters: their settings, what a board is told, any bytes; the proposed one reads what a board sends."""

import json
from collections.abc import Callable
from contextlib import suppress
from time import process_time

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from skin.core.files import CONF
from skin.errors import InputError
from skin.wire.adapter import Adapter, read_adapter
from skin.wire.decoder import Decoder
from skin.wire.proposal import propose
from skin.wire.protocol import Header, encode_header
from skin.wire.reader import Port, WireFeed
from tests.damage import DAMAGED_FILES

NAMED = sorted(path.stem for path in (CONF / "adapters").glob("*.yaml"))
quickly = settings(DAMAGED_FILES, max_examples=60)
OTHERS = {
    "pattern": Adapter(kind="text", pattern=r"<(?P<counter>\d+)\|(?P<values>[^>]*)>"),
    "decimal": Adapter(kind="text", decimal=",", separator=";"),
    "struct": Adapter(kind="binary", struct={"counter": "u1", "f": "(3,)<i2"}, head="aa 55"),
    "index": Adapter(kind="text", rows=0, index=0),
    "hex": Adapter(kind="text", base=16),
}
ALL = {name: read_adapter(name) for name in NAMED} | OTHERS | {"protocol": Adapter()}
ROWS = st.lists(st.lists(st.integers(-9, 2000), min_size=1, max_size=5), max_size=30)
TEXTS = st.one_of(
    st.binary(max_size=200),
    st.text(alphabet='0123456789,.;:-+eE \t\r\n"{}[]<>|nafov', max_size=300).map(str.encode),
    st.just(b"1e308,1\n-1e308,1\n" + b"f" * 5000 + b",1\n"),
    ROWS.map(lambda rows: "".join(",".join(map(str, row)) + "\n" for row in rows).encode()),
)


@pytest.mark.parametrize("name", NAMED)
def test_every_shipped_adapter_is_read_and_written(name, tmp_path):
    path = tmp_path / "board.yaml"
    path.write_text(ALL[name].describe())
    assert read_adapter(str(path)) == ALL[name]
    assert Port(adapter=name).frames == ALL[name]


@pytest.mark.parametrize(
    ("described", "said"),
    [
        ("cvs", "there is no device.adapter=cvs: there are .*csv"),
        ("absent.yaml", "absent.yaml cannot be read"),
        ({"kind": "text", "seperator": ";"}, "no setting seperator: did you mean separator"),
        ({"kind": "text", "pattern": "(?P<a"}, "not a regular expression"),
        ({"kind": "text", "pattern": r"\d+"}, "needs a named group"),
        ({"kind": "text", "decimal": ",", "separator": ","}, "cannot separate fields"),
        ({"kind": "text", "end": ""}, "end is empty: leave it out"),
        ({"kind": "binary"}, "need a struct"),
        ({"kind": "binary", "struct": {"f": "<u2"}}, "need a head or a tail"),
        ({"kind": "binary", "struct": {"f": "<q9"}, "head": "aa"}, "device.adapter.struct="),
        ({"kind": "binary", "struct": {"f": "O"}, "head": "aa"}, "numbers alone"),
        ({"kind": "binary", "struct": {"f": "<u2"}, "head": "xy"}, "not bytes in hexadecimal"),
        ({"kind": "binary", "struct": {"f": "(99999,)<u2"}, "head": "aa"}, "at most 32768"),
    ],
)
def test_a_wrong_description_is_one_sentence(described, said):
    with pytest.raises(InputError, match=said) as error:
        read_adapter(described)
    assert "\n" not in str(error.value)


def test_fields_that_the_board_does_not_send_are_named():
    decoder = Decoder(adapter=Adapter(kind="text", label="=", drop=("temperature",)))
    with pytest.raises(InputError, match=r"names a field temperature, the board sends 2 fields.*a, b"):
        decoder.feed(b"a=1 b=2\n" * 40)


def test_lines_that_do_not_match_are_shown_with_the_field_that_failed():
    decoder = Decoder(4, adapter=read_adapter("csv"))
    for n in range(60):
        decoder.feed(b"12,13,%dmm,14\n" % n, 0.1 * n)
    error = str(decoder.error())
    assert all(f"'12,13,{n}mm,14' (field '{n}mm' is not a number)" in error for n in (57, 58, 59))
    assert "adapter=auto" in error


@pytest.mark.parametrize("name", ALL)
@given(pieces=st.lists(TEXTS, max_size=10), sensors=st.sampled_from([None, 1, 3]))
@quickly
def test_nothing_but_a_sentence_is_raised(name, pieces, sensors):
    decoder = Decoder(sensors, adapter=ALL[name])
    for now, piece in enumerate(pieces):
        with suppress(InputError):
            for frame in decoder.feed(piece, float(now)):
                assert np.isfinite(frame.values).all()
                assert len(frame.values) == decoder.sensors
    decoder.error()
    decoder.explain()


@given(pieces=st.lists(TEXTS, max_size=10))
@settings(quickly, max_examples=15)
def test_a_proposal_of_anything_is_one_or_a_sentence(pieces):
    with suppress(InputError):
        assert propose(list(enumerate(pieces)))[0].sensors > 0


def encoded(name, n, row):
    if name == "struct":
        return b"\xaa\x55" + bytes([n % 256]) + np.array(row, "<i2").tobytes()
    if name == "index":
        return b"".join(b"%d,%d\n" % pair for pair in enumerate(row))
    return b"%d,%d,%d\n" % tuple(row)


@pytest.mark.parametrize("name", ["csv", "struct", "index"])
def test_a_lost_byte_of_a_frame_without_a_checksum_is_not_two_wrong_frames(name):
    rows = np.random.default_rng(5).integers(300, 700, (600, 3)).tolist()
    rng, wrong = np.random.default_rng(6), 0
    decoder = Decoder(3, adapter=ALL[name])
    for n, row in enumerate(rows):
        frame = encoded(name, n, row)
        position = int(rng.integers(len(frame)))
        spoilt = n > 100 and n % 10 == 0
        for decoded in decoder.feed(frame[:position] + frame[position + spoilt :]):
            wrong += decoded.values.tolist() not in rows
    assert wrong <= 50  # at most the spoilt ones, of which a digit is lost
    assert decoder.stats.frames > 480
    if name == "struct":
        assert wrong == 0


class Board:
    """A stream that answers what it is told."""

    def __init__(self, answer):
        self.received, self._answer, self._sent = b"", answer, b""

    def write(self, data):
        self.received += data
        self._sent += self._answer(data)

    def read(self):
        data, self._sent = self._sent, b""
        return data

    def close(self):
        pass


@pytest.mark.parametrize(
    ("adapter", "answer", "told"),
    [
        ({"start": "go\r", "stop": "end\r"}, lambda data: b"7,8,5\n" * 40 * (data == b"go\r"), b"go\rend\r"),
        ({"poll": "?"}, lambda data: b"1,2,3\n", b"?" * 60),
        ({"start": "go"}, lambda data: b"type go\n", b"go" * 6),
        ({"poll": "go"}, lambda data: b"", b"go" * 20),
    ],
)
def test_a_board_is_told_to_start_for_each_frame_and_to_stop(adapter, answer, told):
    board = Board(answer)
    feed = WireFeed(lambda: board, Decoder(3, adapter=Adapter(kind="text", **adapter)))
    frames = [frame for step in range(60) for frame in feed.poll(lambda step=step: 0.1 * step)]
    feed.close()
    assert board.received == told
    text = next(iter(adapter.values()))
    sent = f"the string {text!r} of the adapter was sent without an answer"
    assert feed.unanswered == ("" if frames else sent)
    assert bool(frames) == (answer(b"go\r")[:1].isdigit())


RATE = 50.0  # Hz
COUNT = 250
SHIPPED = dict.fromkeys(("csv", "matrix_rows", "protocol"), b"%d,2,3\n")
SHIPPED |= {"anyskin": b"25.00%d.00-1.250.17\n", "anyskin_binary": b"%d"}
SHIPPED |= {"arduino_plotter": b"a:%d,b:2\n", "json_lines": b'{"a":%d,"b":2}\n'}


def table(sensors, digits=0, base=300.0, spread=4.0):
    rng = np.random.default_rng(sensors)
    return np.round(base + 30 * np.arange(sensors) + rng.normal(0, spread, (COUNT, sensors)), digits)


def words(row, shape="%d"):
    return [shape % value for value in row]


def joined(separator, end="\n", shape="%d", before="", after=""):
    return lambda n, row: (before + separator.join(words(row, shape)) + after + end).encode()


def labelled(template, separator, end="\n", shape="%d"):
    return lambda n, row: (
        separator.join(template.format(k, shape % value) for k, value in enumerate(row)) + end
    ).encode()


def clocked(tick, separator=",", counter=None, first=0, shape="%d"):
    """Return lines with a clock of ``tick`` units per frame, and a counter of a modulus."""

    def line(n, row):
        head = [] if counter is None else [str(n % counter)]
        clock = [shape % (first + n * tick)] if tick else []
        return (separator.join([*head, *clock, *words(row)]) + "\n").encode()

    return line


def matrix(columns, between=b"\n", index=None, end="\n", shape="%d"):
    def frame(n, row):
        rows = np.reshape(row, (-1, columns))
        heads = [[] if index is None else [str(index + k)] for k in range(len(rows))]
        lines = [head + words(values, shape) for head, values in zip(heads, rows, strict=True)]
        text = "".join(",".join(line) + end for line in lines).encode()
        return text + (between(n) if callable(between) else between)

    return frame


def pairs(template, first=0):
    return lambda n, row: "".join(template.format(first + k, round(v)) for k, v in enumerate(row)).encode()


def in_json(content):
    return lambda n, row: json.dumps(content(n, row)).encode() + b"\n"


F2 = "%.2f"
FLOATS = table(5, 2, 3.0, 0.2)
STREAMS: dict[str, tuple[Callable, np.ndarray, float | None]] = {
    # name: (bytes of frame n, values, s between two frames by the device's clock or None)
    "pipes": (joined(" | ", shape="%d"), table(4), None),
    "blanks padded": (joined(" ", shape="%6d", end="\r\n"), table(7), None),
    "tabs lfcr": (joined("\t", end="\n\r"), table(6), None),
    "comma blank cr": (joined(", ", end="\r"), table(3), None),
    "semicolons trailing": (joined(";", after=";"), table(5), None),
    "one channel": (joined(","), table(1), None),
    "sixty-four channels": (joined(","), table(64), None),
    "signs and exponents": (joined(",", shape="%+.3e"), np.c_[table(2, 0, -300, 5), table(2)], None),
    "parentheses": (joined(",", before="(", after=")"), table(4), None),
    "nmea-like": (joined(",", before="$FSR,", end="\r\n"), table(6), None),
    "units after": (joined(" N; ", shape=F2, after=" N"), FLOATS, None),
    "millivolts": (labelled("ch{}={}mV", " "), table(4), None),
    "labels blank": (labelled("Sensor {}: {}", ", "), table(3), None),
    "decimal comma tabs": (lambda n, r: joined("\t", shape=F2)(n, r).replace(b".", b","), FLOATS, None),
    "milliseconds": (clocked(20, first=88_213), table(4), 0.02),
    "seconds": (clocked(0.02, "\t", shape="%.3f"), table(4), 0.02),
    "counter of 256, ms": (clocked(20, counter=256), table(4), 0.02),
    "counter of 37, s": (clocked(0.02, counter=37, shape="%.2f"), table(4), 0.02),
    "clock of 16 bits": (
        lambda n, r: b"%d,%s" % ((64_000 + 20 * n) % 65_536, joined(",")(n, r)), table(4), 0.02),
    "time of day": (lambda n, r: b"10:59:%06.3f %s" % (20 + n / RATE, joined(" ")(n, r)), table(4), None),
    "date": (lambda n, r: b"2026/11/29 12:00:%02d;%s" % (n / RATE, joined(";")(n, r)), table(4), None),
    "ISO": (lambda n, r: b"[2026-11-29T12:00:%06.3fZ] " % (n / RATE) + joined(",")(n, r), table(4), None),
    "json object": (in_json(lambda n, r: {f"s{k}": v for k, v in enumerate(r)}), FLOATS, None),
    "json nested": (
        in_json(lambda n, r: {"at": {"ms": 20 * n}, "pads": [list(r[:2]), list(r[2:])]}), table(4), 0.02),
    "json list with time": (in_json(lambda n, r: [n * 20_000, *r]), table(5), 0.02),
    "json temperature": (in_json(lambda n, r: {"seq": n, "temp": 24.1, "f": list(r)}), table(5), None),
    "matrix, blank line": (matrix(4), table(12), None),
    "matrix, word": (matrix(3, lambda n: b"frame %d\n" % n), table(9), None),
    "matrix, index": (matrix(4, b"", index=0), table(16), None),
    "matrix, index from 1": (matrix(2, b"", index=1), table(8), None),
    "index and value": (pairs("{},{}\n"), table(6), None),
    "word index value": (pairs("ch{}={}\n"), table(8), None),
    "word at the end": (joined(",", "ZZ", before="QQ,"), table(5), None),
    "hex": (lambda n, r: " ".join(f"{int(v):03X}" for v in r).encode() + b"\n", table(5, 0, 500, 90), None),
    "names like hex": (lambda n, r: b"A0,F1\n" * (n % 20 == 3) + joined(",")(n, r), table(2), None),
    "nul": (joined(",", end="\n\0"), table(4), None),
    "bytes before": (lambda n, r: b"\xff\xfe&" + joined(",")(n, r), table(4), None),
    "colours": (joined(", ", before="\x1b[0;33mW skin: ", after="\x1b[0m"), table(4), None),
    "status": (lambda n, r: (b"OK;" if n % 9 else b"LOW;") + joined(";")(n, r), table(4), None),
    "degrees": (lambda n, r: "F0={:.0f};F1={:.0f};T=2{}.5°C\n".format(*r, n % 9).encode(), table(2), None),
    "temperature": (lambda n, r: joined(",", after=f",2{n % 9}.5C")(n, r), table(4), None),
    "title with units": (
        lambda n, r: (b"t [ms];A [kPa];B [kPa];C [kPa];Temp [degC]\n" if n % 90 == 40 else b"")
        + b"%d;%s;24.5\n" % (20 * n, joined(";", "")(n, r)), table(3), 0.02),
    "labels in any order": (
        lambda n, r: "\t".join(f"s{k}:{r[k]:.0f}" for k in range(4)[:: 1 if n % 3 else -1]).encode() + b"\n",
        table(4), None),
    "keys in any order": (
        in_json(lambda n, r: {f"s{k}": r[k] for k in (range(4) if n % 3 else (2, 0, 3, 1))}), table(4), None),
    "topic before json": (
        lambda n, r: b"skin/a " + in_json(lambda n, r: {"id": "esp-07", "f": list(r)})(n, r), table(4), None),
    "two kinds of lines": (
        lambda n, r: b"Filt: " + joined("\t")(n, r) + b"Base: 1\t2\t3\t4\n", table(4), None),
    "text now and then": (
        lambda n, r: (b"no data\n" if n % 11 == 4 else b"") + joined(",")(n, r), table(4), None),
    "guides": (joined(" ", before="0 ", after=" 1023"), table(4), None),
    "guides by name": (
        lambda n, r: b"Min:0," + labelled("f{}:{}", ",", "")(n, r) + b",Max:900\n", table(4), None),
    "clock last": (lambda n, r: joined(",", "")(n, r) + b",%d\n" % (20 * n), table(4), 0.02),
    "sum last": (lambda n, r: joined(",", "")(n, r) + b",%d\n" % (int(sum(r)) & 255), table(4), None),
    "counter of 16": (clocked(0, counter=16), table(4), None),
    "a line per board": (lambda n, r: b"L %d %d\nR %d %d\n" % tuple(r), table(4) - 30 * np.arange(4), None),
    "a line per name": (
        lambda n, r: "".join(f">f{k}:{v:.0f}\n" for k, v in enumerate(r)).encode(), table(4), None),
    "a line per pad": (
        lambda n, r: "".join(
            f"[10:00:{n // 50:02d}] Pad 'p_{k + 1}' (T{k + 4}): {v:.0f}\n" for k, v in enumerate(r)).encode(),
        table(4), None),
}  # fmt: skip


def sent(name):
    encode, rows, _ = STREAMS[name]
    pieces = [(n / RATE, encode(n, row)) for n, row in enumerate(rows)]
    # In the middle of a frame, as a port is opened.
    return [(pieces[0][0], pieces[0][1][len(pieces[0][1]) // 2 :]), *pieces[1:]]


def proposed(lines, rate=RATE):
    """Return the adapter that is proposed for lines at a rate, Hz."""
    return propose([(n / rate, line) for n, line in enumerate(lines)])[0].adapter


def check_frames(decoder, pieces, rows):
    """Check that every frame has the values of a row, in order; return the frames."""
    frames = [frame for now, data in pieces for frame in decoder.feed(data, now)]
    assert len(frames) >= 0.85 * len(rows)
    following = 0
    for frame in frames:
        assert frame.valid.all()
        alike = (rows[following:] == frame.values).all(axis=1)
        assert alike.any(), f"{frame.values} was never sent"
        following += int(alike.argmax()) + 1
    return frames


@pytest.mark.parametrize("name", STREAMS)
def test_a_proposed_adapter_reads_what_was_sent(name):
    _, rows, period = STREAMS[name]
    pieces = sent(name)
    proposal = propose(pieces)[0]
    assert proposal.sensors == rows.shape[1]
    if name == "milliseconds":
        assert "field 0 is the time in ms, as it rises by 20 per frame" in proposal.summary
    # What a person pastes is what is read.
    pasted = read_adapter(yaml.safe_load(proposal.adapter.describe()))
    assert pasted == proposal.adapter
    decoder = Decoder(adapter=pasted)
    frames = check_frames(decoder, pieces, rows)
    assert decoder.stats.resets == 0
    if period is not None:
        steps = np.diff([frame.t for frame in frames])
        assert np.allclose(steps, period, atol=1e-6)
        assert "counts" in decoder.stats.clock


def pressed(n, k):
    """Return a value with some noise that rises by 300 for half a second in every two."""
    return 100 + 20 * k + (n * 7919 + k * 104_729) % 997 % 4 + (300 if k == 2 and n % 100 >= 75 else 0)


REFUSED = {
    # name: (bytes of frame n, what the sentence names)
    "unknown word": (
        lambda n: ",".join("XYZ" if pressed(n, k) > 300 else str(pressed(n, k)) for k in range(4)) + "\n",
        r"the word 'XYZ' stands in place of numbers: give device.adapter.over=\[XYZ\]",
    ),
    "names before": (
        lambda n: "".join(f"chip{k}:\n{pressed(n, k)},{pressed(n, k + 1)}\n" for k in range(3)),
        r"'chip#:' name other values, or those after them: let the firmware send a line per frame",
    ),
    "only what changes": (
        lambda n: f"pad 2 = {pressed(n, 2)}\n" if pressed(n, 2) > 300 else "",
        "let the firmware send every frame",
    ),
    "rows": (lambda n: f"{pressed(n, 0)},{pressed(n, 1)}\n{pressed(n, 2)}\n", "1 or 2 fields.*adapter"),
    "groups of digits": (lambda n: f"{1024 if n % 40 > 20 else 998:,};{500 + n % 7}\n", "no adapter reads"),
    "nothing changes": (lambda n: "12,13,14\n", "no value ever changes"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_would_be_read_wrongly_is_refused_with_a_remedy(name):
    encode, said = REFUSED[name]
    pieces = [(n / RATE, encode(n).encode()) for n in range(COUNT) if encode(n)]
    with pytest.raises(InputError, match=said):
        propose(pieces, COUNT / RATE)


def test_letters_that_only_a_press_shows_are_no_decimal_numbers():
    """At rest, hexadecimal digits look like decimal ones: a press then shows no value that is wrong."""
    counts = [(0x200 + pressed(n, 0) % 10, 0x210 + pressed(n, 1) % 7) for n in range(COUNT)]
    lines, press = [b"%03X %03X 215\n" % pair for pair in counts], b"29F 212 215\n"
    frames = Decoder(adapter=proposed(lines)).feed(b"".join(lines) + press)
    assert frames[-1].valid.tolist() == [False, True, True]
    assert proposed([b"A0,A1\n", *(b"%d,%d\n" % pair for pair in counts)]).names == ("A0", "A1")
    assert proposed([press if n % 20 == 7 else line for n, line in enumerate(lines)]).base == 16


@pytest.mark.parametrize(("limit", "valid"), [(None, False), (1023.0, True), (900.0, True)])
def test_a_word_for_over_range_is_no_missing_value(limit, valid):
    header = encode_header(Header(n=2, bits=10)) * (limit == 900)
    lines = header + b"".join(b"%d,%d\n" % (100 + n % 3, 120 + n % 2) for n in range(40)) + b"OL,121\n"
    frame = Decoder(adapter=Adapter(kind="text", limit=limit)).feed(lines)[-1]
    assert frame.saturated.tolist() == [True, False]
    assert frame.valid.tolist() == [valid, True]
    assert frame.values[0] == (limit or 100)


def test_keys_that_are_missing_are_channels_without_a_value():
    rows = [{f"s{k}": pressed(n, k) for k in range(4) if n % 7 or k != 1} for n in range(COUNT)]
    labels = ["\t".join(f"{name}:{value}" for name, value in row.items()).encode() + b"\n" for row in rows]
    for lines in ([json.dumps(row).encode() + b"\n" for row in rows], labels):
        frames = Decoder(adapter=proposed(lines)).feed(b"".join(lines))
        assert {tuple(frame.valid.tolist()) for frame in frames} == {(True,) * 4, (True, False, True, True)}


def test_a_constant_in_single_frames_is_no_value():
    lines = [b"%d,%d\n" % (65535 if n % 70 == 50 else pressed(n, 0), pressed(n, 1)) for n in range(COUNT)]
    assert proposed(lines, 100).invalid == (65535,)
    assert proposed(lines, 20).invalid == ()  # 50 ms: it may be a touch beyond the range
    quiet = [b"%d,%d\n" % (100 + (n % 9 == 4), 120 - (n % 7 == 2)) for n in range(COUNT)]
    assert proposed(quiet, 100).invalid == ()


def test_what_is_no_stream_is_shown():
    with pytest.raises(InputError, match="nothing received"):
        propose([])
    lines = [(n * 0.1, b"Ready. Send g to go.\r\n") for n in range(20)]
    with pytest.raises(InputError, match=r"the last lines are 'Ready. Send g to go.'.*start="):
        propose(lines)
    noise = np.random.default_rng(0).bytes(4000)
    with pytest.raises(InputError, match=r"4000 bytes that are not text.*baud rate.*struct: "):
        propose([(0.0, noise[:2000]), (1.0, noise[2000:])])


def test_keys_keep_their_channels_at_a_reconnection():
    decoder = Decoder(adapter=Adapter(kind="json"))
    for keys in ("abc", "cab"):
        rows = [{key: ord(key) + n % 2 for key in keys} for n in range(200)]
        frames = decoder.feed("".join(json.dumps(row) + "\n" for row in rows).encode(), 1.0)
        assert frames[-1].values.tolist() == [98, 99, 100]
        decoder.restart()


def test_the_shipped_adapters_read_what_they_are_named_after():
    rng = np.random.default_rng(3)
    rows = np.round(rng.normal(0, 50, (200, 3, 4)), 2)
    text = [b"".join(b"%.2f\t%.2f\t%.2f\t%.2f" % tuple(chip) for chip in row) + b"\n" for row in rows]
    frames = Decoder(9, adapter=read_adapter("anyskin")).feed(b"".join(text))
    assert frames[-1].values.tolist() == rows[-1, :, 1:].ravel().tolist()
    data = b"".join(rows[n].astype("<f4").tobytes() + b"\r\n" for n in range(200))
    frames = Decoder(9, adapter=read_adapter("anyskin_binary")).feed(data)
    assert len(frames) >= 199
    assert frames[-1].values.tolist() == rows[-1, :, 1:].astype("f4").ravel().tolist()


@pytest.mark.parametrize("axes", ["normal", "magnitude"])
@pytest.mark.parametrize("kind", ["text", "binary", "rows"])
def test_three_axes_at_one_place_become_one_sensor(axes, kind):
    """A chip per row, or all chips in one frame; what one axis lacks, the length lacks, too."""
    chips = np.random.default_rng(4).normal(0, 50, (60, 5, 3)).round(2)
    chips[40, 2, 0] = -999
    described, encode = {
        "text": ({"kind": "text"}, joined(",", shape="%.2f")),
        "binary": (
            {"kind": "binary", "struct": {"xyz": "(15,)<f8"}, "head": "aa 55"},
            lambda n, row: b"\xaa\x55" + row.tobytes(),
        ),
        "rows": ({"kind": "text", "rows": 0}, matrix(3, shape="%.2f")),
    }[kind]
    adapter = read_adapter({**described, "axes": axes, "invalid": [-999]})
    # The head of the next frame ends the last one.
    data = b"".join(encode(0, chip.ravel()) for chip in chips) + b"\xaa\x55" * (kind == "binary")
    for count in (5, None):
        frames = Decoder(count, adapter=adapter).feed(data)
        assert len(frames) > 40
        expected = chips[..., 2] if axes == "normal" else np.sqrt((chips**2).sum(axis=2))
        for frame, row in zip(frames[::-1], expected[::-1], strict=False):
            lost = axes == "magnitude" and row[2] > 900
            assert frame.valid.tolist() == [True, True, not lost, True, True]
            assert np.allclose(frame.values[frame.valid], row[frame.valid])
    with pytest.raises(InputError, match=r"axes.* takes x, y, z of each place, but 4 values are left"):
        Decoder(adapter=Adapter(kind="text", axes=axes)).feed(b"1,2,3,4\n" * 60)


def test_fields_are_kept_dropped_and_marked_invalid():
    rows = [[n, 512 + n % 3, -999 if n % 5 == 0 else 7, 24.5, 300] for n in range(60)]
    lines = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    adapter = Adapter(kind="text", drop=(3,), invalid=(-999, "off"))
    frames = Decoder(adapter=adapter).feed(lines)
    assert (frames[0].seq, frames[-1].values.tolist()) == (1, [514, 7, 300])
    assert {frame.valid[1] for frame in frames if frame.seq % 5 == 0} == {False}
    frames = Decoder(adapter=Adapter(kind="text", values=(4, 1))).feed(lines)
    assert frames[-1].values.tolist() == [300, 514]


@pytest.mark.parametrize("adapter", SHIPPED)
def test_the_time_for_a_long_line_grows_with_its_length(adapter):
    """Regular expressions that match blanks or digits in several ways took 4 s, or an hour."""

    def seconds(line):
        decoder = Decoder(adapter=read_adapter(adapter))
        decoder.feed(b"".join(SHIPPED[adapter] % (position % 9) for position in range(40)))
        start = process_time()
        for position in range(0, len(line), 1024):
            decoder.feed(line[position : position + 1024])
        return process_time() - start

    for begin in (b"a", b"a:", b"a:1", b"a:1,b:2", b"1.25", b"25.0"):
        for middle in (b" ", b"1", b"a"):
            short, long = (seconds(begin + middle * length + b"x\n") for length in (7_500, 30_000))
            assert long < 8 * short + 0.1, (begin, middle)  # as the square: 16 times


def test_what_is_read_to_find_a_format_grows_with_what_is_received(monkeypatch):
    """Each of many small pieces made the decoder read all of those before it."""
    read, decoder = [], Decoder(adapter=read_adapter("csv"))
    monkeypatch.setattr(Adapter, "detect", lambda self, data, sensors: read.append(len(data)))
    for _ in range(3000):
        decoder.feed(b"xyz 1 of\r\n")
    assert sum(read) < 20 * 30_000
