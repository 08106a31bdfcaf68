"""A session on disk survives everything up to its last whole frame."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from skin.device.resampling import Frame
from skin.errors import InputError
from skin.record.recorder import SessionLog
from skin.record.session import read_session
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import RecordedGesture

ABOUT = {"positions": [[0.0, 0.0, 0.0]] * 2, "unit": "adc"}
MEANING = UnitConversion(np.array([0.1, 0.2]), np.array([512.0, 500.0]), np.array([False, False]))

WRITER = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_session_log import ABOUT, MEANING, frame
from skin.record.recorder import SessionLog
log = SessionLog(Path(sys.argv[1]), ABOUT, 2)
log.conversion(MEANING)
print("ready", flush=True)
number = 0
while True:
    log.frame(frame(number))
    number += 1
"""


def frame(number, segment=0, valid=(True, True), after="", t=None):
    values = np.array([number % 1024, 512.0])
    t = number / 100 if t is None else t
    return Frame(number, t, time.monotonic(), values, np.array(valid), segment, 0, after)


def recorded(path, *numbers):
    """Record gestures of ten frames each."""
    log = SessionLog(path, ABOUT, 2)
    log.conversion(MEANING)
    for number in numbers:
        first = frame(20 * number)
        gesture = RecordedGesture(number, {"big": number % 2}, first.t, 0)
        log.begin(gesture, first)
        for one in range(20 * number, 20 * number + 10):
            log.frame(frame(one))
        log.end(gesture)
        for one in range(20 * number + 10, 20 * number + 20):
            log.frame(frame(one))
    return log


def test_gestures_come_back_exactly(tmp_path):
    recorded(tmp_path / "x.csv", 0, 1).close()
    stored = read_session(tmp_path / "x.csv")
    assert sorted(stored.gestures) == [0, 1]
    gesture, conversion = stored.gestures[1]
    assert [one.seq for one in gesture.frames] == list(range(20, 30))
    assert np.diff([one.t for one in gesture.frames]) == pytest.approx(0.01, abs=1e-8)
    assert gesture.begin == pytest.approx(gesture.frames[0].t, abs=1e-8)
    assert gesture.labels == {"big": 1}
    assert conversion.zero.tolist() == [512.0, 500.0]
    assert stored.frames == 40


def test_the_same_command_goes_on(tmp_path):
    path = tmp_path / "x.csv"
    recorded(path, 0).close()
    log = recorded(path, 1)
    log.close()
    assert log.done == {0, 1}
    stored = read_session(path)
    assert stored.frames == 40
    times = [float(line.split(",")[0]) for line in path.read_text().splitlines()[1:] if line[0] != "#"]
    assert (np.diff(times) > 0).all()


def test_half_a_line_and_half_a_gesture_are_left_out(tmp_path):
    path = tmp_path / "x.csv"
    log = recorded(path, 0)
    log.begin(RecordedGesture(1, None, 5.0, 0), frame(500))
    log.frame(frame(500))
    log.close()
    with path.open("a") as file:
        file.write("5.01,501,51")
    assert sorted(read_session(path).gestures) == [0]
    assert read_session(path).frames == 21
    recorded(path, 2).close()
    assert sorted(read_session(path).gestures) == [0, 2]
    assert "5.01,501,51" not in path.read_text()


def test_every_frame_is_there_after_kill_9(tmp_path):
    path = tmp_path / "x.csv"
    code = WRITER.format(tests=os.path.dirname(__file__))
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"ready\n"
        deadline = time.monotonic() + 60
        while not path.exists() or path.stat().st_size < 50_000:
            assert time.monotonic() < deadline
        writer.send_signal(signal.SIGKILL)
    text = path.read_text()
    assert text.endswith("\n")
    rows = [line.split(",") for line in text.splitlines()[1:] if not line.startswith("#")]
    assert [int(row[1]) for row in rows] == list(range(len(rows)))
    assert {len(row) for row in rows} == {4}
    assert read_session(path).frames == len(rows) > 1000


def test_gaps_and_bad_channels_are_told(tmp_path):
    path = tmp_path / "x.csv"
    log = SessionLog(path, ABOUT, 2)
    log.conversion(MEANING)
    gesture = RecordedGesture(0, None, 0.0, 0)
    log.begin(gesture, frame(0))
    log.frame(frame(0))
    log.frame(frame(1, valid=(True, False)))
    log.frame(frame(2))
    log.end(gesture)
    log.frame(frame(0, segment=1, after="reconnect"))
    log.close()
    frames = read_session(path).gestures[0][0].frames
    assert [one.valid.tolist() for one in frames] == [[True, True], [True, False], [True, True]]
    assert '"after": "reconnect"' in path.read_text()


def test_another_layout_is_refused(tmp_path):
    recorded(tmp_path / "x.csv", 0).close()
    with pytest.raises(InputError, match="another layout"):
        SessionLog(tmp_path / "x.csv", ABOUT | {"positions": [[1.0, 0.0, 0.0]] * 2}, 2)


def test_calibration_reads_it_too(tmp_path):
    from skin.calibration import bench

    recorded(tmp_path / "x.csv", 0, 1).close()
    found = bench.read_bench_session(tmp_path / "x.csv", "disc", 0.01)
    assert (found.raw.shape, found.unit) == ((40, 2), "adc")


@pytest.mark.parametrize("text", ["time,seq,raw_00\n1,2,three\n", "time\n# no json\n"])
def test_another_file_is_refused(tmp_path, text):
    path = tmp_path / "x.csv"
    with pytest.raises(InputError, match="no session"):
        read_session(path)
    path.write_text(text)
    path.with_name("x.csv.json").write_text("{}")
    with pytest.raises(InputError, match=r"damaged or no session's: it has no positions"):
        read_session(path)
