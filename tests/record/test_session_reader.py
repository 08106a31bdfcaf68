"""A damaged session loses what is damaged, says so, and never gives a gesture another meaning."""

import json
import logging
import re
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.record.recorder import SessionLog
from skin.record.session import read_session
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import RecordedGesture
from tests.damage import DAMAGED_FILES, damaged, opened

ABOUT = {"positions": [[0.0, 0.0, 0.0]] * 2, "unit": "adc", "window": 5, "rate": 50.0}
MEANING = UnitConversion(np.array([0.1, 0.2]), np.array([512.0, 500.0]), np.array([False, False]))
OTHER = UnitConversion(np.array([0.3, 0.4]), np.array([300.0, 200.0]), np.array([False, True]))
WHOLE = 6  # gestures


def frame(number, segment=0, valid=(True, True), after=""):
    values = np.array([number % 1024, 512.0])
    return Frame(number, number / 100, time.monotonic(), values, np.array(valid), segment, 0, after)


def gesture(log, number, first, broken=False, after=""):
    """Record ten frames; in the middle of every third gesture a channel falls ill."""
    segment = int(bool(after))
    gesture = RecordedGesture(number, {"big": number % 2, "dangerous": 1}, first / 100, 0)
    log.begin(gesture, frame(first, segment))
    for one in range(first, first + 10):
        valid = (True, number % 3 != 0 or one < first + 5)
        log.frame(frame(one, segment, valid, after if one == first else ""))
    gesture.broken = broken
    log.end(gesture)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Six gestures, one broken off and done again, recorded in two goes with two baselines."""
    path = tmp_path_factory.mktemp("session") / "x.csv"
    for conversion, numbers in ((MEANING, (0, 1, 2)), (OTHER, (3, 4, 5))):
        log = SessionLog(path, ABOUT, 2)
        log.conversion(conversion)
        for position, number in enumerate(numbers):
            if number == 4:
                gesture(log, 4, 900, broken=True)
            gesture(log, number, 20 * position, after="reset" * (number == 4))
            log.frame(frame(20 * position + 15, segment=int(number == 4)))
        log.close()
    return path


@pytest.fixture(params=["new", "old"])
def lines(request, session):
    """Return the session's lines; those of old had no checksums, and did not say which baseline is meant."""
    if request.param == "new":
        return session.read_bytes().splitlines()
    old = []
    for line in session.read_bytes().splitlines():
        if line.startswith(b"#"):
            said = json.loads(line[1:])
            del said["sum"]
            said.pop("frames", None)
            if said["event"] == "begin":
                del said["meaning"], said["invalid"]
            line = b"# " + json.dumps(said).encode()
        old.append(line)
    return old


@pytest.fixture
def stored(session, tmp_path):
    """Return a function that reads lines as a session."""
    path = tmp_path / "x.csv"
    path.with_name("x.csv.json").write_text(session.with_name("x.csv.json").read_text())

    def read_lines(lines, tail=b""):
        path.write_bytes(b"\n".join(lines) + b"\n" + tail)
        return read_session(path)

    return read_lines


def told(gesture, conversion):
    """Return all that is known of a gesture but how many frames were lost."""
    rows = [(one.t, one.seq, one.values.tolist(), one.valid.tolist()) for one in gesture.frames]
    return gesture.begin, dict(gesture.labels), rows, conversion.zero.tolist(), conversion.broken.tolist()


def cut(line):
    return line[: len(line) // 2]


def garbled(line):
    return line[:9] + b"\xff" + line[10:]


def nulls(line):
    return b"\0" * len(line)


def altered(line):
    """Return a line with another digit in it."""
    digit = re.search(rb"\d", line).start()
    return line[:digit] + b"%d" % ((int(line[digit : digit + 1]) + 1) % 10) + line[digit + 1 :]


def empty(line):
    return b""


def inside(lines, number):
    """Return the place of a frame within a gesture."""
    return (
        next(n for n, line in enumerate(lines) if b'"begin"' in line and b'"number": %d' % number in line) + 4
    )


def test_an_intact_session_has_nothing_to_warn_of(lines, stored, caplog):
    found = stored(lines)
    assert sorted(found.gestures) == list(range(WHOLE))
    assert not found.warnings
    assert not caplog.records
    assert found.gestures[3][1].zero.tolist() == OTHER.zero.tolist()
    assert [one.valid.tolist() for one in found.gestures[3][0].frames] == [[True, True]] * 5 + [
        [True, False]
    ] * 5


@pytest.mark.parametrize("damage", [cut, garbled, lambda line: line[:4] + b"x" + line[5:]])
def test_a_damaged_frame_is_lost_and_named(lines, stored, caplog, damage):
    whole, position = stored(lines), inside(lines, 1)
    caplog.set_level(logging.WARNING, "skin.record")
    lines[position] = damage(lines[position])
    found = stored(lines)
    assert sorted(found.gestures) == list(range(WHOLE))
    assert [gesture.lost for gesture, _ in found.gestures.values()] == [0, 1, 0, 0, 0, 0]
    assert (len(found.gestures[1][0].frames), found.frames) == (9, whole.frames - 1)
    assert [entry.message.split(": ", 1)[1] for entry in caplog.records] == [
        f"1 damaged line skipped: {position + 1}"
    ]


def test_two_frames_that_have_become_one_line_are_two_lost_ones(lines, stored):
    position = inside(lines, 1)
    found = stored(
        [*lines[:position], lines[position] + b"\xff" + lines[position + 1], *lines[position + 2 :]]
    )
    assert found.gestures[1][0].lost == 2


@pytest.mark.parametrize("wrong", ["9", "-9"])
def test_a_frame_whose_time_is_wrong_is_lost_and_no_other(lines, stored, wrong):
    position = inside(lines, 1)
    lines[position] = wrong.encode() + lines[position]
    found = stored(lines)
    assert found.damaged == [position + 1]
    assert (len(found.gestures[1][0].frames), found.gestures[1][0].lost) == (9, 1)


@pytest.mark.parametrize("damage", [cut, garbled, nulls, altered, empty])
def test_a_gesture_never_gets_another_meaning(lines, stored, damage, request):
    whole = {number: told(*one) for number, one in stored(lines).gestures.items()}
    events = [position for position, line in enumerate(lines) if line.startswith(b"#")]
    old, missing = b'"sum"' not in lines[1], set()
    assert len(events) > 20
    for position in events:
        # Sessions of old have no checksums, so another digit is not seen.
        if old and damage is altered:
            continue
        found = stored([*lines[:position], damage(lines[position]), *lines[position + 1 :]])
        kept = {number: told(*one) for number, one in found.gestures.items()}
        assert kept == {number: whole[number] for number in kept}, lines[position]
        assert found.damaged == [position + 1]
        lost = set(whole) - set(kept)
        missing |= lost
        # A lost baseline costs what was recorded on it, another event one gesture.
        maximum = (
            3 if b"meaning" in lines[position] and b"begin" not in lines[position] else WHOLE if old else 1
        )
        assert len(lost) <= maximum, lines[position]
    assert missing or (old and damage is altered)


def test_nulls_where_the_power_was_cut_are_skipped(lines, stored):
    whole = {number: told(*one) for number, one in stored(lines).gestures.items()}
    for tail in (b"\0" * 4096, b"\0" * 4096 + b"\n", lines[-1][:7] + b"\0" * 999):
        found = stored(lines, tail)
        assert {number: told(*one) for number, one in found.gestures.items()} == whole
    for position in range(2, len(lines) - 9, 7):
        hole = lines[position][:3] + b"\0" * 500 + lines[position + 9][2:]
        found = stored([*lines[:position], hole, *lines[position + 10 :]])
        assert len(found.gestures) >= 2
        for number, one in found.gestures.items():
            assert told(*one) == whole[number]


def test_a_byte_anywhere_costs_two_gestures_at_most(session, stored):
    data, rng = session.read_bytes(), np.random.default_rng(0)
    labels = {number: gesture.labels for number, (gesture, _) in stored(data.splitlines()).gestures.items()}
    for _ in range(300):
        position = int(rng.integers(len(data)))
        spoilt = data[:position] + rng.bytes(1) + data[position + 1 :]
        found = stored(spoilt.split(b"\n")[:-1])
        line = data[data.rfind(b"\n", 0, position) + 1 :].split(b"\n")[0]
        assert len(found.gestures) >= WHOLE - (3 if b'"event": "meaning"' in line else 2)
        for number, (gesture, conversion) in found.gestures.items():
            assert gesture.labels == labels[number]
            assert conversion.zero.tolist() == (MEANING if number < 3 else OTHER).zero.tolist()
            assert (np.diff([one.t for one in gesture.frames]) >= 0).all()


def test_a_gesture_without_frames_is_left_out_and_said(lines, stored):
    position = inside(lines, 1) - 4
    frames = [n for n, line in enumerate(lines) if position < n < position + 12 and not line.startswith(b"#")]
    found = stored([line for n, line in enumerate(lines) if n not in frames])
    assert sorted(found.gestures) == [0, 2, 3, 4, 5]
    assert found.warnings == ["gesture 1 left out: it has no frames"]


def test_a_clock_that_stood_still_is_said(lines, stored):
    still = [re.sub(rb"^[^,]*", b"1.5", line) if line[:1] not in (b"#", b"t") else line for line in lines]
    still = [
        re.sub(rb'"time": [^,]*', b'"time": 1.5', line) if b'"sum"' not in line else line for line in still
    ]
    found = stored(still)
    assert not found.gestures
    assert b'"sum"' in lines[1] or "the device's clock stood still" in found.warnings[0]


@pytest.mark.parametrize(
    ("about", "reason"),
    [
        ("[]", "no positions"),
        ('"x"', "no positions"),
        ("", "Expecting value"),
        ("{", "Expecting property name"),
        ("[" * 100_000, "nested too deep"),
        ('{"positions": [[0, 0, 0]], "started_unix": "now"}', "started_unix"),
        ('{"positions": [[0, 0, 0]], "started_unix": NaN}', "NaN must be a finite number"),
        ('{"positions": [[0, 0, 0]], "started_unix": 1, "rate": 0}', "rate"),
        ('{"positions": {}, "started_unix": 1}', "damaged or no session's"),
        ('{"positions": [[0, 0, 0]], "started_unix": 1}', "line 2: 2 values, 1 sensors"),
    ],
)
def test_what_stands_beside_it_must_be_a_sessions(tmp_path, about, reason):
    path = tmp_path / "x.csv"
    path.write_text("time,seq,raw_00\n1,2,3,4\n")
    path.with_name("x.csv.json").write_text(about)
    with pytest.raises(InputError, match=reason):
        read_session(path)


def test_a_file_with_nothing_beside_it_is_no_session(tmp_path):
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"no x\.csv\.json is beside it"):
        read_session(tmp_path / "x.csv")


def test_a_channel_whose_values_fall_keeps_its_smallest_value(tmp_path):
    path = tmp_path / "x.csv"
    log = SessionLog(path, ABOUT | {"rate": 10.0, "window": 5}, 2)
    log.conversion(UnitConversion(np.array([0.1, -0.1]), np.array([500.0, 500.0]), np.zeros(2, dtype=bool)))
    recorded = RecordedGesture(0, None, 0.0, 0)
    log.begin(recorded, frame(0))
    for number in range(50):
        values = 500.0 + np.array([number % 10, -(number % 10)])
        log.frame(frame(number)._replace(values=values))
    log.end(recorded)
    log.close()
    taken, conversion = read_session(path).gestures[0]
    readings, _ = conversion(taken.resampled.values, taken.resampled.valid)
    np.testing.assert_allclose(readings, 0.9, atol=1e-6)


def values(stored):
    """Return the readings, times and labels of each gesture, which must not change unnoticed."""
    return {
        number: (gesture.labels, [(frame.t, frame.seq, frame.values.tolist()) for frame in gesture.frames])
        for number, (gesture, _) in stored.gestures.items()
    }


@pytest.mark.parametrize("name", ["x.csv", "x.csv.json"])
def test_damage_never_passes_for_another_value(session, tmp_path, name, caplog):
    for path in session.parent.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    whole = values(read_session(session))
    caplog.set_level(logging.ERROR, "skin.record")

    @DAMAGED_FILES
    @given(data=st.data())
    def try_it(data):
        (tmp_path / name).write_bytes(data.draw(damaged((session.parent / name).read_bytes())))
        known = opened(lambda: read_session(tmp_path / "x.csv"))
        for number, (labels, frames) in values(known).items() if known else ():
            assert labels == whole[number][0]
            # Frames may be lost, which is counted; none may be another.
            assert all(frame in whole[number][1] for frame in frames), (number, frames)

    try_it()
