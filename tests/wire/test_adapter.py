"""Adapters: their settings, what they refuse, what they say to a board, and any bytes at all."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skin.core.files import CONF
from skin.errors import InputError
from skin.wire.adapter import Adapter, read_adapter
from skin.wire.decoder import Decoder
from skin.wire.proposal import propose
from skin.wire.reader import Port, WireFeed
from tests.damage import DAMAGED_FILES

SHIPPED = sorted(path.stem for path in (CONF / "adapters").glob("*.yaml"))
quickly = settings(DAMAGED_FILES, max_examples=60)
OTHERS = {
    "pattern": Adapter(kind="text", pattern=r"<(?P<counter>\d+)\|(?P<values>[^>]*)>"),
    "decimal": Adapter(kind="text", decimal=",", separator=";"),
    "struct": Adapter(kind="binary", struct={"counter": "u1", "f": "(3,)<i2"}, head="aa 55"),
    "index": Adapter(kind="text", rows=0, index=0),
}
ALL = {name: read_adapter(name) for name in SHIPPED} | OTHERS | {"protocol": Adapter()}
ROWS = st.lists(st.lists(st.integers(-9, 2000), min_size=1, max_size=5), max_size=30)
TEXTS = st.one_of(
    st.binary(max_size=200),
    st.text(alphabet='0123456789,.;:-+eE \t\r\n"{}[]<>|nafov', max_size=300).map(str.encode),
    ROWS.map(lambda rows: "".join(",".join(map(str, row)) + "\n" for row in rows).encode()),
)


@pytest.mark.parametrize("name", SHIPPED)
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
        ({"kind": "xml"}, "device.adapter.kind=xml must be"),
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
        ({"kind": "text", "time_unit": "min"}, "time_unit=min must be"),
        ([1], "must be settings by name"),
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
