"""A session on disk: whole files, one writer, going on; damage costs one gesture and changes none."""

import logging
import shutil
import signal
import subprocess
import sys

import numpy as np
import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.calibration.bench import BenchSettings, load_table, read_bench_session
from skin.device.calibration import Curves
from skin.device.resampling import Window
from skin.errors import InputError
from skin.record.session import SessionLog, locked, read_session
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import ContinuousSegmenter
from tests.core.test_files import full
from tests.damage import DAMAGED_FILES, damaged, opened
from tests.record.gestures import CONVERSION, METADATA, frame, segmented
from tests.wire.memory import until

BENT = Curves(np.array([0.5, 1.0]), np.array([2.0, 3.0]), {1: [[0.0, 1.0], [0.0, 2.0]]})
OTHER = UnitConversion(np.array([0.3, -0.4]), np.array([300.0, 2.0]), np.array([False, True]), curves=BENT)
NUMBERS = [0, 1, 2, 3, 5, 6]  # gesture 4 was broken off
WRITER = """
import sys
from pathlib import Path
from itertools import count
from skin.record.session import SessionLog, locked
from tests.record.gestures import CONVERSION, METADATA, frame, segmented
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    segmented(SessionLog(Path(sys.argv[1]), METADATA), map(frame, count()), CONVERSION)
"""


def everything(gestures):
    content = {}
    for number, (gesture, conversion) in gestures.items():
        window = gesture.resampled
        arrays = [*conversion(window.values, window.valid), window.saturated]
        arrays += conversion.zero, conversion.broken
        content[number] = gesture.lost, gesture.labels, [array.tolist() for array in arrays]
    return content


def frames_of(folder):
    rows = [row for table in read_session(folder).tables for row in table.to_pylist()]
    return sorted(rows, key=lambda row: row["time"])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder with six gestures, recorded in two goes with two baselines, and what was recorded."""
    folder = tmp_path_factory.mktemp("session") / "s"
    log = SessionLog(folder, METADATA)
    ill = [frame(n, valid=(True, n < 15), limited=(n == 25, False)) for n in range(35)]
    gestures = segmented(log, ill, CONVERSION)
    log.write()
    log = SessionLog(folder, METADATA)
    rows = [frame(n) for n in range(14)] + [frame(n, 1, after="reset" * (n == 0)) for n in range(25)]
    gestures |= segmented(log, rows, OTHER)
    log.write()
    return folder, gestures


@pytest.fixture
def copied(recorded, tmp_path):
    return shutil.copytree(recorded[0], tmp_path / "s")


def test_gestures_come_back_exactly(recorded, caplog):
    folder, gestures = recorded
    stored = read_session(folder)
    assert sorted(stored.gestures) == sorted(gestures) == NUMBERS
    assert everything(stored.gestures) == everything(gestures)
    assert not stored.gestures[1][0].resampled.valid[3:, 1].any()
    assert stored.gestures[2][0].resampled.saturated[2].tolist() == [True, False]
    assert stored.gestures[5][1].curves.to_json() == BENT.to_json()
    assert not caplog.records


def test_every_frame_is_in_one_file(recorded):
    rows = frames_of(recorded[0])
    assert [row["seq"] for row in rows] == [*range(35), *range(14), *range(25)]
    assert (np.diff([row["time"] for row in rows]) > 0).all()
    assert [row["raw_00"] for row in rows] == [row["seq"] + 0.125 for row in rows]
    assert [row["gesture"] for row in rows[:35]] == [0] * 10 + [1] * 10 + [2] * 10 + [None] * 5
    assert [row["gesture"] for row in rows[35:]] == [3] * 10 + [None] * 4 + [5] * 10 + [6] * 10 + [None] * 5
    assert [row["segment"] for row in rows] == [0] * 35 + [1] * 14 + [2] * 25
    assert [row["state_01"] for row in rows[:35]] == [0] * 15 + [1] * 20
    assert [row["state_00"] for row in rows[24:27]] == [0, 2, 0]
    assert [n for n, row in enumerate(rows) if row["after"]] == [49]


def test_calibration_reads_it(recorded):
    table, _ = load_table(recorded[0], "session")
    assert [*table] == ["time", "seq", "gesture", "raw_00", "raw_01", "saturated_00"]
    gestures = [row["gesture"] for row in frames_of(recorded[0])]
    assert [None if np.isnan(number) else number for number in table["gesture"]] == gestures
    session = read_bench_session(recorded[0], BenchSettings())
    assert (session.raw.shape, session.unit, session.bits) == ((74, 2), "adc", 10)
    assert np.flatnonzero(np.isnan(session.raw[:, 1])).tolist() == [*range(15, 35)]
    assert np.argwhere(session.saturated).tolist() == [[25, 0]]
    assert np.array_equal(session.time, table["time"])


def test_contacts_and_unknown_labels_come_back(tmp_path):
    contacts = np.full((5, 2, 5), np.nan)
    contacts[2, 1] = 0.1, 0.2, 0.3, 0.4, 1 / 3
    log = SessionLog(tmp_path / "s", METADATA)
    segmenter = ContinuousSegmenter(Window(5, 50.0, 2))
    for number in range(11):
        if done := segmenter.add(frame(number)):
            done.contacts = contacts
            log.write((done, CONVERSION))
        log.add(frame(number), number / 100)
    ((gesture, _),) = read_session(tmp_path / "s").gestures.values()
    assert np.array_equal(gesture.contacts, contacts, equal_nan=True)
    assert gesture.labels is None


def test_a_restart_never_turns_time_back(tmp_path):
    log = SessionLog(tmp_path / "s", METADATA)
    with pytest.raises(InputError, match="it has no frames: record some"):
        load_table(tmp_path / "s", "session")
    for segment, now in ((0, 5.0), (1, 7.0), (2, 6.0)):  # the host's clock was set back before the last one
        for number in range(3):
            log.add(frame(number, segment), now + number / 100)
    assert [t for t, _ in log.frames] == [5.0, 5.01, 5.02, 7.0, 7.01, 7.02, 7.021, 7.031, 7.041]


@pytest.mark.parametrize("name", ["gesture_00002", "gesture_00003", "frames_000000300"])
def test_a_damaged_file_costs_its_gesture_which_is_recorded_again(copied, recorded, caplog, name):
    name += ".parquet"
    data = (copied / name).read_bytes()
    (copied / name).write_bytes(data[: len(data) // 2])
    caplog.set_level(logging.WARNING, "skin")
    stored = read_session(copied)
    assert [entry.message for entry in caplog.records] == [f"{copied}: damaged files are left out: {name}"]
    left = {number: taken for number, taken in recorded[1].items() if f"_0000{number}." not in name}
    assert everything(stored.gestures) == everything(left)
    rows = len(frames_of(copied))
    assert rows < 74
    caplog.clear()
    assert len(read_bench_session(copied, BenchSettings()).raw) == rows
    assert [entry.message for entry in caplog.records] == [f"{copied}: damaged files are left out: {name}"]
    log = SessionLog(copied, METADATA)
    assert log.done == set(left)
    if name.startswith("gesture"):
        log.done = {number for number in NUMBERS if number < int(name[8:13])}
        segmented(log, [frame(n) for n in range(11)], OTHER)
        assert sorted(read_session(copied).gestures) == NUMBERS
        assert (copied / name).with_suffix(".damaged").read_bytes() == data[: len(data) // 2]


def test_a_file_of_another_name_or_without_checksum_is_left_out(copied):
    (copied / "gesture_00001.parquet").rename(copied / "gesture_00009.parquet")
    table = pyarrow.parquet.read_table(copied / "gesture_00002.parquet")
    pyarrow.parquet.write_table(table, copied / "gesture_00002.parquet")
    (copied / "gesture_00007.parquet").mkdir()
    stored = read_session(copied)
    assert sorted(stored.gestures) == [0, 3, 5, 6]
    assert stored.damaged == [f"gesture_0000{number}.parquet" for number in (2, 7, 9)]


@pytest.mark.parametrize("name", ["about.json", "gesture_00001.parquet", "gesture_00005.parquet"])
def test_damage_never_passes_for_another_value(copied, recorded, name):
    whole, data = everything(recorded[1]), (copied / name).read_bytes()
    frames = {(row["segment"], row["seq"]): row for row in frames_of(copied)}

    @DAMAGED_FILES
    @given(draw=st.data())
    def damage(draw):
        (copied / name).write_bytes(draw.draw(damaged(data)))
        stored = opened(lambda: read_session(copied))
        if stored is None:
            return
        assert everything(stored.gestures) == {number: whole[number] for number in stored.gestures}
        assert len(stored.gestures) >= 5
        assert stored.metadata == METADATA
        for row in (row for table in stored.tables for row in table.to_pylist()):
            assert row == frames[row["segment"], row["seq"]]
        opened(lambda: read_bench_session(copied, BenchSettings()))

    damage()


@pytest.mark.parametrize("content", ["", "{", "[]", '"x"', "{}", '{"sum": ""}', "[" * 100_000, '{"a": NaN}'])
def test_what_is_no_session_is_refused_and_left_alone(copied, tmp_path, content):
    (copied / "about.json").write_text(content)
    (tmp_path / "x.csv").write_text("a,b\n1,2\n")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "precious").write_text("text")
    for path in (copied, tmp_path / "x.csv", tmp_path / "notes"):
        with pytest.raises(InputError, match=f"session {path}: .*skin record out=FOLDER"):
            read_session(path)
        with pytest.raises(InputError):
            SessionLog(path, METADATA)
    assert [path.name for path in (tmp_path / "notes").iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"window": 20}, "of 5 frames at 50 Hz, the configuration has 20 at 50 Hz: give touch.window=0.1 "),
        ({"rate": 12.5}, r"at 50 Hz, the configuration has 5 at 12\.5 Hz: give .* touch\.rate=50$"),
        ({"unit": "N"}, "recorded in adc, the device sends N: give another out="),
        ({"id": "arm-R"}, "recorded from the device arm-L, this is arm-R: give another out="),
        ({"id": None}, r"recorded from the device arm-L, this is unknown \(header missing"),
        ({"bits": 12}, "recorded with 10 bits, the device sends 12: give another out="),
        ({"positions": [[1.0, 0.0, 0.0]] * 2}, "another layout: give it"),
        ({"channels": [1, 0]}, "channels in another order"),
    ],
)
def test_a_session_goes_on_as_it_was_begun(copied, change, reason):
    with pytest.raises(InputError, match=reason):
        SessionLog(copied, METADATA | change)
    assert SessionLog(copied, METADATA | {"started_unix": 9.0}).metadata == METADATA


@pytest.mark.parametrize("size", [0, 1000, 90_000])
def test_a_full_disk_keeps_what_was_finished_and_goes_on(tmp_path, size):
    folder = tmp_path / "s"

    def attempt():
        log = SessionLog(folder, METADATA)
        segmented(log, [frame(n) for n in range(11)], CONVERSION)
        with full(min(size, 1000)):
            segmented(log, [frame(n) for n in range(11, 30)], CONVERSION)

    with pytest.raises(InputError, match=r"cannot write \S+: File too large") as refused, full(size):
        attempt()
    assert "\n" not in str(refused.value)
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    log = SessionLog(folder, METADATA)
    assert log.done == ({0} if size == 90_000 else set())
    segmented(log, [frame(n) for n in range(11)], CONVERSION)
    stored = read_session(folder)
    assert (len(stored.gestures), stored.damaged) == (1 + (size == 90_000), [])


def test_kill_9_keeps_finished_gestures_and_lets_go_of_the_lock(tmp_path):
    folder = tmp_path / "s"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(folder)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"locked\n"
        with pytest.raises(InputError, match="being recorded by another process: end that, or give another"):
            locked(folder)
        until(lambda: len(list(folder.glob("gesture_*"))) >= 20, writer)
        writer.send_signal(signal.SIGKILL)
    with locked(folder):
        done = SessionLog(folder, METADATA).done
    assert done == set(range(len(done)))
    assert [row["seq"] for row in frames_of(folder)] == list(range(10 * len(done)))
    assert not read_session(folder).damaged


def test_a_folder_has_one_writer_whatever_its_name(tmp_path):
    folder, link = tmp_path / "s", tmp_path / "t"
    folder.mkdir()
    link.symlink_to(folder)
    with locked(link), locked(tmp_path / "u"):
        for name in (folder, tmp_path / "s" / ".." / "s", link):
            with pytest.raises(InputError, match="another process"):
                locked(name)
    with locked(folder):
        pass


def test_a_folder_that_may_not_be_written_is_said(tmp_path):
    folder = tmp_path / "ro"
    folder.mkdir()
    folder.chmod(0o555)
    tmp_path.chmod(0o755)
    # As root nothing is forbidden, so another user tries; by then everything is imported.
    code = (
        "import os, sys; from pathlib import Path\n"
        "from skin.record.session import SessionLog, locked\n"
        "os.geteuid() or os.seteuid(65534)\n"
        "about = {'positions': [[0, 0, 0]], 'unit': 'N'}\n"
        "for attempt in (locked, lambda path: SessionLog(path, about)):\n"
        "    try: attempt(Path(sys.argv[1]))\n"
        "    except ValueError as error: print(error)\n"
    )
    path = f"/proc/self/cwd/{folder.name}/s"  # the folders above may be another user's
    command = [sys.executable, "-c", code, path]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.count("Permission denied: make it writable, or choose another place") == 2, done.stderr
    assert not list(folder.iterdir())
